# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A world that several robots drive, each with odometry of its own, and messages of theirs."""

import numpy as np
from problems import seconds

from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.parts import give_to
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops

UNKNOWN = np.zeros((6, 6))


class Team:
    """
    A world driven by robots, each a share of it, with odometry of its own, and lies.

    graph : as one file has it, one robot behind the other
    """

    def __init__(self, n=400, edges=1400, lies=300, seed=3, robots=2, world='streets'):
        options = WorldOptions(odometry_sigma_rotation=0.005)
        rng = np.random.default_rng(seed)
        world = simulate_world(n, edges, options, rng, world)
        if lies:
            world = with_false_loops(world, random_false_loops(
                world.graph, world.truth, lies, rng))
        self.half, whole = n // robots, world.graph.between
        self.robot = np.minimum(np.arange(n) // self.half, robots - 1)
        seam = (whole.j == whole.i + 1) & (np.diff(self.robot)[whole.i.clip(0, n - 2)] > 0)
        graph, self.manifold = world.graph.subset(~seam), world.graph.manifold
        self.graph = FactorGraph(self.manifold, 0)
        self.graph.add_poses(n)
        give_to(self.graph, self.robot)
        f = graph.between
        self.graph.append_between(f.i, f.j, f.measurement, f.sqrt_information)
        self.truth, self.factors = world.truth, self.graph.between
        self.odometry = self.manifold.identity(n)
        steps = self.factors.step_to
        for k in range(n):
            if steps[k] >= 0:
                self.odometry[k] = self.manifold.compose(
                    self.odometry[k - 1:k], self.factors.measurement[steps[k]][None])[0]

    def stamp(self, k):
        return seconds(10 + k % self.half)

    def sample(self, k):
        step, cov = self.factors.step_to[k], UNKNOWN
        if step >= 0:
            cov = self.covariance(step)
        pose3 = self.manifold.to_pose3(self.odometry[k:k + 1])[0]
        return OdometrySample(self.stamp(k), pose3, cov, UNKNOWN)

    def covariance(self, row):
        """Return that of a factor, as a message states it."""
        root, rows = self.factors.sqrt_information[row], np.array(self.manifold.COVARIANCE_ROWS)
        whole = np.zeros((6, 6))
        whole[rows[:, None], rows] = np.linalg.inv(root.T @ root)
        return whole

    def loops(self):
        """Yield rows of loops, and them."""
        for row in np.flatnonzero(~self.factors.is_odometry):
            i, j = self.factors.i[row], self.factors.j[row]
            yield i, j, LoopClosure(
                self.stamp(i), self.stamp(j),
                self.manifold.to_pose3(self.factors.measurement[row:row + 1])[0],
                self.covariance(row), robot=int(self.robot[j]),
                reference_robot=int(self.robot[i]))

    def messages(self, late=0):
        """Return (robot, message) as they come, those of the second robot so much later [s]."""
        events = [((k % self.half) + late * self.robot[k], 0, int(self.robot[k]), self.sample(k))
                  for k in range(len(self.robot))]
        events += [(max(i % self.half + late * self.robot[i], j % self.half + late * self.robot[
            j]), 1, int(self.robot[j]), found) for i, j, found in self.loops()]
        return [event[2:] for event in sorted(events, key=lambda event: event[:2])]

    def fill(self, backend, late=0):
        for robot, message in self.messages(late):
            if isinstance(message, LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message, robot)

    def believed(self):
        """Return what the batch solver believes: robots and stamps of loops."""
        rows = robust_solve(self.graph)[0].accepted & ~self.factors.is_odometry
        return {(int(self.robot[i]), int(self.robot[j]), self.stamp(i), self.stamp(j))
                for i, j in zip(self.factors.i[rows], self.factors.j[rows], strict=True)}


def believed_by(now):
    """Return what a snapshot of a back end believes: robots and stamps of loops."""
    states, robots = now.loop_states(), now.loop_robots[0]
    return {(*robots[row].tolist(), *states.stamps[row].tolist())
            for row in np.flatnonzero(states.state[:len(robots)] == ACCEPTED)}
