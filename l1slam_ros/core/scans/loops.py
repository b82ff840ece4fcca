# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures from scans: which keyframes to compare, and whether they show one place.

In: keyframes, where the map has them, and how certain that is. Out: loops with covariances. A
keyframe asks for those that saw nearly the same by the map, and for those that look alike; each is
searched for without a guess, matched, and believed only if

    the score of the search and the overlap are high,
    no other place within reach fits nearly as well (two equal rooms, a corridor),
    the rays of neither pass through what the other saw (a mirrored room),
    every direction is held by the surfaces that were matched (a corridor).

What is sent is a proposal: the back end doubts it as any other loop.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.scans.matching import match
from l1slam_ros.core.scans.search import search
from l1slam_ros.core.scans.submaps import AROUND, LOOKS, Keyframe, Submap, Submaps, seen_by

# [m] A keyframe asks so far from the last one that did: submaps of neighbours show the same.
_ASK_WAY = 1.0
# So many candidates by where in the map they saw something, and so many by their looks.
_NEAREST, _ALIKE = 2, 2
# Cosine of two descriptors.
_SIMILAR = 0.75
# [m] Candidates are neighbours of each other where they are nearer along the way.
_NEIGHBOURS = 4.0
# [m], [rad] A search reaches at least so far, and at most; places that look alike are nearer.
_LEAST_REACH = 1.5
_MOST_REACH = 8.0
_LEAST_TURN = 0.5
_ALIKE_REACH = 4.0
_SIGMAS = 3.0
# [m/m], [rad/m] How the odometry's error grows with the way, beyond where the map is known.
_DRIFT = np.array((0.05, 0.01))
# What a loop must show; see above.
_SCORE = 0.42
_RIVAL = 0.85
_OVERLAP = 0.3
_AGREE = 0.93
_HELD = 0.05
# [m] A match that goes so far from the peak of the search slides.
_WANDER = 0.4
# Of neighbouring keyframes' submaps much is the same: a loop is half as certain as matches say.
_SHARED = 2.0
# Errors that no count of points lessens [m, m, rad].
_FLOOR = np.diag((0.03, 0.03, 0.007)) ** 2


@dataclass(frozen=True)
class LoopOptions(Options):
    """Which keyframes are compared."""

    apart: float = option(10.0, 'way between two keyframes of a loop, at least', 'm', 0, 1e6)


@dataclass(frozen=True)
class ScanLoop:
    """
    A loop: keyframe j seen from keyframe i.

    measurement : (3,); covariance : (3, 3) in its axes; score : of the search, 0 to 1
    """

    i: int
    j: int
    measurement: Array
    covariance: Array
    score: float


@dataclass(frozen=True)
class _Comparison:
    """
    Keyframe j is to be looked for so far from a pose (3,), seen from i [m], [rad].

    alike : not because i is near, only because it looks alike
    """

    i: int
    j: int
    alike: bool
    expected: Array
    reach: float
    turn: float


