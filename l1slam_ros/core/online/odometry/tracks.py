# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The odometry of all robots together: what `OdometryTrack` tells of one, by robot and time."""

from collections.abc import Callable
from typing import Any

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.online.odometry.odometry_track import OdometryTrack


class Tracks:
    """
    The tracks of robots that are in one graph.

    Parameters
    ----------
    manifold : what the poses live on

    """

    def __init__(self, manifold: Manifold):
        self._manifold = manifold
        self._tracks: dict[int, OdometryTrack] = {}

    def add(self, robot: int, track: OdometryTrack) -> None:
        """Let this be the track of a robot."""
        self._tracks[robot] = track

    def of(self, robot: int) -> OdometryTrack | None:
        """Return the track of a robot; None: it has none in this graph."""
        return self._tracks.get(robot)

    @property
    def begun(self) -> list[int]:
        """The robots of which there is odometry, ascending."""
        return sorted(robot for robot, track in self._tracks.items() if len(track))

    @property
    def clocks(self) -> dict[int, int]:
        """The time to which the odometry of each robot has come [ns]."""
        return {robot: self._tracks[robot].last for robot in self.begun}

    def time(self, robot: int, stamp: int) -> int:
        """Return the time that a stamp of a robot means [ns]."""
        track = self.of(robot)
        return stamp if track is None else track.time(stamp)

    def ago(self, robot: int, age: int) -> int:
        """Return the time that was so long ago for a robot [ns], 0: it has no odometry."""
        track = self.of(robot)
        return track.last - age if track is not None and len(track) else 0

    @property
    def keyframe_stamps(self) -> Indices:
        """Stamps of all keyframes, (n,) [ns]."""
        return self._of_all(lambda track: track.keyframe_stamps)

    @property
    def keyframe_poses(self) -> Array:
        """Poses of all keyframes, each in what is kept of its robot's odometry, (n, p)."""
        return self._of_all(lambda track: track.keyframe_poses)

    def _of_all(self, of: Callable[[OdometryTrack], Any]) -> Any:
        """Return what tracks have of their keyframes, in the order of the graph."""
        tracks = [self._tracks[robot] for robot in self.begun]
        if len(tracks) < 2:
            return of(tracks[0] if tracks else OdometryTrack(self._manifold))
        values = np.concatenate([of(track) for track in tracks])
        numbers = np.concatenate([track.numbers.view() for track in tracks])
        return values[np.argsort(numbers)]

    def of_each(self, robots: Indices) -> 'Ends':
        """Return what is asked of the tracks of some robots, (m,), one for each end of loops."""
        named = sorted(set(robots.tolist()))
        return Ends([(self._tracks[robot], np.flatnonzero(robots == robot)
                      if len(named) > 1 else slice(None)) for robot in named], len(robots))


class Ends:
    """
    Ends of loops, (m,), each of the track of its robot.

    Parameters
    ----------
    groups : tracks, and which ends are of them
    count : of ends

    """

    def __init__(self, groups: list[tuple[OdometryTrack, Indices | slice]], count: int):
        self._groups, self._count = groups, count

    def first(self) -> Indices:
        """Return when the odometry of each begins, (m,) [ns]."""
        return self._of_all(lambda track, _: track.first, np.int64)

    def known_until(self, arrivals: Indices, times: Indices) -> Indices:
        """Return up to which time odometry had come, see `OdometryTrack`, (m,) [ns]."""
        return self._of_all(
            lambda track, at: track.known_until(arrivals[at], times[at]), np.int64)

    def nearest_keyframe(self, times: Indices, known: Indices) -> Indices:
        """Return the keyframe of the graph that is nearest, see `OdometryTrack`, (m,)."""
        return self._of_all(lambda track, at: track.numbers.view()[
            track.nearest_keyframe(times[at], known[at])], np.int64)

    def at(self, times: Indices) -> Array:
        """Return where each was at a time in its odometry, (m, p)."""
        return self._of_all(lambda track, at: track.at(times[at]))

    def unseen(self, times: Indices) -> Array:
        """Return the sigmas of what `at` returns, (m, 2) [m] and [rad]."""
        return self._of_all(lambda track, at: track.unseen(times[at]))

    def poses_of(self, keyframes: Indices) -> Array:
        """Return the poses of keyframes of the graph, (m, p)."""
        return self._of_all(lambda track, at: track.poses_of(
            native.poses.places(track.numbers.view(), keyframes[at], False)))

    def _of_all(self, of: Callable[[OdometryTrack, Indices | slice], Any],
                kind: type = float) -> Any:
        """Return what tracks say, one after the other, each of its rows."""
        if len(self._groups) == 1:  # as of most
            values: Any = np.asarray(of(*self._groups[0]), kind)
            return values if values.ndim else np.full(self._count, values)
        said: Any = None
        for track, rows in self._groups:
            values = np.asarray(of(track, rows))
            if said is None:
                said = np.zeros((self._count, *values.shape[1:]), kind)
            said[rows] = values
        return np.zeros(0, kind) if said is None else said
