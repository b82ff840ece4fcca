# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The raw odometry so far: where the robot was at any time, and which samples are keyframes.

Stamps may go back: a clock was set, a bag is played again. The time of a sample is its stamp plus
a shift, another one from where stamps went back, so that time only grows. A stamp means the
latest stretch of time that had begun by it: the one the robot is in, if that goes back so far.

A loop may name any time, so the motion between keyframes is kept: of old samples those that
interpolation between their neighbours would miss by more than any measurement may claim to know.
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import LEAST_VARIANCE, Mask
from l1slam_ros.core.graph.growable_array import GrowingArray, few_rows
from l1slam_ros.core.graph.measurements import LONGEST_PAUSE
from l1slam_ros.core.online.odometry.plausibility import UNSEEN, is_identity
from l1slam_ros.core.online.odometry.silences import Silences

# So many keyframes tell how fast the robot goes.
_RECENT = 16
# So many of its poses are copied one by one, see `few_rows`.
_FEW = 8

# So many samples at once are thinned out, once as many more have come.
_BLOCK = 512
# [m], [rad] What interpolation may miss: the least standard deviation of a measurement.
_MISSED = LEAST_VARIANCE**0.5
# Thinning ends with a round that leaves out less than this part of the samples.
_WORTH = 1 / 8

# [ns] Between the last sample before stamps went back, and the first after.
_BETWEEN = 1_000_000_000

# A robot passed a place if the way over it is longer than the direct one by no more than this
# factor and this length [m].
_DETOUR, _BESIDE = 2.0, 0.1