class LoopFinder:
    """
    Finds loops among keyframes as they come.

    Parameters
    ----------
    keyframes : those of the odometry, which grow

    """

    def __init__(self, keyframes: Sequence[Keyframe],
                 options: LoopOptions = LoopOptions()):  # noqa: B008
        self._keyframes, self._options = keyframes, options
        self._submaps = Submaps(keyframes)
        self._asked = AROUND
        self._asked_at = -np.inf  # [m] the way to the last that asked
        # Of each keyframe that may be asked for.
        self._looks: list[Array] = []
        self._middles: list[Array] = []
        self._travelled: list[float] = []
        self._part: list[int] = []
        self._waiting: deque[_Comparison] = deque()
        self._closed = -1  # the last that was found to be where a near one is

    def due(self) -> Indices:
        """Return the keyframes that ask now: their submaps are whole, the last is a way back."""
        due: list[int] = []
        while self._asked < len(self._keyframes) - AROUND:
            travelled = self._keyframes[self._asked].travelled
            if travelled - self._asked_at >= _ASK_WAY:
                self._asked_at = travelled
                due.append(self._asked)
            self._asked += 1
        return np.array(due, np.int64)

    def ask(self, j: int, poses: Array, spread: Array) -> None:
        """
        Choose the earlier keyframes that keyframe j is to be compared with.

        poses : (n, 3) of the keyframes in the map, at least j + 1; spread : (n, 2) standard
        deviation of where each lies from the last one placed [m], [rad]; see `_sigma`
        """
        for k in range(len(self._part), j + 1):
            self._looks.append(self._submaps[k].descriptor)
            self._middles.append(np.array([*self._submaps[k].middle(_MOST_REACH), 0.0]))
            self._travelled.append(self._keyframes[k].travelled)
            self._part.append(self._keyframes[k].part)
        sigma = self._sigma(j, spread)
        reach = np.clip(_SIGMAS * sigma[:, 0], _LEAST_REACH, _MOST_REACH)
        turn = np.clip(_SIGMAS * sigma[:, 1], _LEAST_TURN, np.pi)
        for i, alike in self._candidates(j, poses, reach):
            expected = se2.between(poses[i][None], poses[j][None])[0]
            self._waiting.append(
                _Comparison(i, j, alike, expected, float(reach[i]), float(turn[i])))

    @property
    def waiting(self) -> int:
        """How many comparisons are still to be made."""
        return len(self._waiting)

    def find(self, most: int) -> list[ScanLoop]:
        """Make so many of the comparisons that wait; return the loops that they found."""
        loops: list[ScanLoop] = []
        while most and self._waiting:
            asked = self._waiting.popleft()
            if asked.alike and asked.j != self._closed:
                around = np.array([0.0, 0.0, asked.expected[2]])
                asked = replace(asked, expected=around, reach=_ALIKE_REACH, turn=np.pi)
            elif asked.alike and asked.reach > _ALIKE_REACH:
                # A near one was found; where the map is as unsure as this, that is enough.
                continue
            most -= 1
            if (loop := self._compare(asked)) is not None:
                loops.append(loop)
                self._closed = self._closed if asked.alike else asked.j
        return loops

    def _sigma(self, j: int, spread: Array) -> Array:
        """Return how far keyframe j may lie from where the map has it, seen from each, (j, 2)."""
        travelled = np.array(self._travelled[: j + 1])
        way = travelled[j] - travelled[:j]
        known = spread[:, 0] > 0
        placed = int(np.flatnonzero(known)[-1]) if known.any() else -1
        since = travelled[j] - (travelled[placed] if 0 <= placed < j else np.inf)
        # By odometry alone from there, or by the map and odometry since, whichever is surer.
        by_map = np.hypot(np.where(known[:, None], spread, np.inf)[:j], max(since, 0.0) * _DRIFT)
        return np.fmin(way[:, None] * _DRIFT, by_map)

    def _candidates(self, j: int, poses: Array, reach: Array) -> list[tuple[int, bool]]:
        """
        Return keyframes to compare with, and whether for their looks alone.

        Near are those that saw nearly the same: of a laser that looks ahead, and comes back the
        other way, these are not where it stood.
        """
        travelled, part = np.array(self._travelled[: j + 1]), np.array(self._part[: j + 1])
        far = np.flatnonzero(
            (travelled[j] - travelled > self._options.apart) | (part != part[j]))
        seen = se2.compose(poses[: j + 1], np.array(self._middles[: j + 1]))
        distance = np.hypot(*(seen[far, :2] - seen[j, :2]).T)
        apart = (part != part[j])[far]
        near = (distance <= reach[far]) & ~apart
        chosen: list[tuple[int, bool]] = []
        self._take(far[near], distance[near], _NEAREST, False, travelled, chosen)
        within = far[(distance <= 2 * reach[far]) | apart]
        looks = np.array([self._looks[i] for i in within]).reshape(-1, LOOKS) @ self._looks[j]
        alike = looks > _SIMILAR
        self._take(within[alike], -looks[alike], _ALIKE, True, travelled, chosen)
        return chosen

    def _take(self, keyframes: Indices, rank: Array, most: int, alike: bool, travelled: Array,
              chosen: list[tuple[int, bool]]) -> None:
        """Take the first few by rank that are not neighbours of one that is taken."""
        taken = 0
        for i in keyframes[np.argsort(rank, kind='stable')]:
            if taken == most:
                return
            if all(abs(travelled[i] - travelled[other]) > _NEIGHBOURS for other, _ in chosen):
                chosen.append((int(i), alike))
                taken += 1

    def _compare(self, asked: '_Comparison') -> ScanLoop | None:
        """Return the loop from i to j, None: they are not seen to be one place."""
        i, j = asked.i, asked.j
        reference, asking = self._submaps[i], self._submaps[j]
        peak = search(reference.field, asking.xy, asked.expected, asked.reach, asked.turn, _SCORE,
                      _RIVAL)
        if peak is None or peak.second > _RIVAL * peak.score:
            return None
        found = match(reference.field, asking.xy, asking.normals, peak.pose, widest=0.3)
        away = se2.between(peak.pose[None], found.pose[None])[0]
        if (found.matched < _OVERLAP or found.curvature < _HELD
                or np.hypot(away[0], away[1]) > _WANDER):
            return None
        back = se2.inverse(found.pose[None])[0]
        if not (_agrees(asking, reference, found.pose) and _agrees(reference, asking, back)):
            return None
        covariance = _SHARED * np.linalg.inv(found.information + 1e-6 * np.eye(3)) + _FLOOR
        return ScanLoop(i, j, found.pose, covariance, peak.score)


def _agrees(seen: Submap, viewer: Submap, pose: Array) -> bool:
    """Tell whether what is seen at a pose (3,) is where the viewer's rays do not pass through."""
    agree, through = seen_by(viewer, seen, pose)
    return agree >= _AGREE * (agree + through)
