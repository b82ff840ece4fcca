# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures that wait for odometry to reach their times, until they expire.

A loop between two robots waits first for the odometry of the one that it is a pose of, then for
that of the other, on the clock of each.
"""

import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.measurements import LoopClosure

# So many times of loops that do not wait any more are no burden.
_FEW = 100


@dataclass(frozen=True)
class WaitingLoop:
    """
    A loop that waits, and its measurement on the manifold.

    begin, end : times [ns], what its stamps mean; arrivals : when it came, by the clocks of the
    robots of these; measurement : (1, p); covariance : (1, d, d), sound, zeros where it says
    nothing; key : what equal loops have in common.
    """

    loop: LoopClosure
    arrivals: tuple[int, int]
    begin: int
    end: int
    measurement: Array
    covariance: Array
    key: bytes

    @property
    def arrival(self) -> int:
        """When it came, by the clock of the robot whose pose it is [ns]."""
        return self.arrivals[1]

    def awaits(self, clocks: Mapping[int, int]) -> int | None:
        """Return the robot whose odometry has not reached the loop's time; None: both have."""
        one, other = self.loop.robots
        if other not in clocks or clocks[other] < self.end:
            return other
        if one != other and (one not in clocks or clocks[one] < self.begin):
            return one
        return None

    def time_of(self, robot: int) -> int:
        """Return its time on the clock of one of its robots, the later one [ns]."""
        return self.end if robot == self.loop.robot else self.begin


class _Queue:
    """Loops that wait for the odometry of one robot; each costs O(log n) once."""

    def __init__(self, robot: int) -> None:
        self._robot = robot
        # By number, in the order they came; and since when they wait [ns].
        self.loops: dict[int, tuple[WaitingLoop, int]] = {}
        self._by_time: list[tuple[int, int]] = []

    def add(self, number: int, waiting: WaitingLoop, since: int) -> None:
        self.loops[number] = waiting, since
        heapq.heappush(self._by_time, (waiting.time_of(self._robot), number))

    def is_due(self, now: int) -> bool:
        return bool(self._by_time) and self._by_time[0][0] <= now

    def due(self, now: int) -> dict[int, WaitingLoop]:
        due = {}
        while self.is_due(now):
            _, number = heapq.heappop(self._by_time)
            if number in self.loops:  # else it has expired
                due[number] = self.loops.pop(number)[0]
        return due

    def expired(self, since: int) -> list[WaitingLoop]:
        early = list(takewhile(lambda item: item[1][1] < since, self.loops.items()))
        found = [self.loops.pop(number)[0] for number, _ in early]
        self._tidy()
        return found

    def first(self) -> WaitingLoop:
        """Take out the one that came first."""
        first = self.loops.pop(next(iter(self.loops)))[0]
        self._tidy()
        return first

    def change(self, how: Callable[[WaitingLoop], WaitingLoop], since: int | None) -> None:
        """Let the loops be others of the same numbers; since : when they have waited since."""
        self.loops = {number: (how(one), before if since is None else since)
                      for number, (one, before) in self.loops.items()}
        self._sort()

    def _tidy(self) -> None:
        """Forget the times of loops that were taken out, where they are most of all."""
        if len(self._by_time) > 2 * len(self.loops) + _FEW:
            self._sort()

    def _sort(self) -> None:
        self._by_time = [(one.time_of(self._robot), number)
                         for number, (one, _) in self.loops.items()]
        heapq.heapify(self._by_time)


class WaitingLoops:
    """Loops by the times they wait for; each costs O(log n) once, however long it waits."""

    def __init__(self) -> None:
        self._queues: dict[int, _Queue] = {}
        self._count = 0
        self._told: tuple[Indices, Indices] | None = None

    def __len__(self) -> int:
        return sum(len(queue.loops) for queue in self._queues.values())

    def all(self) -> list[WaitingLoop]:
        """Return the loops in the order they came."""
        queues = [queue.loops.items() for queue in self._queues.values()]
        numbered = [item for items in queues for item in items]
        if len(queues) > 1:
            numbered.sort(key=lambda item: item[0])
        return [one for _, (one, _) in numbered]

    def add(self, waiting: WaitingLoop) -> None:
        """Add a loop, which comes not before those that are there."""
        self._put(waiting.loop.robot, self._count, waiting, waiting.arrival)
        self._count += 1

    def is_due(self, robot: int, now: int) -> bool:
        """Tell whether the odometry of a robot has reached the times of any loop."""
        return robot in self._queues and self._queues[robot].is_due(now)

    def due(self, clocks: Mapping[int, int]) -> list[WaitingLoop]:
        """Take out the loops whose times odometry has reached, in the order they came."""
        found: dict[int, WaitingLoop] = {}
        for robot, now in clocks.items():
            if robot in self._queues:
                found.update(self._queues[robot].due(now))
        due: dict[int, WaitingLoop] = {}
        for number, one in sorted(found.items()):
            other = one.awaits(clocks)
            if other is None:
                due[number] = one
            else:  # the other one's odometry is behind
                self._put(other, number, one, clocks.get(other, 0))
        self._told = None if due else self._told
        return list(due.values())

    def expired(self, robot: int, since: int) -> list[WaitingLoop]:
        """Take out those that wait for a robot since before `since`, in the order they came."""
        early = self._queues[robot].expired(since) if robot in self._queues else []
        self._told = None if early else self._told
        return early

    def crowded(self, most: int) -> WaitingLoop | None:
        """Take out one of those that wait for the same robot as most do, if more than so many."""
        if len(self) <= most:
            return None
        self._told = None
        return max(self._queues.values(), key=lambda queue: len(queue.loops)).first()

    def begin_anew(self, time: Callable[[int], int], robot: int) -> None:
        """Interpret the stamps of a robot again by `time`, after its odometry went back."""
        def how(one: WaitingLoop) -> WaitingLoop:
            (begins, ends), (first, last) = one.loop.robots, one.loop.stamps
            return replace(one, begin=time(first) if begins == robot else one.begin,
                           end=time(last) if ends == robot else one.end)

        for queue in self._queues.values():
            queue.change(how, None)

    def forget_clocks(self) -> None:
        """Let stamps be times, and all have come at the beginning of time."""
        for queue in self._queues.values():
            queue.change(lambda one: replace(
                one, begin=one.loop.stamps[0], end=one.loop.stamp, arrivals=(0, 0)), 0)

    def arrivals(self, clocks: Mapping[int, int]) -> tuple[tuple[LoopClosure, int], ...]:
        """Return each loop and how long it has waited by now, in the order they came."""
        return tuple((one.loop, clocks.get(one.loop.robot, 0) - one.arrival)
                     for one in self.all())

    def stamps(self) -> Indices:
        """Return reference and end [ns] of each that is no strike of one, (k, 2)."""
        return self._of_loops()[0]

    def robots(self) -> Indices:
        """Return whose times these are, (k, 2)."""
        return self._of_loops()[1]

    def _of_loops(self) -> tuple[Indices, Indices]:
        if self._told is None:
            loops = [one.loop for one in self.all() if not one.loop.struck]
            stamps, robots = (np.array(pairs, np.int64).reshape(-1, 2) for pairs in (
                [loop.stamps for loop in loops], [loop.robots for loop in loops]))
            self._told = stamps, robots
        return self._told

    def _put(self, robot: int, number: int, waiting: WaitingLoop, since: int) -> None:
        self._told = None
        if robot not in self._queues:
            self._queues[robot] = _Queue(robot)
        self._queues[robot].add(number, waiting, since)
