# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How the graph grows by the odometry of one robot: samples in, keyframes and their steps out.

Where the odometry does not go on from where it was (stamps go back, its frame is another one), a
new part of the map begins: at the end of the one before, which is a guess that no factor says.
Loops join the parts, if there are any.
"""

import math
from collections.abc import Callable

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import MOST_OF_ODOMETRY, root_of_inverse
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import Notes, OdometrySample
from l1slam_ros.core.online.builder_state import TrackEnd
from l1slam_ros.core.online.keyframes import KeyframeMotion, Level
from l1slam_ros.core.online.loops.loop_factors import LoopFactors
from l1slam_ros.core.online.odometry.odometry_stream import BaseFrame, OdometryStream
from l1slam_ros.core.online.odometry.odometry_track import OdometryTrack
from l1slam_ros.core.online.odometry.plausibility import UNSEEN_TURN, Point
from l1slam_ros.core.online.odometry.tracks import Tracks
from l1slam_ros.core.online.options import ON_A_GAP, GraphBuilderOptions


class GrowingGraph:
    """
    What robots that are in one graph share.

    Parameters
    ----------
    manifold, options, verbatim : see `GraphBuilder`

    Attributes
    ----------
    options, verbatim : as above
    graph, loops, notes : see `GraphBuilder`
    tracks : the odometry of each robot
    members : called when the graph begins anew

    """

    def __init__(self, manifold: Manifold, options: GraphBuilderOptions, verbatim: bool):
        self.options, self.verbatim = options, verbatim
        self.notes = Notes()
        self.loops = LoopFactors(manifold, self.notes, verbatim)
        self.members: list[Callable[[], None]] = []
        self.begin(FactorGraph(manifold))

    def begin(self, graph: FactorGraph) -> None:
        """Begin with a graph, of which no keyframe is known yet."""
        self.graph = graph
        self.tracks = Tracks(graph.manifold)
        for begin in self.members:
            begin()

    def forget(self) -> None:
        """Begin anew; loops that wait are kept, since odometry of their times may still come."""
        self.begin(FactorGraph(self.graph.manifold))
        self.loops.forget()

    def has_others(self, robot: int) -> bool:
        """Return whether any keyframe is of another robot."""
        return any(other != robot for other in self.tracks.begun)

    def add_due_loops(self) -> int:
        """See `GraphBuilder.add_due_loops`."""
        return self.loops.add_due(self.graph, self.tracks, self.options.loop)


class RobotOdometry:
    """
    The odometry of one robot.

    Parameters
    ----------
    robot : its number
    shared : the graph that it grows
    base_frame : tells whose odometry a sample is

    Attributes
    ----------
    manifold : what the poses live on
    stream : passes on what is the robot's motion, and holds what may not be
    track : the odometry so far, its keyframes and gaps
    offset : (1, p) what takes poses of its odometry frame to those kept here: the identity, until
        after `GraphBuilder.restore`, or at a gap, the odometry goes on from where the robot was

    """

    def __init__(self, robot: int, shared: GrowingGraph, base_frame: BaseFrame):
        self._robot = robot
        self._shared = shared
        self.base_frame = base_frame
        self.manifold = shared.graph.manifold
        self.stream = OdometryStream(self.manifold, shared.notes, base_frame)
        self._motion: KeyframeMotion
        self.begin()
        shared.members.append(self.begin)

    def begin(self) -> None:
        """Begin with the graph that there is, of which no keyframe of the robot is known yet."""
        self._resumed = False
        self.track = OdometryTrack(self.manifold)
        self._shared.tracks.add(self._robot, self.track)
        self.offset = self.manifold.identity(1)
        self._level = Level(self.manifold)
        self._moved, self._glued = False, True

    def add(self, sample: OdometrySample) -> bool:
        """See `GraphBuilder.add_odometry`."""
        ignore = self._shared.options.on_time_jump == 'ignore'
        track = self.track
        if ignore and not self._glued and sample.stamp <= track.last_stamp:
            raise MessageError('old_stamp', f'odometry stamp {sample.stamp} ns is not after the '
                               f'last one, {track.last_stamp} ns')
        used = False
        for point in self.stream.take(
                sample, self._shared.verbatim, not ignore, self._put_in_place):
            self._add(point)
            used = True
        track = self.track  # a new one, maybe
        # Loops that are due are carried by the samples as they came, so thinning waits for them.
        if track.may_be_thinned and not self._shared.loops.waiting.is_due(
                self._robot, track.last):
            track.thin()
        return used

    def finish(self) -> None:
        """Use the last sample of all, if it is held for a pause alone; see `held`."""
        for point in self.stream.finish():
            self._add(point)

    def _put_in_place(self, point: Point) -> bool:
        """
        Put a late sample in its place; return False where it is later than `odometry.reorder`.

        What is known from one keyframe to the next, stays: a message before the last one is
        dropped, and so is one of a place that the robot did not go by.

        Raises
        ------
        MessageError : `old_stamp`, it is dropped.

        """
        track, pose = self.track, point.pose
        behind = (track.last_stamp - point.stamp) * 1e-9
        if self._shared.verbatim or not self._glued or (
                not 0 < behind <= self._shared.options.odometry.reorder):
            return False
        if self._moved:
            pose = self.manifold.compose(self.offset, pose)
        beside = track.went_by(point.stamp, pose)
        if beside is None or point.stamp < track.keyframe_stamps[-1]:
            where = 'after a later keyframe' if beside is not None else (
                'and says where the robot did not go')
            raise MessageError('old_stamp', f'odometry stamp {point.stamp} ns came {behind:.3g} s '
                               f'late, {where}; expected stamps that rise')
        self._motion.insert(point.sample, pose, beside, self._shared.options.odometry)
        track.insert(point.stamp, pose)
        return True

    def _add(self, point: Point) -> None:
        """Add a sample of the robot's motion."""
        if point.anew and (self._resumed or self._shared.has_others(self._robot)):
            self._glued = False  # the odometry begins again
        elif point.anew:
            self._shared.forget()
        on_gap = self._shared.options.on_time_jump
        pose = point.pose
        manifold = self.manifold
        goes_on = self._glued or self.track.goes_on(point.stamp, pose, self.offset)
        gap = self._gap(point, goes_on)
        if gap:
            self._shared.add_due_loops()  # what came before is of that time
            cause, said = ON_A_GAP[on_gap]
            self._shared.notes.tell(cause, f'{gap}; {said}')
            self._level = Level(manifold)
            if on_gap == 'reset':
                self._shared.forget()
        if not len(self.track):
            self._begin_part(point.stamp, pose)
            return
        if gap or not goes_on:
            self.offset = manifold.compose(self.track.last_pose, manifold.inverse(pose))
            self._moved = True
        self._glued = True
        if self._moved:
            pose = manifold.compose(self.offset, pose)
        if gap and on_gap == 'new_segment':
            if self.track.begin_part(point.stamp, point.reach):
                self._shared.loops.waiting.begin_anew(self.track.time, self._robot)
            self._begin_part(point.stamp, pose)
        else:
            self._go_on(point, pose)

    def _gap(self, point: Point, goes_on: bool) -> str:
        """Return why no motion is known to a sample from the one before; empty: it is known."""
        if not self._glued and point.stamp <= self.track.last_stamp:
            return f'odometry stamp {point.stamp} ns is before the end of the map'
        if not goes_on and self._shared.options.on_time_jump == 'new_segment':
            return f'odometry at {point.stamp} ns begins elsewhere than the map ends'
        return point.gap

    def _go_on(self, point: Point, pose: Array) -> None:
        """Continue to a sample at `pose` (1, p); where that makes a keyframe, add its factor."""
        unseen = None
        turned = min(UNSEEN_TURN * point.seconds, math.pi)
        if point.gap or point.unsure:
            unseen = point.unseen, turned
        if point.unsure:
            self._shared.notes.tell('unsure', f'{point.unsure}; it counts as uncertain by '
                                    f'{point.unseen:.3g} m and {turned:.2g} rad')
        motion = self._motion.step(point.sample, pose, self._shared.options.keyframe,
                                   self._shared.options.odometry, self._shared.verbatim, unseen)
        self.track.append(point.stamp, pose, motion is not None, point.reach)
        if motion is not None:
            self._shared.notes.warn_bounds(
                'odometry', point.stamp, self._motion.bounded, MOST_OF_ODOMETRY)
            self._note_slope(point.sample)
            self._shared.graph.append_step(
                motion[0], root_of_inverse(motion[1][None]), self._robot)
            self._number_keyframe()

    def _note_slope(self, sample: OdometrySample) -> None:
        length, angle = self._level.dropped(sample, self._shared.options.keyframe)
        if length or angle:
            self._shared.notes.warn(
                'slope', f'odometry at {sample.stamp} ns has left the plane by {length:.3g} m and '
                f'{angle:.2g} rad, which are dropped; expected dimension 3 for a robot on slopes')

    def _begin_part(self, stamp: int, pose: Array) -> None:
        """Begin a part of the map with a keyframe."""
        self.track.append(stamp, pose, is_keyframe=True)
        self._shared.graph.add_poses(1, self._robot, begins_part=True)
        self._number_keyframe()
        self._motion = KeyframeMotion(self.manifold, stamp, pose)

    def _number_keyframe(self) -> None:
        """Note that the newest keyframe of the graph is the track's newest."""
        self.track.numbers.append(self._shared.graph.n_poses - 1)

    def end(self) -> TrackEnd:
        """Return where the odometry has come to; there are keyframes."""
        track, shared = self.track, self._shared
        return TrackEnd(
            self._robot, self.offset, track.last_stamp, track.last_pose,
            self._motion.covariance(shared.options.odometry, shared.verbatim))

    def restore(self, end: TrackEnd, stamps: Indices, odometry: Array, numbers: Indices,
                firsts: Indices) -> None:
        """
        Go on where a run ended.

        stamps (k,), odometry (k, p), numbers (k,) : of the robot's keyframes; firsts : keyframes
        with which parts begin; others begin where stamps do not rise, as of several drives
        """
        track = self.track
        parts = np.flatnonzero(np.isin(numbers[1:], firsts) | (np.diff(stamps) <= 0)) + 1
        for part in np.split(np.arange(len(numbers)), parts):
            track.extend_by_part(stamps[part], odometry[part])
        track.numbers.extend(numbers)
        self.offset = end.offset
        self._motion = KeyframeMotion(self.manifold, track.last_stamp, track.last_pose)
        if end.end > track.last_stamp:
            track.append(end.end, end.end_pose, is_keyframe=False)
            by_model = self._shared.options.odometry.covariance_source == 'model'
            self._motion.add_known(
                end.end, end.end_pose, None if by_model else end.end_covariance)
        self._glued = False
        self._moved = True
        self._resumed = True
        self.stream = OdometryStream(
            self.manifold, self._shared.notes, self.base_frame, resumed=True)
