# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Scans that wait for odometry on both sides of their stamps, and for their turn.

In: scans and the wheels' poses, each in the order of its stamps. Out: a scan with the wheels' pose
at its stamp. Who takes them too slowly gets every other one, and those left out are counted.
"""

from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.points import Scan

# So many scans and poses may wait for each other: seconds of a fast laser, of fast wheels.
_MOST_SCANS, _MOST_POSES = 100, 5000
# [ns] Stamps that go back so far are of another time; nearer, one message came late.
_BACK = 500_000_000


class ScanQueue:
    """
    Pairs scans with the wheels; one thread uses it.

    Parameters
    ----------
    backlog : returns how many scans may wait for their turn; of more, every other one is left out

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
        """How many scans wait for odometry."""
        return len(self._scans)

    def add_wheels(self, stamp: int, pose: Array) -> None:
        """Take in a pose (3,) of the wheels at a stamp [ns]."""
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
        """Tell whether time went back: two stamps in a row are of an earlier time, and rise."""
        before = self._back
        self._back = stamp
        return 0 < before < stamp <= self._wheels[-1][0] - _BACK

    def add_scan(self, scan: Scan) -> None:
        """Take in a scan."""
        if scan.stamp <= self._newest:
            if self._newest - scan.stamp < _BACK:
                self.counts['old_stamp'] += 1
                return
            # Another time, of which the wheels will tell, too.
            self._scans.clear()
        self._newest = scan.stamp
        self._scans.append(scan)
        # Where wheels have come, scans wait for their turn alone.
        if len(self._scans) > max(_MOST_SCANS, self._backlog()):
            self._scans.popleft()
            self.counts['expired'] += 1

    def take(self, wait: float) -> tuple[Scan, Array] | None:
        """
        Return the next scan and the wheels' pose (3,) at its stamp; None: there is none.

        wait : [s] a scan waits so long for odometry, by the stamps of later ones
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
                self._ready.append((scan, found))
        if (waiting := len(self._ready)) > self._backlog():
            # The newest stays; scans that lie evenly along the way are followed more surely.
            self._ready = deque([*self._ready][(waiting - 1) % 2 :: 2])
            self.counts['left_out'] += waiting - len(self._ready)
        return self._ready.popleft() if self._ready else None

    def _at(self, stamp: int, longest: int) -> Array | None:
        """Return the wheels' pose (3,) at a stamp; None: it is not known."""
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

    def _may_come(self, stamp: int, longest: int) -> bool:
        """Tell whether odometry may still come that surrounds a stamp."""
        if self._newest - stamp > longest:
            return False
        return not self._wheels or self._wheels[-1][0] < stamp
