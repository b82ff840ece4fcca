# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Odometry from scans: each scan is matched with the map of the last few keyframes.

In: scans with the wheels' pose at their stamps. Out: the robot's pose in a frame of its own, how
certain the motion since the last keyframe is, and whether scans and wheels can both be right.

The wheels are the prior of each match, with a covariance that grows with the way since the last
keyframe: along a corridor scans say nothing, and the wheels' part stays in the covariance. Where a
match is not believed, it is searched for, for wheels slip and lose their sign when a robot backs
up; where no one place is found, the wheels are taken at their word. A robot that comes round a
corner sees little that it knows, but its rays contradict nothing; one whose rays pass again and
again through what it knows was carried away: a new part begins.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.scans.field import REACH, Field
from l1slam_ros.core.scans.matching import Match, match
from l1slam_ros.core.scans.points import Points, rotated, transformed
from l1slam_ros.core.scans.search import search
from l1slam_ros.core.scans.submaps import Keyframe, Submap, seen_by, submap_of, submap_of_scan
from l1slam_ros.core.scans.wheels import Calibration, wheel_covariance

# So many keyframes are the map that scans are matched with.
_MAP = 4
# A match is believed where so much of a scan finds the map, no farther from the wheels than the
# 99.9% quantile of chi-square with 3 degrees of freedom.
_MATCHED, _GATE = 0.4, 16.27
# Where so much does, nobody looks whether rays contradict it, nor for a better match.
_MUCH = 0.8
# The wheels allow so many times their deviation.
_REACHES = 3.0
# So much of a scan must find the map where it was searched for, or where rays contradict it a
# little; no other place may come so near to what a search found.
_FOUND, _RIVAL = 0.3, 0.85
# Of the points that rays look at so many are where these end, or the scan is searched for; where
# the robot is not lost, at least so many: what is thin is seen from one side and not from another.
_AGREE, _LEAST_AGREE = 0.85, 0.75
# [m], [rad] How far is searched beyond the wheels' way since a scan was matched, and at most.
_SEARCH, _MOST_SEARCH = np.array((0.3, 0.3)), np.array((1.5, 0.8))
# How far from the peak of a search the scan may be, where its surfaces do not say [m, m, rad].
_NEAR_PEAK = np.diag(1 / np.array((0.2, 0.2, 0.1)) ** 2)
# What is left unsure of a scan that was searched for.
_SEARCHED = np.diag((0.1, 0.1, 0.05)) ** 2
# Fewer points say nothing about where the robot is; so many scans in a row without a match, on so
# much of a way and turns [m + rad], say that it is somewhere else.
_FEWEST = 30
_LOST_AFTER = 6
_LOST_WAY = 1.0
# After scans and wheels disagreed, for so many scans the wheels may be wrong by twice their
# motion: where a driver loses the sign of wheels that turn backwards, it does for a while.
_DISTRUST = 25
_WRONG = 2.0
# Of the wheels' variance scans left so much less: they measured the motion.
_SURE = 10.0
# [m] Wheels that are 5% wrong make a right map a wrong one over so long a way.
_LONG = 5.0
_BY_WHEELS = (f'scans did not show over {_LONG:.0f} m how far the robot went, as in a bare '
              'corridor: there the map is as long as the wheels say')
# Errors of a match that no count of points lessens, of the map and of normals: ahead, to the
# left [m, m, rad]. Found by simulation; see `matching.KAPPA`.
FLOOR: Array = np.square(np.diag((0.003, 0.002, 0.0002)))


@dataclass(frozen=True)
class ScanKeyframes(Options):
    """When a scan is kept: beyond any one threshold; 0 switches one off; all 0: every scan."""

    translation: float = option(0.5, 'distance from the last keyframe; 0: off', 'm', 0, 1e3)
    rotation: float = option(0.35, 'turn since the last keyframe; 0: off', 'rad', 0, 1e3)
    period: float = option(0.0, 'time since the last keyframe; 0: off', 's', 0, 1e6)

    def done(self, way: float, turn: float, seconds: float) -> float:
        """Return how much of the motion between two keyframes is done: 1 and more: a new one."""
        passed = ((way, self.translation), (turn, self.rotation), (seconds, self.period))
        return max((value / most for value, most in passed if most > 0), default=1.0)


@dataclass(frozen=True)
class Step:
    """
    What one scan said.

    pose : (3,) of the robot in the frame of this odometry; keyframe : None, or the new one;
    covariance : (3, 3) of the motion from the keyframe before to the pose, in the axes of the
    pose; said : what is to be told of it, empty: nothing
    """

    pose: Array
    keyframe: Keyframe | None
    covariance: Array
    said: str = ''


