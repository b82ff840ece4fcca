# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A queue of scans that wait for odometry before and after their stamps, and for their turn.

In: scans and poses of wheel odometry, in the order of their stamps. Out: scans with the pose at
their stamps. If they are taken too slowly, every other one is dropped and counted.
"""

from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.points import Scan

# Largest numbers of scans and poses that wait for each other: some seconds of fast sensors.
_MOST_SCANS, _MOST_POSES = 100, 5000
# [ns] Stamps that go back by more are of another time; otherwise a message came late.
_BACK = 500_000_000


class ScanQueue:
    """
    Pairs scans with wheel odometry, for a single thread.

    Parameters
    ----------
    backlog : returns the number of scans that may wait for their turn, see above

    Attributes
    ----------
    counts : `left_out`: there was no time for them, `expired`: no odometry surrounded them,
        `old_stamp`: not after the one before
    restarts : how often time went back

    """

    def __init__(self, backlog: Callable[[], int]) -> None:
        self._backlog = backlog
        self.counts: Counter[str] = Counter()
        self.restarts = 0
        self._scans: deque[Scan] = deque()
        self._ready: deque[tuple[Scan, Array]] = deque()
        self._wheels: deque[tuple[int, Array]] = deque(maxlen=_MOST_POSES)
        self._back = self._newest = 0

    @property
    def waiting(self) -> int:
        """Number of scans that wait for odometry."""
        return len(self._scans)

    def add_wheels(self, stamp: int, pose: Array) -> None:
        """Add a pose (3,) of wheel odometry at a stamp [ns]."""
        if self._wheels and stamp <= self._wheels[-1][0]:
            if not self._went_back(stamp):
                self.counts['old_stamp'] += 1
                return
            self._wheels.clear()
            self._scans.clear()
            self._newest = 0
            self.restarts += 1
        self._back = 0
        self._wheels.append((stamp, pose))

    def _went_back(self, stamp: int) -> bool:
        """Tell whether time went back: two stamps in a row are much earlier, and ascend."""
        before = self._back
        self._back = stamp
        return 0 < before < stamp <= self._wheels[-1][0] - _BACK

    def add_scan(self, scan: Scan) -> None:
        """Add a scan."""
        if scan.stamp <= self._newest:
            if self._newest - scan.stamp < _BACK:
                self.counts['old_stamp'] += 1
                return
            # Another time; the stamps of the wheel odometry will go back, too.
            self._scans.clear()
        self._newest = scan.stamp
        self._scans.append(scan)
        # Scans here wait for odometry; later they wait only for their turn.
        if len(self._scans) > max(_MOST_SCANS, self._backlog()):
            self._scans.popleft()
            self.counts['expired'] += 1

    def take(self, wait: float) -> tuple[Scan, Array] | None:
        """
        Return the next scan and the pose (3,) of the wheels at its stamp; None if there is none.

        wait : [s] how long a scan waits for odometry, by the stamps of later scans
        """
        longest = int(wait * 1e9)
        while self._scans:
            scan = self._scans[0]
            found = self._at(scan.stamp, longest)
            if found is None and self._may_come(scan.stamp, longest):
                break
            self._scans.popleft()
            if found is None:
                self.counts['expired'] += 1
            else:
                self._ready.append((self._driven(scan, found), found))
        if (waiting := len(self._ready)) > self._backlog():
            # The newest stays; scans that are evenly spaced are easier to match.
            self._ready = deque([*self._ready][(waiting - 1) % 2 :: 2])
            self.counts['left_out'] += waiting - len(self._ready)
        return self._ready.popleft() if self._ready else None

    def _at(self, stamp: int, longest: int) -> Array | None:
        """Return the pose (3,) of the wheels at a stamp; None if it is unknown."""
        wheels = self._wheels
        while len(wheels) > 1 and wheels[1][0] <= stamp:
            wheels.popleft()
        if not wheels or stamp < wheels[0][0]:
            return None
        (begin, first) = wheels[0]
        if stamp == begin:
            return first
        if len(wheels) < 2 or wheels[1][0] - begin > longest:
            return None
        (end, last) = wheels[1]
        fraction = np.array([(stamp - begin) / (end - begin)])
        return se2.interpolate(first[None], last[None], fraction)[0]

    def _driven(self, scan: Scan, start: Array) -> Scan:
        """Return a scan with the velocity of the wheels while it lasted, as far as they came."""
        end = next(((stamp, pose) for stamp, pose in self._wheels
                    if stamp >= scan.stamp + scan.duration), self._wheels[-1])
        if scan.duration <= 0 or end[0] <= scan.stamp:
            return scan
        return scan.driven(start, end[1], (end[0] - scan.stamp) * 1e-9)

    def _may_come(self, stamp: int, longest: int) -> bool:
        """Tell whether odometry before and after a stamp may still come."""
        if self._newest - stamp > longest:
            return False
        return not self._wheels or self._wheels[-1][0] < stamp
