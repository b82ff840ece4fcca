# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loop closures that wait for odometry to reach their times, until they expire."""

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.measurements import LoopClosure


@dataclass(frozen=True)
class WaitingLoop:
    """
    A loop, and what it says on the manifold.

    arrival, begin, end : times [ns], when it came, and what its stamps mean; measurement : (1, p);
    covariance : (1, d, d), sound, zeros where it says nothing; key : what equal loops have in
    common.
    """

    loop: LoopClosure
    arrival: int
    begin: int
    end: int
    measurement: Array
    covariance: Array
    key: bytes


class WaitingLoops:
    """Loops by the times they wait for; each costs O(log n) once, however long it waits."""

    def __init__(self) -> None:
        # By number, in the order they came.
        self._loops: dict[int, WaitingLoop] = {}
        self._by_end: list[tuple[int, int]] = []
        self._count = 0
        self._stamps: Indices | None = None

    def __len__(self) -> int:
        return len(self._loops)

    def all(self) -> Iterable[WaitingLoop]:
        """Return the loops in the order they came."""
        return self._loops.values()

    def add(self, waiting: WaitingLoop) -> None:
        """Add a loop, which comes not before those that are there."""
        self._loops[self._count] = waiting
        heapq.heappush(self._by_end, (waiting.end, self._count))
        self._count += 1
        self._stamps = None

    def is_due(self, now: int) -> bool:
        """Tell whether odometry has reached the times of any loop."""
        return bool(self._by_end) and self._by_end[0][0] <= now

    def due(self, now: int) -> list[WaitingLoop]:
        """Take out the loops whose times odometry has reached by `now`, in the order they came."""
        due = []
        while self._by_end and self._by_end[0][0] <= now:
            _, number = heapq.heappop(self._by_end)
            if number in self._loops:  # else it has expired
                due.append(number)
        return [self._take(number) for number in sorted(due)]

    def expired(self, since: int) -> list[WaitingLoop]:
        """Take out the loops that came before `since`, in the order they came."""
        early = takewhile(lambda item: item[1].arrival < since, self._loops.items())
        numbers = [number for number, _ in early]
        return [self._take(number) for number in numbers]

    def begin_anew(self, time: Callable[[int], int], arrival: int | None = None) -> None:
        """
        Interpret all stamps again, after the odometry went back in time.

        time : of a stamp; arrival : when all are to have come, None: as they did
        """
        self._loops = {number: replace(
            one, begin=time(one.loop.stamps[0]), end=time(one.loop.stamp),
            arrival=one.arrival if arrival is None else arrival)
            for number, one in self._loops.items()}
        self._by_end = [(one.end, number) for number, one in self._loops.items()]
        heapq.heapify(self._by_end)

    def arrivals(self, now: int) -> tuple[tuple[LoopClosure, int], ...]:
        """Return each loop and how long it has waited until `now`, in the order they came."""
        return tuple((one.loop, now - one.arrival) for one in self._loops.values())

    def stamps(self) -> Indices:
        """Return reference and end [ns] of each that is no strike of one, (k, 2)."""
        if self._stamps is None:
            self._stamps = np.array([one.loop.stamps for one in self._loops.values()
                                     if not one.loop.struck], np.int64).reshape(-1, 2)
        return self._stamps

    def _take(self, number: int) -> WaitingLoop:
        self._stamps = None
        return self._loops.pop(number)