class ScanOdometry:
    """
    Follows a robot by its scans.

    Parameters
    ----------
    options : when a scan becomes a keyframe

    Attributes
    ----------
    keyframes : all so far

    """

    def __init__(self, options: ScanKeyframes = ScanKeyframes()):  # noqa: B008
        self._options = options
        self.keyframes: list[Keyframe] = []
        self._field: Field | None = None
        self._map: Submap | None = None
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        # Where the wheels say it is, from the last keyframe on.
        self._told, self._untold = np.zeros(3), np.zeros((3, 3))
        self._wheels: Array | None = None
        self._unmatched = 0
        self._distrusted = 0
        # Where a scan was matched last, and the wheels' way and turns since.
        self._known, self._blind = np.zeros(3), np.zeros(2)
        self._calibration = Calibration()
        # How far it went since scans showed how far [m].
        self._by_wheels = 0.0

    def add(self, stamp: int, points: Points, wheels: Array) -> Step:
        """Follow the robot to a scan; wheels : (3,) its pose by the wheels at that stamp."""
        if self._wheels is None or self._field is None:
            self._wheels = wheels
            return self._begin(stamp, points)
        motion = self._calibration.follow(se2.between(self._wheels[None], wheels[None])[0])
        self._wheels = wheels
        expected = se2.compose(self._pose[None], motion[None])[0]
        self._told = se2.compose(self._told[None], motion[None])[0]
        Ad = se2.adjoint(se2.inverse(motion[None]))[0]
        noise = wheel_covariance(motion)
        trusted = Ad @ self._covariance @ Ad.T + noise
        if self._distrusted:
            self._distrusted -= 1
            noise = noise + np.diag((_WRONG * motion) ** 2)
        predicted = Ad @ self._covariance @ Ad.T + noise
        self._untold = Ad @ self._untold @ Ad.T + noise
        self._blind = self._blind + (np.hypot(motion[0], motion[1]), abs(motion[2]))
        said = self._follow(expected, predicted, points)
        off = se2.local(expected[None], self._pose[None])[0]
        if self._distrusted and off @ np.linalg.solve(trusted, off) > _GATE:
            self._distrusted = _DISTRUST
        if self._unmatched >= _LOST_AFTER and self._blind.sum() >= _LOST_WAY:
            self._unmatched = 0
            self._blind = np.zeros(2)
            return self._begin(stamp, points, 'the scans show nothing known any more; a new part '
                               'of the map begins')
        return self._step(stamp, points, said)

    def end_drive(self) -> None:
        """Let the next scan be the first of another drive: a part of its own."""
        self._wheels = None
        self._calibration = Calibration()
        self._unmatched = 0
        self._distrusted = 0
        self._blind = np.zeros(2)

    def _follow(self, expected: Array, predicted: Array, points: Points) -> str:
        """Find the pose at a scan from what the wheels expect; return what is to be said."""
        information: Array = np.linalg.inv(predicted).astype(float)
        found, covariance = self._match(expected, expected, information, points)
        pose = found.pose
        fits = covariance is not None and found.matched >= _MATCHED
        helps = covariance is not None and found.matched >= _FOUND
        if covariance is None:
            if self._is_beyond_wheels(expected):
                expected, predicted = self._told, self._untold
            pose, covariance = expected, predicted
        agree = 1.0 if fits and found.matched >= _MUCH else self._free_space(pose, points)
        # Where rays look at nothing, they contradict nothing.
        good = (fits and bool(np.isnan(agree))) or (helps and agree >= _AGREE)
        # Where the wheels allow more than a match reaches, it may have come to a wrong surface.
        vague = _REACHES**2 * predicted[:2, :2].trace() > REACH**2
        if good and (found.matched >= _MUCH or not vague):
            self._take(pose, covariance)
            return ''
        searched = self._search(expected, points)
        if searched is not None and (not good or searched.matched > found.matched):
            borne_out = self._free_space(searched.pose, points)
            if borne_out >= np.fmax(agree, _LEAST_AGREE):
                against = not good and borne_out >= _AGREE
                followed = self._follow_search(searched, against, expected, information, points)
                if followed is not None:
                    return followed
        if fits or agree >= (_LEAST_AGREE if helps else _AGREE):
            # It may have come to where little is known; what matches there still helps.
            self._take(pose, covariance)
        else:
            self._unmatched = 0 if np.isnan(agree) else self._unmatched + 1
            self._pose, self._covariance = expected, predicted
        return ''

    def _match(self, start: Array, expected: Array, information: Array, points: Points
               ) -> tuple[Match, Array | None]:
        """Match from a pose on; return its covariance, too; None: the wheels cannot be right."""
        xy, normals = points.surface
        assert self._field is not None
        found = match(self._field, xy, normals, start, expected, information)
        off = se2.local(expected[None], found.pose[None])[0]
        if off @ information @ off > _GATE or self._is_beyond_wheels(found.pose):
            return found, None
        return found, np.linalg.inv(information + found.information).astype(float)

    def _is_beyond_wheels(self, pose: Array) -> bool:
        """Tell whether the wheels, since the last keyframe, speak against a pose."""
        off = se2.local(self._told[None], pose[None])[0]
        return bool(off @ np.linalg.solve(self._untold, off) > _GATE)

    def _follow_search(self, searched: Match, against: bool, expected: Array,
                       information: Array, points: Points) -> str | None:
        """
        Believe a search; return what is to be said where the wheels say otherwise.

        against : whether it may be believed against the wheels; None: it is not believed, for they
        say otherwise
        """
        found, covariance = self._match(searched.pose, expected, information, points)
        if covariance is not None and found.matched >= _FOUND:
            self._take(found.pose, covariance)
            return ''
        if not against:
            return None
        self._take(searched.pose, np.linalg.inv(_NEAR_PEAK + searched.information) + _SEARCHED)
        self._told, self._untold = self._pose, self._covariance
        said = '' if self._distrusted else 'the scans disagree with the wheels, and are followed'
        self._distrusted = _DISTRUST
        return said

    def _take(self, pose: Array, covariance: Array) -> None:
        """Believe that the robot is at a pose of the map."""
        self._unmatched = 0
        self._blind = np.zeros(2)
        self._known = self._pose = pose
        self._covariance = covariance

    def _free_space(self, pose: Array, points: Points) -> float:
        """
        Return how many of each other's points a scan at a pose (3,) and the map bear out, 0 to 1.

        The others are where the rays of one pass through. NaN: they look at too few to tell.
        """
        seen = submap_of_scan(points)
        if self._map is None or len(seen.xy) < _FEWEST:
            return np.nan
        here = se2.between(self.keyframes[-1].pose[None], pose[None])
        counts = np.array((seen_by(self._map, seen, here[0]),
                           seen_by(seen, self._map, se2.inverse(here)[0])))
        of_each = counts.sum(axis=1)
        if of_each.sum() < _FEWEST:
            return np.nan
        return float((counts[:, 0] / np.maximum(of_each, 1))[of_each > 0].min())

    def _search(self, expected: Array, points: Points) -> Match | None:
        """
        Look for a scan around where one was matched last; None: there is no one place.

        Wheels that stood still, or turned the other way, have moved the robot no farther from
        there than they said. Where that is farther than a search reaches, it is around where they
        have the robot.
        """
        xy, normals = points.surface
        if len(xy) < _FEWEST or self._field is None:
            return None
        reach, turn = np.minimum(_SEARCH + self._blind, _MOST_SEARCH)
        around = self._known if self._blind[0] <= reach else expected
        centre = np.array([*around[:2], expected[2]])
        peak = search(self._field, xy, centre, reach, turn, _FOUND, _RIVAL)
        if peak is None or peak.second > _RIVAL * peak.score:
            return None
        found = match(self._field, xy, normals, peak.pose, peak.pose, _NEAR_PEAK, widest=0.3)
        return found if found.matched >= _FOUND else None

    def _step(self, stamp: int, points: Points, said: str) -> Step:
        last = self.keyframes[-1]
        moved = se2.between(last.pose[None], self._pose[None])[0]
        way = float(np.hypot(moved[0], moved[1]))
        covariance = self._covariance + FLOOR
        done = self._options.done(way, abs(moved[2]), (stamp - last.stamp) * 1e-9)
        # What shows nothing known does not become the map, or all that follows would match it.
        if self._unmatched or done < 1.0:
            return Step(self._pose, None, covariance, said)
        keyframe = Keyframe(stamp, self._pose, points, last.part, last.travelled + way)
        said = '; '.join(filter(None, (
            said, self._calibration.said_of_turn(moved), self._compare(moved, way))))
        self._keep(keyframe)
        return Step(self._pose, keyframe, covariance, said)

    def _compare(self, moved: Array, way: float) -> str:
        """
        Learn of a step by wheels and scans; return what is to be said of how far it went.

        Scans do not show that where they took less than half of the variance along each motion
        (3,) of a stretch; it is said once.

        way : the length of this motion [m]
        """
        along = rotated(np.array([0.0, 0.0, -moved[2]]), moved[None, :2])[0]
        known = along @ self._covariance[:2, :2] @ along
        allowed = along @ self._untold[:2, :2] @ along
        before = self._by_wheels
        self._by_wheels = before + way if 2 * known > allowed else 0.0
        if not self._distrusted:
            told = se2.between(self.keyframes[-1].pose[None], self._told[None])[0]
            self._calibration.learn(told, moved, (
                _SURE * known < allowed, _SURE * self._covariance[2, 2] < self._untold[2, 2]))
        return _BY_WHEELS if before < _LONG <= self._by_wheels else ''

    def _begin(self, stamp: int, points: Points, said: str = '') -> Step:
        part = 0
        travelled = 0.0
        self._by_wheels = 0.0
        self._known = self._pose
        if self.keyframes:
            part = self.keyframes[-1].part + 1
            travelled = self.keyframes[-1].travelled
        self._keep(Keyframe(stamp, self._pose, points, part, travelled))
        keyframe = self.keyframes[-1]
        return Step(self._pose, keyframe, FLOOR, said)

    def _keep(self, keyframe: Keyframe) -> None:
        """Take a keyframe into the map that scans are matched with."""
        self.keyframes.append(keyframe)
        self._calibration.begin_step()
        local = submap_of(self.keyframes, len(self.keyframes) - 1, before=_MAP - 1, after=0)
        self._map = local
        # In the frame of the odometry, where poses are.
        self._field = Field.of(transformed(keyframe.pose, local.xy),
                               rotated(keyframe.pose, local.normals))
        self._covariance = np.zeros((3, 3))
        self._told, self._untold = keyframe.pose, self._covariance
