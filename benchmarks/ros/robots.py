# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What several robots in one back end cost.

    python benchmarks/ros/robots.py [--keyframes 10000] [--timed 500]

A simulated drive is fed to a back end as that of one robot, and cut into five whose keyframes
interleave. The last keyframes come one by one, each with its loops and an update: printed are the
median and the 99th percentile of an update, and how the latter compares. Then two robots, each
with half of the keyframes, that nothing joins yet: the loops between them come at once, and
updates go on until all is in one map. Printed are the longest update, and after what time the
second robot was in the map of the first. What goes on behind updates has the other core.
"""

import argparse
import time

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

KEYFRAMES, TIMED, ROBOTS = 10_000, 500, 5
# An update as often as the node makes one, and no budget: what goes on behind is not waited for.
_PERIOD, _SECOND = 0.05, 10**9
_UNKNOWN = np.zeros((6, 6))
# [s] A join that takes longer is given up.
_PATIENCE = 60.0
_OPTIONS = BackendOptions.from_mapping({
    'keyframe': {'translation': 0.0, 'rotation': 0.0}, 'on_time_jump': 'ignore',
    'odometry': {'covariance_source': 'increment'}})


class Drive:
    """A simulated drive, cut into as many robots, each with odometry of its own."""

    def __init__(self, keyframes: int, robots: int):
        world = simulate_world(keyframes, 5 * keyframes // 2, WorldOptions(
            odometry_sigma_rotation=0.005), np.random.default_rng(0))
        self.factors, self.part = world.graph.between, keyframes // robots
        self.robot = np.minimum(np.arange(keyframes) // self.part, robots - 1)
        self.pose3 = se2.to_pose3(odometry_poses(world.graph))
        # In the order they come: the k-th keyframe of each robot, then of each the next.
        self.order = np.argsort(self._within(np.arange(keyframes)), kind='stable')
        place = np.argsort(self.order)
        loops = np.flatnonzero(~self.factors.is_odometry)
        self.last = np.maximum(place[self.factors.i[loops]], place[self.factors.j[loops]])
        self.loops = loops[np.argsort(self.last, kind='stable')]
        self.last = np.sort(self.last)

    def _within(self, keyframes: np.ndarray) -> np.ndarray:
        return np.asarray(keyframes - self.robot[keyframes] * self.part)

    def _stamp(self, keyframe: int) -> int:
        return (int(self._within(np.array(keyframe))) + 1) * _SECOND

    def add(self, backend: Backend, at: int) -> None:
        """Let the keyframe come that is at some place of the order."""
        keyframe = int(self.order[at])
        step = self.factors.step_to[keyframe]
        backend.add_odometry(OdometrySample(
            self._stamp(keyframe), self.pose3[keyframe], self._covariance(step), _UNKNOWN),
            int(self.robot[keyframe]))

    def loops_of(self, at: int) -> list[LoopClosure]:
        """Return the loops that keyframe is the last of."""
        rows = self.loops[np.searchsorted(self.last, at):np.searchsorted(self.last, at + 1)]
        return [self._loop(row) for row in rows.tolist()]

    def _loop(self, row: int) -> LoopClosure:
        i, j = int(self.factors.i[row]), int(self.factors.j[row])
        return LoopClosure(
            self._stamp(i), self._stamp(j), se2.to_pose3(self.factors.measurement[row][None])[0],
            self._covariance(row), robot=int(self.robot[j]), reference_robot=int(self.robot[i]))

    def _covariance(self, row: int) -> np.ndarray:
        covariance = np.zeros((6, 6))
        root = self.factors.sqrt_information[row]
        covariance[np.ix_((0, 1, 5), (0, 1, 5))] = np.linalg.inv(root.T @ root)
        return covariance


def updates(keyframes: int, timed: int, robots: int) -> float:
    """Print how long updates take while the last keyframes come; return the 99th percentile."""
    drive, seconds = Drive(keyframes, robots), []
    with Backend(_OPTIONS) as backend:
        for at in range(keyframes):
            drive.add(backend, at)
            for loop in drive.loops_of(at):
                backend.add_loop(loop)
            if at == keyframes - timed:
                backend.settle()
            elif at > keyframes - timed:
                seconds.append(_update(backend))
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    print(f'{robots} robot{"s" * (robots > 1)}, {keyframes:,} keyframes in all: an update takes '
          f'{p50:.1f} ms in the median, p99 {p99:.1f} ms, at most {max(seconds) * 1e3:.1f} ms',
          flush=True)
    return float(p99)


def rendezvous(keyframes: int) -> None:
    """Print what it takes to join two maps."""
    drive, between, seconds = Drive(keyframes, 2), [], []
    with Backend(_OPTIONS) as backend:
        for at in range(keyframes):
            drive.add(backend, at)
            for loop in drive.loops_of(at):
                if loop.robot == loop.reference_robot:
                    backend.add_loop(loop)
                else:
                    between.append(loop)
        backend.settle()
        robot = backend.robot(1)
        joined = robot is not None and robot.joined
        print(f'two maps of {keyframes // 2:,}, in one by now: {joined}')
        for loop in between:
            backend.add_loop(loop)
        began = time.monotonic()
        while time.monotonic() < began + _PATIENCE:
            seconds.append(_update(backend))
            robot = backend.robot(1)
            if robot is not None and robot.joined:
                break
        print(f'{len(between)} loops between them: updates take {max(seconds) * 1e3:.1f} ms at '
              f'most, in one map after {time.monotonic() - began:.2f} s')


def _update(backend: Backend) -> float:
    """Update, wait for the next period; return how long the update took [s]."""
    began = time.monotonic()
    backend.update(0.0)
    took = time.monotonic() - began
    time.sleep(max(_PERIOD - took, 0.0))
    return took


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--keyframes', type=int, default=KEYFRAMES)
    parser.add_argument('--timed', type=int, default=TIMED, help='keyframes with an update each')
    given = parser.parse_args()
    one = updates(given.keyframes, given.timed, 1)
    print(f'ratio of p99: {updates(given.keyframes, given.timed, ROBOTS) / one:.2f}')
    rendezvous(given.keyframes)


if __name__ == '__main__':
    main()
