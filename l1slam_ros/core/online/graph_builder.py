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

Of one robot or of several: their keyframes come in any order, each follows one of its own robot.
Where a robot's odometry does not go on, see `robot_odometry`. A robot begins a part of the map.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import NO_PREDECESSOR, FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, Notes, OdometrySample
from l1slam_ros.core.online.builder_state import BuilderState
from l1slam_ros.core.online.loops.loop_factors import LoopFactors
from l1slam_ros.core.online.odometry.odometry_stream import BaseFrame
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.core.online.robot_odometry import GrowingGraph, RobotOdometry


class GraphBuilder:
    """
    Grows a factor graph from messages.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `GraphBuilderOptions`
    verbatim : the messages are those of a graph: each is a measurement as it is stated, none a
        loop sent again or odometry that jumps
    base_frames : of each robot by its number, what tells whose odometry it is; None: by the
        options alone

    Attributes
    ----------
    robots : the odometry of each robot, by its number

    """

    def __init__(self, manifold: Manifold, options: GraphBuilderOptions, verbatim: bool = False,
                 base_frames: Callable[[int], BaseFrame] | None = None):
        self._base_frame_of = base_frames or cache(lambda _: BaseFrame(options.base_frame))
        self._shared = GrowingGraph(manifold, options, verbatim)
        self.robots: dict[int, RobotOdometry] = {}
        self._odometry_of(0)

    def _odometry_of(self, robot: int) -> RobotOdometry:
        if robot not in self.robots:
            self.robots[robot] = RobotOdometry(
                robot, self._shared, self._base_frame_of(robot))
        return self.robots[robot]

    @property
    def options(self) -> GraphBuilderOptions:
        """The options as they are now."""
        return self._shared.options

    @property
    def graph(self) -> FactorGraph:
        """The factor graph so far; loops enter it in `add_due_loops`."""
        return self._shared.graph

    @property
    def loops(self) -> LoopFactors:
        """Those in the graph, and those that wait."""
        return self._shared.loops

    @property
    def notes(self) -> Notes:
        """Notes on messages that were refused, or used with a correction."""
        return self._shared.notes

    @property
    def keyframe_stamps(self) -> Indices:
        """Stamps of all keyframes, (n,) [ns]."""
        return self._shared.tracks.keyframe_stamps

    @property
    def keyframe_poses(self) -> Array:
        """Poses of all keyframes in what is kept of their odometry, (n, p)."""
        return self._shared.tracks.keyframe_poses

    def set_options(self, options: GraphBuilderOptions) -> None:
        """Use other options from now on; what is in the graph stays."""
        self._shared.options = options

    def add_odometry(self, sample: OdometrySample, robot: int = 0) -> bool:
        """
        Add one sample of a robot; return whether the robot is where it says, or a later one.

        If not it is late and put in its place, see `OdometryOptions`, or it is held, as its
        predecessor does not explain it, see `odometry_stream`: the next one decides.

        Raises
        ------
        MessageError : `child_frame`, it is another's, or `old_stamp`, the stamp is not after the
            last one; nothing is added.

        """
        return self._odometry_of(robot).add(sample)

    def finish(self) -> None:
        """Use the last sample of each robot, if only a pause before it is why it is held."""
        for one in self.robots.values():
            one.finish()

    def grown(self) -> BuilderState:
        """Return the state from which another builder continues; there is a keyframe at least."""
        tracks = self._shared.tracks
        return BuilderState(
            self.graph.copy(), self.keyframe_stamps, self.keyframe_poses,
            tuple(self.robots[robot].end() for robot in tracks.begun), self.loops.state(tracks))

    def restore(self, state: BuilderState) -> None:
        """Continue where a run ended; odometry that does not continue there begins a new part."""
        self._shared.begin(state.graph)
        # In a file a loop across a gap looks like odometry.
        steps = self.graph.between.step_to
        firsts = np.flatnonzero((steps[1:] < 0) | np.isin(steps[1:], state.loops.rows)) + 1
        self.graph.follow(firsts, NO_PREDECESSOR)
        for end in state.ends:
            of_robot = np.flatnonzero(self.graph.robot == end.robot)
            self._odometry_of(end.robot).restore(
                end, state.stamps[of_robot], state.odometry[of_robot], of_robot, firsts)
        self.loops.restore(state.loops, self._shared.tracks, self.options.loop)

    def add_loop(self, loop: LoopClosure) -> None:
        """Take a loop closure or an absolute pose in, once; see `add_due_loops`."""
        self.loops.add(loop, self._shared.tracks, self.options.loop)

    def add_due_loops(self) -> int:
        """
        Make factors of the waiting loops whose times odometry has reached; return how many.

        Loops that can never become one are counted in `refused`: `before_start` (a time before
        the first odometry), `same_keyframe`, `expired`.
        """
        return self._shared.add_due_loops()
