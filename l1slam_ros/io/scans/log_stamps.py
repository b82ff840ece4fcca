# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Making the stamps of a log ascending, where its clock was set back or stamps were rounded."""

from bisect import bisect_right

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices

# A clock that is behind for this many lines was set back; else a line was written late.
_SET_BACK = 50
# [ns] between two stamps of a log whose stamps are all equal.
_USUAL = 100_000_000


def rising(stamps: Indices) -> tuple[Indices, Indices, int]:
    """
    Return ascending stamps, their lines, and the sum by which the clock was set back [ns].

    stamps : (n,) in the order of the file [ns]. If the clock was set back, later stamps are
    shifted to undo that. Then the largest set of lines whose stamps do not descend is kept; the
    others were stamped late or early. Equal stamps were rounded; they are spread up to the next.
    """
    going_on, back = set_forward(stamps)
    rows = not_falling(going_on.tolist())
    return _spread(going_on[rows]), rows, back


def set_forward(stamps: Indices) -> tuple[Indices, int]:
    """
    Undo that the clock was set back; return the stamps and the sum of the shifts [ns].

    stamps : see `rising`
    """
    steps: Indices = np.diff(stamps)
    usual = int(np.median(steps[steps > 0])) if (steps > 0).any() else _USUAL
    found = stamps.copy()
    last = 0
    for at in (np.flatnonzero(steps < 0) + 1).tolist():
        # The line before may be the wrong one, so several lines must be behind.
        before = np.sort(found[last:at])[-2:]
        behind = found[at : at + _SET_BACK] < before[0]
        if len(behind) == _SET_BACK and behind.all():
            found[at:] += before[-1] + usual - found[at]
            last = at
    return found, int(found[-1] - stamps[-1])


def not_falling(stamps: list[int]) -> Indices:
    """Return the places of the longest sequence of stamps that does not descend."""
    # For each length, the sequence that ends at the lowest stamp.
    ends: list[int] = []
    lowest: list[int] = []
    before = [-1] * len(stamps)
    for k, stamp in enumerate(stamps):
        at = bisect_right(lowest, stamp)
        before[k] = ends[at - 1] if at else -1
        ends[at : at + 1], lowest[at : at + 1] = [k], [stamp]
    kept = []
    k = ends[-1]
    while k >= 0:
        kept.append(k)
        k = before[k]
    return np.array(kept[::-1], np.int64)


def _spread(stamps: Indices) -> Indices:
    """Spread equal ones of non-descending stamps up to the next stamp."""
    first = np.flatnonzero(np.diff(stamps, prepend=stamps[0] - 1))
    counts = np.diff(first, append=len(stamps))
    gaps: Indices = np.diff(stamps[first])
    gaps = np.append(gaps, int(np.median(gaps)) if len(gaps) else _USUAL * counts[-1])
    since = np.arange(len(stamps)) - np.repeat(first, counts)
    return stamps + (since * np.repeat(gaps / counts, counts)).astype(np.int64)
