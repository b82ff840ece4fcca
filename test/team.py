# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A world that several robots drive, each with odometry of its own, and messages of theirs."""

import tempfile
from pathlib import Path

import numpy as np
from backends import covariances_of, odometry_of, simulated
from heard import UNKNOWN, seconds
from records import information_of

import l1slam_ros as l1


class Team:
    """A world driven by robots, each a share of it, with odometry of its own, and lies."""

    def __init__(self, n=400, edges=1400, lies=300, seed=3, robots=2, world='streets'):
        false = ('--false-loops', lies) if lies else ()
        with tempfile.TemporaryDirectory() as name:
            whole = simulated(Path(name), n, edges, '--seed', seed, '--world', world, *false)
        self.share = n // robots
        self.robot = np.minimum(np.arange(n) // self.share, robots - 1)
        self.truth, self.manifold = whole.truth, whole.graph.manifold
        factors = whole.graph.between
        seam = factors.is_odometry & (np.diff(self.robot)[factors.i.clip(0, n - 2)] > 0)
        self._measured = whole.graph.subset(~seam)
        graph = self._graph()
        self._factors, self._covariances = graph.between, covariances_of(graph)
        self.odometry = odometry_of(graph)

    def _graph(self):
        """Return the graph of all."""
        factors, graph = self._measured.between, l1.FactorGraph(self.manifold)
        for robot in self.robot.tolist():
            graph.add_poses(1, robot)
        graph.add_between(factors.i, factors.j, factors.measurement,
                          information_of(self._measured))
        return graph

    def number(self, k):
        """Return which keyframe of its robot one is."""
        return k % self.share

    def stamp(self, k):
        return seconds(10 + self.number(k))

    def sample(self, k):
        step = self._factors.step_to[k]
        return l1.OdometrySample(
            self.stamp(k), self.manifold.to_pose3(self.odometry[k:k + 1])[0],
            self._covariances[step] if step >= 0 else UNKNOWN, UNKNOWN)

    def loops(self):
        """Yield the keyframes of loops, and them."""
        factors = self._factors
        for row in np.flatnonzero(~factors.is_odometry):
            i, j = factors.i[row], factors.j[row]
            yield i, j, l1.LoopClosure(
                self.stamp(i), self.stamp(j),
                self.manifold.to_pose3(factors.measurement[row:row + 1])[0],
                self._covariances[row], robot=int(self.robot[j]),
                reference_robot=int(self.robot[i]))

    def messages(self, late=0):
        """Return (robot, message) as they come, those of the second robot so much later [s]."""
        def when(k):
            return self.number(k) + late * self.robot[k]

        events = [(when(k), 0, int(self.robot[k]), self.sample(k)) for k in range(len(self.robot))]
        events += [(max(when(i), when(j)), 1, int(self.robot[j]), found)
                   for i, j, found in self.loops()]
        return [event[2:] for event in sorted(events, key=lambda event: event[:2])]

    def believed(self):
        """Return what the batch solver believes: robots and stamps of loops."""
        graph = self._graph()
        rows = l1.solve(graph).inliers & ~graph.between.is_odometry
        return {(int(self.robot[i]), int(self.robot[j]), self.stamp(i), self.stamp(j))
                for i, j in graph.between.pairs[rows]}

    def error(self, poses, robot, seen_from=0):
        """Return how far positions of a robot are off at most, as a keyframe sees them [m]."""
        truth = self.truth[self.robot == robot]
        truth = self.manifold.between(np.broadcast_to(self.truth[seen_from], truth.shape), truth)
        off = self.manifold.positions(poses) - self.manifold.positions(truth)
        return np.abs(off).max()


class Restarts(Team):
    """Three robots, of which 1 and 2 begin again at some keyframe, far off in their odometry."""

    def __init__(self, at, **of_team):
        super().__init__(robots=3, **of_team)
        far = np.linspace(0.3, 0.1, self.manifold.TANGENT_SIZE)
        far[:2] = 300.0, 200.0
        far = self.manifold.retract(self.manifold.identity(1), far[None])
        for first in (robot * self.share + at for robot in (1, 2)):
            part = self.odometry[first:first - at + self.share]
            part[:] = self.manifold.compose(np.broadcast_to(far, part.shape), part)


def fill(backend, messages):
    """Let a back end hear of messages, (robot, message) each."""
    for robot, message in messages:
        if isinstance(message, l1.LoopClosure):
            backend.add_loop(message)
        else:
            backend.add_odometry(message, robot)


def poses_of(backend, robot):
    """Return the keyframes of a robot in the map that it is in, (k, p)."""
    return backend.snapshot().poses_in_map(robot)[1]
