# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How the graph grows: odometry samples and loop closures in, keyframes and factors out.

Where the odometry does not go on from where it was (stamps go back, its frame is another one), a
new part of the map begins: at the end of the one before, which is a guess that no factor says.
Loops join the parts, if there are any.
"""

import math
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.geometry.noise import MOST_OF_ODOMETRY, root_of_inverse
from l1slam_ros.core.graph.factor_graph import NO_PREDECESSOR, FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, Notes, OdometrySample
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.online.keyframes import (
    KeyframeMotion,
    KeyframeOptions,
    Level,
    OdometryOptions,
)
from l1slam_ros.core.online.loops.loop_factors import LoopFactors, LoopOptions
from l1slam_ros.core.online.odometry.odometry_stream import BaseFrame, OdometryStream
from l1slam_ros.core.online.odometry.odometry_track import OdometryTrack
from l1slam_ros.core.online.odometry.plausibility import UNSEEN_TURN, Point
from l1slam_ros.core.options import Options, option

# Each kind of gap in the odometry: the cause it is counted by, and its sentence.
_SAID = {'new_segment': ('new_part', 'a new part of the map begins where the last one ends'),
         'reset': ('reset', 'the map begins anew'),
         'ignore': ('moved', 'the robot is taken to be where it was')}


@dataclass(frozen=True)
class GraphBuilderOptions(Options):
    """What makes keyframes and factors of messages."""

    keyframe: KeyframeOptions = KeyframeOptions()
    odometry: OdometryOptions = OdometryOptions()
    loop: LoopOptions = LoopOptions()
    on_time_jump: str = option(
        'new_segment', "when the ROS clock or the odometry's stamps jump back, or odometry jumps "
        'further than any robot moves: the map stays and a new part begins, which loops may join '
        'to it; or the map begins anew; or the robot is taken to be where it was, and old stamps '
        'are dropped', '', choices=tuple(_SAID))
    base_frame: str = option(
        '', "the robot's frame; empty: the first child_frame_id seen", fixed=True)


class GraphBuilder:
    """
    Grows a factor graph from messages.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `GraphBuilderOptions`
    verbatim : the messages are those of a graph: each is a measurement as it is stated, none a
        loop sent again or odometry that jumps
    base_frame : tells whose odometry it is; None: by the options alone

    Attributes
    ----------
    graph : the factor graph so far; loops enter it in `add_due_loops`
    base_frame : as far as is known
    stream : passes on what is the robot's motion, and holds what may not be
    track : the odometry so far, its keyframes and gaps
    loops : those in the graph, and those that wait
    notes : of messages that were not used, or otherwise than they say
    offset : (1, p) takes poses of the odometry frame to those kept here: the identity, until
        after `restore`, or at a gap, the odometry goes on from where the robot was

    """

    def __init__(self, manifold: Manifold, options: GraphBuilderOptions, verbatim: bool = False,
                 base_frame: BaseFrame | None = None):
        self.options = options
        self.graph = FactorGraph(manifold)
        self.notes = Notes()
        self._verbatim = verbatim
        self.base_frame = base_frame or BaseFrame(options.base_frame)
        self.stream = OdometryStream(manifold, self.notes, self.base_frame)
        self.loops = LoopFactors(manifold, self.notes, verbatim)
        self._motion: KeyframeMotion
        self._resumed = False
        self._begin(FactorGraph(manifold))

    def _begin(self, graph: FactorGraph) -> None:
        """Begin with a graph, of which no keyframe is known yet."""
        self.graph = graph
        self.track = OdometryTrack(graph.manifold)
        self.offset, self._level = graph.manifold.identity(1), Level(graph.manifold)
        self._moved, self._glued = False, True

    def set_options(self, options: GraphBuilderOptions) -> None:
        """Use other options from now on; what is in the graph stays."""
        self.options = options

    def add_odometry(self, sample: OdometrySample) -> bool:
        """
        Add one sample; return whether the robot is where it says, or a later one.

        If not it is late and put in its place, see `OdometryOptions`, or it is held, as its
        predecessor does not explain it, see `odometry_stream`: the next one decides.

        Raises
        ------
        MessageError : `child_frame`, it is another's, or `old_stamp`, the stamp is not after the
            last one; nothing is added.

        """
        ignore, track = self.options.on_time_jump == 'ignore', self.track
        if ignore and not self._glued and sample.stamp <= track.last_stamp:
            raise MessageError('old_stamp', f'odometry stamp {sample.stamp} ns is not after the '
                               f'last one, {track.last_stamp} ns')
        used = False
        for point in self.stream.take(sample, self._verbatim, not ignore, self._put_in_place):
            self._add(point)
            used = True
        track = self.track  # a new one, maybe
        # Loops that are due are carried by the samples as they came, so thinning waits for them.
        if track.may_be_thinned and not self.loops.waiting.is_due(track.last):
            track.thin()
        return used

    def _put_in_place(self, point: Point) -> bool:
        """
        Take a sample in that came late; return False: that is more than `odometry.reorder`.

        What is known from one keyframe to the next, stays: a message before the last one is
        dropped, and so is one of a place that the robot did not go by.

        Raises
        ------
        MessageError : `old_stamp`, it is dropped.

        """
        track, pose = self.track, point.pose
        behind = (track.last_stamp - point.stamp) * 1e-9
        if self._verbatim or not self._glued or (
                not 0 < behind <= self.options.odometry.reorder):
            return False
        if self._moved:
            pose = self.graph.manifold.compose(self.offset, pose)
        beside = track.went_by(point.stamp, pose)
        if beside is None or point.stamp < track.keyframe_stamps[-1]:
            where = 'after a later keyframe' if beside is not None else (
                'and says where the robot did not go')
            raise MessageError('old_stamp', f'odometry stamp {point.stamp} ns came {behind:.3g} s '
                               f'late, {where}; expected stamps that rise')
        self._motion.insert(point.sample, pose, beside, self.options.odometry)
        track.insert(point.stamp, pose)
        return True

    def finish(self) -> None:
        """Use the last sample of all, if it is held for a pause alone; see `held`."""
        for point in self.stream.finish():
            self._add(point)

    def _add(self, point: Point) -> None:
        """Add a sample of the robot's motion."""
        if point.anew and self._resumed:
            self._glued = False  # the odometry begins again
        elif point.anew:
            self._forget()
        on_gap, pose, manifold = self.options.on_time_jump, point.pose, self.graph.manifold
        goes_on = self._glued or self.track.goes_on(point.stamp, pose, self.offset)
        gap = self._gap(point, goes_on)
        if gap:
            self.add_due_loops()  # what came before is of that time
            cause, said = _SAID[on_gap]
            self.notes.tell(cause, f'{gap}; {said}')
            self._level = Level(manifold)
            if on_gap == 'reset':
                self._forget()
        if not self.graph.n_poses:
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
                self.loops.waiting.begin_anew(self.track.time)
            self._begin_part(point.stamp, pose)
        else:
            self._go_on(point, pose)

    def _gap(self, point: Point, goes_on: bool) -> str:
        """Return why no motion is known to a sample from the one before; empty: it is known."""
        if not self._glued and point.stamp <= self.track.last_stamp:
            return f'odometry stamp {point.stamp} ns is before the end of the map'
        if not goes_on and self.options.on_time_jump == 'new_segment':
            return f'odometry at {point.stamp} ns begins elsewhere than the map ends'
        return point.gap

    def _go_on(self, point: Point, pose: Array) -> None:
        """Continue to a sample at `pose` (1, p); where that makes a keyframe, add its factor."""
        unseen, turned = None, min(UNSEEN_TURN * point.seconds, math.pi)
        if point.gap or point.unsure:
            unseen = point.unseen, turned
        if point.unsure:
            self.notes.tell('unsure', f'{point.unsure}; it counts as uncertain by '
                            f'{point.unseen:.3g} m and {turned:.2g} rad')
        motion = self._motion.step(point.sample, pose, self.options.keyframe,
                                   self.options.odometry, self._verbatim, unseen)
        self.track.append(point.stamp, pose, motion is not None, point.reach)
        if motion is not None:
            self.notes.warn_bounds('odometry', point.stamp, self._motion.bounded, MOST_OF_ODOMETRY)
            self._note_slope(point.sample)
            self.graph.append_step(motion[0], root_of_inverse(motion[1][None]))

    def _note_slope(self, sample: OdometrySample) -> None:
        length, angle = self._level.dropped(sample, self.options.keyframe)
        if length or angle:
            self.notes.warn('slope', f'odometry at {sample.stamp} ns has left the plane by '
                            f'{length:.3g} m and {angle:.2g} rad, which are dropped; expected '
                            'dimension 3 for a robot on slopes')

    def _begin_part(self, stamp: int, pose: Array) -> None:
        """Begin a part of the map with a keyframe."""
        self.track.append(stamp, pose, is_keyframe=True)
        self.graph.add_poses(1, begins_part=True)
        self._motion = KeyframeMotion(self.graph.manifold, stamp, pose)

    def _forget(self) -> None:
        """Begin anew; loops that wait are kept, since odometry of their times may still come."""
        self._begin(FactorGraph(self.graph.manifold))
        self._resumed = False
        self.loops.forget()

    def grown(self) -> BuilderState:
        """Return what another builder goes on from; there are keyframes."""
        track, loops = self.track, self.loops
        in_graph, _, expired = loops.stamps
        return BuilderState(
            self.graph.copy(), track.keyframe_stamps, track.keyframe_poses, self.offset,
            track.last_stamp, track.last_pose,
            self._motion.covariance(self.options.odometry, self._verbatim),
            loops.rows, in_graph, expired, loops.waiting.arrivals(track.last), loops.seen(),
            loops.struck_pairs)

    def restore(self, state: BuilderState) -> None:
        """Continue where a run ended; odometry that does not continue there begins a new part."""
        self._begin(state.graph)
        # In a file a loop across a gap looks like odometry.
        steps = self.graph.between.step_to
        firsts = np.flatnonzero((steps[1:] < 0) | np.isin(steps[1:], state.loop_rows)) + 1
        self.graph.follow(firsts, NO_PREDECESSOR)
        track, stamps = self.track, state.stamps
        for part in np.split(np.arange(len(stamps)), firsts):
            track.extend_by_part(stamps[part], state.odometry[part])
        self.offset = state.offset
        self._motion = KeyframeMotion(self.graph.manifold, track.last_stamp, track.last_pose)
        if state.end > track.last_stamp:
            track.append(state.end, state.end_pose, is_keyframe=False)
            by_model = self.options.odometry.covariance_source == 'model'
            self._motion.add_known(
                state.end, state.end_pose, None if by_model else state.end_covariance)
        self._glued, self._moved, self._resumed = False, True, True
        self.stream = OdometryStream(
            self.graph.manifold, self.notes, self.base_frame, resumed=True)
        self.loops.restore(state, track, self.options.loop)

    def add_loop(self, loop: LoopClosure) -> None:
        """Take a loop closure or an absolute pose in, once; see `add_due_loops`."""
        self.loops.add(loop, self.track, self.options.loop)

    def add_due_loops(self) -> int:
        """
        Make factors of the waiting loops whose times odometry has reached; return how many.

        Loops that can never become one are counted in `refused`: `before_start` (a time before
        the first odometry), `same_keyframe`, `expired`.
        """
        return self.loops.add_due(self.graph, self.track, self.options.loop)
