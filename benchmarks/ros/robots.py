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

    python benchmarks/ros/robots.py [--keyframes 10000] [--timed 500] [--seeds 5]

A simulated drive is fed to a back end as that of one robot, and cut into five whose keyframes
interleave. Five robots close more loops at the end of the drive than one does: a third back end
gets as many of them, drawn, as one robot has. The last keyframes come one by one, to the three
back ends by turns, each with its loops and an update. Printed are the median and the 99th
percentile of an update, of the processor in its thread. At the end the 99th percentiles of all
updates are compared, of drives of several seeds, and the ratios of each drive. One drive says
little: its 99th percentile is that of five updates, and how long the ways in the elimination tree
are differs by half from drive to drive, whoever drives it.

Then two robots, each with half of the keyframes, that nothing joins yet: the loops between them
come at once, and updates go on until all is in one map. Printed are the longest update, and after
what time the second robot was in the map of the first. What goes on behind updates has the other
core.
"""

import argparse
import statistics
import time
from contextlib import ExitStack

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

KEYFRAMES, TIMED = 10_000, 500
ROBOTS, SEEDS = 5, 5
# Keyframes with an update that is not timed.
_WARM = 10
# An update as often as the node makes one, and no budget: what goes on behind is not waited for.
_PERIOD, _SECOND = 0.05, 10**9
_UNKNOWN = np.zeros((6, 6))
# Keyframes that are driven before a rendezvous: whoever meets has drawn maps before.
_DRIVEN = 50
# [s] A join that takes longer is given up.
_PATIENCE = 60.0
_OPTIONS = BackendOptions.from_mapping({
    'keyframe': {'translation': 0.0, 'rotation': 0.0}, 'on_time_jump': 'ignore',
    'odometry': {'covariance_source': 'increment'}})


class Drive:
    """A simulated drive, cut into as many robots, each with odometry of its own."""

    def __init__(self, keyframes: int, robots: int, seed: int = 0):
        world = simulate_world(keyframes, 5 * keyframes // 2, WorldOptions(
            odometry_sigma_rotation=0.005), np.random.default_rng(seed))
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

    def thin(self, begin: int, count: int) -> None:
        """Leave out loops of the keyframes from a place of the order on, but for so many."""
        rng, late = np.random.default_rng(0), np.flatnonzero(self.last >= begin)
        gone = rng.choice(late, max(len(late) - count, 0), replace=False)
        self.loops, self.last = (np.delete(values, gone) for values in (self.loops, self.last))

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


def drives_of(keyframes: int, timed: int, seed: int) -> dict[str, Drive]:
    """Return a drive as that of one robot, of five, and of five with as many loops at the end."""
    one, five, fewer = (Drive(keyframes, robots, seed) for robots in (1, ROBOTS, ROBOTS))
    begin = keyframes - timed
    fewer.thin(begin, int(np.count_nonzero(one.last >= begin)))
    return {'one': one, 'five': five, 'five, as many loops': fewer}


def updates(drives: dict[str, Drive], keyframes: int, timed: int) -> dict[str, list[float]]:
    """Print how long updates take while the last keyframes come; return how long each [s]."""
    begin = keyframes - timed
    seconds: dict[str, list[float]] = {name: [] for name in drives}
    with ExitStack() as stack:
        driven = {name: (drive, stack.enter_context(Backend(_OPTIONS)))
                  for name, drive in drives.items()}
        for drive, backend in driven.values():
            for at in range(begin):
                _come(drive, backend, at)
            backend.settle()
        for at in range(begin, keyframes):
            names = list(driven)
            began, first = time.monotonic(), at % len(names)
            for name in names[first:] + names[:first]:
                drive, backend = driven[name]
                _come(drive, backend, at)
                seconds[name].append(_updated(backend)[1])
            time.sleep(max(began + _PERIOD - time.monotonic(), 0.0))
    for name, drive in drives.items():
        del seconds[name][:_WARM]
        median, most = np.percentile(seconds[name], (50, 99)) * 1e3
        loops = np.count_nonzero(drive.last >= begin + _WARM) / (timed - _WARM)
        print(f'  {name}: {loops:.2f} loops an update, {median:.2f} ms of the processor in the '
              f'median, p99 {most:.2f} ms', flush=True)
    return seconds


def ratios(keyframes: int, timed: int, seeds: int) -> None:
    """Print how the 99th percentiles of several robots compare with that of one."""
    found: dict[str, list[list[float]]] = {}
    for seed in range(seeds):
        print(f'drive {seed}, {keyframes:,} keyframes in all', flush=True)
        of_drive = updates(drives_of(keyframes, timed, seed), keyframes, timed)
        for name, seconds in of_drive.items():
            found.setdefault(name, []).append(seconds)
    of_one = next(iter(found.values()))
    for name, ours in found.items():
        median, most = np.percentile(np.concatenate(ours), (50, 99)) * 1e3
        over = most / (np.percentile(np.concatenate(of_one), 99) * 1e3)
        of_drives = [float(np.percentile(own, 99) / np.percentile(other, 99))
                     for own, other in zip(ours, of_one, strict=True)]
        print(f'{name}, all {seeds} drives: median {median:.2f} ms, p99 {most:.2f} ms, {over:.2f} '
              f'times that of one; of a drive {statistics.median(of_drives):.2f} times in the '
              f'median, {min(of_drives):.2f} to {max(of_drives):.2f}', flush=True)


def _come(drive: Drive, backend: Backend, at: int) -> None:
    """Let a keyframe come, and the loops that it is the last of."""
    drive.add(backend, at)
    for loop in drive.loops_of(at):
        backend.add_loop(loop)


def rendezvous(keyframes: int) -> None:
    """Print what it takes to join two maps."""
    drive = Drive(keyframes, 2)
    between = []
    seconds = []
    with Backend(_OPTIONS) as backend:
        for at in range(keyframes):
            drive.add(backend, at)
            for loop in drive.loops_of(at):
                if loop.robot == loop.reference_robot:
                    backend.add_loop(loop)
                else:
                    between.append(loop)
            if at == keyframes - _DRIVEN:
                backend.settle()
            elif at > keyframes - _DRIVEN:
                _update(backend)
        backend.settle()
        robot = backend.robot(1)
        joined = robot is not None and robot.joined
        print(f'two maps of {keyframes // 2:,}, in one by now: {joined}')
        for loop in between:
            backend.add_loop(loop)
        began, busy = time.monotonic(), time.process_time()
        while time.monotonic() < began + _PATIENCE:
            seconds.append(_update(backend))
            robot = backend.robot(1)
            if robot is not None and robot.joined:
                break
        took, busy = time.monotonic() - began, time.process_time() - busy
        print(f'{len(between)} loops between them: updates take {max(seconds) * 1e3:.1f} ms at '
              f'most, in one map after {took:.2f} s, {busy:.2f} s of the processor')


def _update(backend: Backend) -> float:
    """Update, wait for the next period; return how long it took by the clock [s]."""
    took, _ = _updated(backend)
    time.sleep(max(_PERIOD - took, 0.0))
    return took


def _updated(backend: Backend) -> tuple[float, float]:
    """Update; return how long it took, by the clock and of the processor in this thread [s]."""
    began, busy = time.monotonic(), time.thread_time()
    backend.update(0.0)
    return time.monotonic() - began, time.thread_time() - busy


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--keyframes', type=int, default=KEYFRAMES)
    parser.add_argument('--timed', type=int, default=TIMED, help='keyframes with an update each')
    parser.add_argument('--seeds', type=int, default=SEEDS, help='how many drives')
    given = parser.parse_args()
    ratios(given.keyframes, given.timed, given.seeds)
    rendezvous(given.keyframes)


if __name__ == '__main__':
    main()