class OdometryTrack:
    """
    Samples of the odometry in one frame, in order of time.

    From the last sample of a part to the first of the next no motion is known: nothing is
    interpolated there, and what is near to the one is not carried to the other.

    Parameters
    ----------
    manifold : what the poses live on

    Attributes
    ----------
    numbers : of its keyframes in the graph, as who adds them says

    """

    def __init__(self, manifold: Manifold):
        self._manifold = manifold
        self.numbers = GrowingArray((), np.int64)
        self._times = GrowingArray((), np.int64)
        self._poses = GrowingArray((manifold.POSE_SIZE,))
        self._keyframes = GrowingArray((), np.int64)
        self._keyframe_stamps = GrowingArray((), np.int64)
        # Of each part the first sample, its time and its keyframe; where shifts begin, and they.
        self._parts = GrowingArray((3,), np.int64)
        self._shifts: list[tuple[int, int]] = []
        self._thinned = 0  # samples
        self._silences = Silences()

    def __len__(self) -> int:
        return len(self._times)

    @property
    def first(self) -> int:
        """Time of the first sample [ns]."""
        return int(self._times.view()[0])

    @property
    def last(self) -> int:
        """Time of the last sample [ns]."""
        return int(self._times.view()[-1])

    @property
    def last_stamp(self) -> int:
        """Stamp of the last sample [ns]."""
        return self.last - self._shifts[-1][1]

    @property
    def last_pose(self) -> Array:
        """Pose of the last sample, (1, p)."""
        return self._poses.view()[-1:].copy()

    @property
    def keyframe_stamps(self) -> Indices:
        """Stamps of the keyframes, (n,) [ns]."""
        return self._keyframe_stamps.view()

    @property
    def keyframe_poses(self) -> Array:
        """Poses of the keyframes, (n, p)."""
        return self.poses_of(slice(None))

    def poses_of(self, keyframes: Indices | slice) -> Array:
        """Return the poses of some keyframes, (m, p)."""
        rows, poses = self._keyframes.view()[keyframes], self._poses.view()
        return few_rows(poses, rows) if len(rows) <= _FEW else poses[rows]

    @property
    def gaps(self) -> Indices:
        """The first keyframe of each part but the first, (g,)."""
        return self._parts.view()[1:, 2]

    def time(self, stamp: int) -> int:
        """Return the time that a stamp means [ns]."""
        for begin, shift in reversed(self._shifts):
            if stamp + shift >= begin:
                return stamp + shift
        return stamp + (self._shifts[0][1] if self._shifts else 0)

    def begin_part(self, stamp: int, reach: tuple[float, float] = (0.0, 0.0)) -> bool:
        """
        Let a part begin with the sample to come; return whether its stamp goes back in time.

        reach : how far [m] and by what angle [rad] the robot may have gone by then
        """
        back = not self._shifts or stamp <= self.last_stamp
        if any(reach) and not back:
            self._silences.add(self.last, stamp + self._shifts[-1][1], reach, False)
        if back:
            begin = self.last + _BETWEEN if self._shifts else stamp
            self._shifts.append((begin, begin - stamp))
        self._parts.extend(np.array([
            (len(self), stamp + self._shifts[-1][1], len(self._keyframes))]))
        return back

    def append(self, stamp: int, pose: Array, is_keyframe: bool,
               reach: tuple[float, float] = (0.0, 0.0)) -> None:
        """
        Append a sample after the last one, pose (1, p).

        reach : how far [m] and by what angle [rad] the robot may have been off the middle of the
        way from there
        """
        if not len(self):
            self.begin_part(stamp)
        elif any(reach) and self._parts.view()[-1, 0] < len(self):
            self._silences.add(self.last, stamp + self._shifts[-1][1], reach, True)
        self._times.append(stamp + self._shifts[-1][1])
        self._poses.append(pose[0])
        if is_keyframe:
            self._keyframes.append(len(self) - 1)
            self._keyframe_stamps.append(stamp)

    def went_by(self, stamp: int, pose: Array) -> Array | None:
        """
        Return the poses before and after a stamp, (2, p), if the robot went by a pose (1, p) then.

        None: it did not, or there is a sample of that time.
        """
        times = self._times.view()[self._parts.view()[-1, 0]:]
        after = int(np.searchsorted(times, time := stamp + self._shifts[-1][1]))
        if not 0 < after < len(times) or times[after] == time:
            return None
        beside = self._poses.view()[self._parts.view()[-1, 0]:][after - 1:after + 1]
        a, b, way = self._manifold.motion(self._manifold.local(
            np.concatenate((pose, pose, beside[:1])), np.concatenate((beside, beside[1:]))))[0]
        return beside.copy() if a + b <= _DETOUR * way + _BESIDE else None

    def insert(self, stamp: int, pose: Array) -> None:
        """Put a sample in its place, after the last keyframe; see `went_by`."""
        time = stamp + self._shifts[-1][1]
        place = int(np.searchsorted(self._times.view(), time))
        self._times.replace(place, np.append(time, self._times.view()[place:]))
        self._poses.replace(place, np.concatenate((pose, self._poses.view()[place:])))
        self._thinned += place <= self._thinned
        self._silences.split(time)

    def unseen(self, times: Indices) -> Array:
        """Return the sigmas, (m, 2) [m] and [rad], of what `at` returns of times in silences."""
        return self._silences.sigmas(times)

    @property
    def may_be_thinned(self) -> bool:
        """Whether there are so many new samples that `thin` is worth it."""
        return len(self) - self._thinned >= 2 * _BLOCK

    def thin(self) -> None:
        """Leave out of a block of samples what interpolation finds again; keyframes stay."""
        start = self._thinned
        end = self._thinned + _BLOCK
        times, poses = self._times.view()[start:].copy(), self._poses.view()[start:].copy()
        keyframes = self._keyframes.view()
        parts = self._parts.view().copy()
        first = int(np.searchsorted(keyframes, start))
        fixed = np.zeros(len(times), bool)
        fixed[keyframes[first:] - start] = True
        opened = parts[:, 0] >= max(start, 1)
        # The first sample of a part, and the last of the one before.
        fixed[parts[opened, 0] - start] = fixed[np.maximum(parts[opened, 0] - start - 1, 0)] = True
        kept = np.ones(len(times), bool)
        kept[:_BLOCK] = self._needed(times[:_BLOCK], poses[:_BLOCK], fixed[:_BLOCK])
        place = start + np.cumsum(kept) - 1
        parts[opened, 0] = place[parts[opened, 0] - start]
        self._keyframes.replace(first, place[keyframes[first:] - start])
        self._parts.replace(0, parts)
        self._times.replace(start, times[kept])
        self._poses.replace(start, poses[kept])
        # Its last sample is the first of the next block.
        self._thinned = int(place[end - start - 1])

    def _needed(self, times: Indices, poses: Array, fixed: Mask) -> Mask:
        """
        Return which samples (n,) are not found again between those, both ends and what is fixed.

        Every other one is left out where all samples between its neighbours are found without it,
        then every other one of the rest, and so on.
        """
        manifold = self._manifold
        needed = np.ones(len(times), bool)
        first = 1
        idle = 0
        while idle < 2:
            kept = np.flatnonzero(needed)
            tried = kept[first:-1:2]
            tried = tried[~fixed[tried]]
            rest = needed.copy()
            rest[tried] = False
            ends = np.flatnonzero(rest)
            after = np.clip(np.searchsorted(ends, np.arange(len(times))), 1, None)
            i = ends[after - 1]
            j = ends[after]
            found = manifold.interpolate(
                poses[i], poses[j], (times - times[i]) / (times[j] - times[i]))
            metres, radians = manifold.motion(manifold.local(found, poses))
            missed = np.zeros(len(ends), bool)
            missed[after[np.maximum(metres, radians) > _MISSED]] = True
            spared = tried[~missed[after[tried]]]
            needed[spared] = False
            idle = 0 if len(spared) > _WORTH * len(kept) else idle + 1
            first = 3 - first  # those between had no turn
        return needed

    def extend_by_part(self, stamps: Indices, poses: Array) -> None:
        """Append a part, samples (n,) [ns], (n, p), a keyframe each."""
        self.begin_part(int(stamps[0]))
        self._keyframes.extend(len(self) + np.arange(len(stamps)))
        self._keyframe_stamps.extend(stamps)
        self._times.extend(stamps + self._shifts[-1][1])
        self._poses.extend(poses)

    def goes_on(self, stamp: int, pose: Array, offset: Array) -> bool:
        """
        Tell whether odometry after a pause is in the frame that it was in, by a first pose (1, p).

        It does not begin anew, and offset (1, p) takes it to where the robot can have gone: twice
        as fast as of late, or as fast as one that nobody saw.
        """
        if is_identity(self._manifold, pose):
            return False
        pose = self._manifold.compose(offset, pose)
        recent = slice(max(int(self._parts.view()[-1, 2]), len(self._keyframes) - _RECENT), None)
        times = self.keyframe_stamps[recent]
        poses = self.poses_of(recent)
        step = self._manifold.local(np.concatenate((poses[:-1], self.last_pose)),
                                    np.concatenate((poses[1:], pose)))
        way = self._manifold.motion(step)[0]
        seconds = np.diff(times, append=stamp) * 1e-9
        speed = max(2 * (way[:-1] / seconds[:-1]).max(initial=0.0), UNSEEN)
        pause = (stamp - self.last_stamp) * 1e-9
        return bool(pause <= LONGEST_PAUSE and way[-1] <= pause * speed)

    def known_until(self, arrivals: Indices, times: Indices) -> Indices:
        """
        Return up to which time odometry had come when each loop could first be used, (m,) [ns].

        Only keyframes of that time are candidates, so a loop becomes the same factor whenever an
        update happens to look for it.
        """
        samples = self._times.view()
        return np.maximum(arrivals, samples[native.poses.places(samples, times, False)])

    def nearest_keyframe(self, times: Indices, known: Indices) -> Indices:
        """Return the keyframe nearest to each time, of its part and up to `known`, (m,)."""
        samples, keyframes = self._times.view(), self._keyframes.view()
        first, end = self._part(times, 2, len(keyframes))
        # By the samples: the times of all keyframes would have to be copied together.
        places = native.poses.places
        next_one = places(keyframes, places(samples, times, False), False)
        unknown = places(keyframes, places(samples, known, True), False)
        after = np.clip(next_one, first, np.minimum(unknown, end) - 1)
        before = np.maximum(after - 1, first)
        nearer_before = times - samples[keyframes[before]] <= samples[keyframes[after]] - times
        return np.where(nearer_before, before, after)

    def at(self, times: Indices) -> Array:
        """Return the poses at some times, interpolated between samples of a part, (m, p)."""
        samples = self._times.view()
        first, end = self._part(times, 0, len(samples))
        return native.poses.interpolate(samples, self._poses.view(), first, end, times)

    def _part(self, times: Indices, column: int, count: int) -> tuple[Indices, Indices]:
        """Return the first sample or keyframe, and past the last, of the part of each, or all."""
        parts = self._parts.view()
        if len(parts) == 1:  # as of most: every loop asks
            return parts[:, column], np.array([count])
        part = np.maximum(np.searchsorted(parts[:, 1], times, side='right') - 1, 0)
        bounds = np.append(parts[:, column], count)
        return bounds[part], bounds[part + 1]
