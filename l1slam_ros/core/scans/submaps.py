# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Keyframes with their scans, and the maps of a few that follow each other."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.field import Field
from l1slam_ros.core.scans.points import Points, transformed

# A submap is of so many keyframes before and after its own.
AROUND = 4
# [m] Of one cell and one side of a surface one point is kept.
_CELL = 0.05
# So many submaps are kept at hand.
_KEPT = 24
# [m] A ray that passes a point by so much contradicts it.
_PAST = 0.3
# Rings and sectors of a descriptor, and how far it sees [m].
_RINGS = 12
_SECTORS = 60
_SIGHT = 12.0
# Numbers of a descriptor.
LOOKS = _RINGS * (_SECTORS // 2 + 1)


@dataclass(frozen=True)
class Keyframe:
    """
    A place that the scan front end has seen.

    stamp : [ns]; pose : (3,) in the frame of the scan-matched odometry; points : its scan; part :
    of the run; keyframes of two parts have no odometry between them; travelled : the way to it [m]
    """

    stamp: int
    pose: Array
    points: Points
    part: int
    travelled: float


@dataclass(frozen=True)
class Submap:
    """
    What was seen around a keyframe, in its frame.

    xy, normals : (n, 2) points with normals; views : (v, b), centres : (v, 3) the views of the
    keyframes and where the laser was
    """

    xy: Array
    normals: Array
    views: Array
    centres: Array

    @cached_property
    def field(self) -> Field:
        """The look-up of the nearest point."""
        return Field.of(self.xy, self.normals)

    @cached_property
    def descriptor(self) -> Array:
        """What the place looks like from whichever heading, (`LOOKS`,), of length 1."""
        x, y = self.xy.T
        ring = np.minimum(np.hypot(x, y) / _SIGHT * _RINGS, _RINGS - 1).astype(np.int64)
        sector = np.floor((np.arctan2(y, x) / (2 * np.pi)) * _SECTORS).astype(np.int64) % _SECTORS
        seen = np.zeros((_RINGS, _SECTORS))
        np.add.at(seen, (ring, sector), 1.0)
        spectrum: Array = np.abs(np.fft.rfft(np.sqrt(seen), axis=1)).astype(float).ravel()
        return spectrum / max(float(np.linalg.norm(spectrum)), 1e-12)

    def middle(self, within: float) -> Array:
        """Return the mean of the points not further than so much [m], (2,); zero if none is."""
        near = self.xy[np.hypot(self.xy[:, 0], self.xy[:, 1]) < within]
        return near.mean(axis=0) if len(near) else np.zeros(2)


def submap_of(keyframes: Sequence[Keyframe], at: int, before: int = AROUND, after: int = AROUND
              ) -> Submap:
    """Return the map of the keyframes around one that may see the same, of its own part only."""
    own = keyframes[at]
    # After a pause the wheels may say that the robot is far from all it saw before.
    near = [keyframe for keyframe in keyframes[max(at - before, 0) : at + after + 1]
            if keyframe.part == own.part and np.hypot(*(keyframe.pose - own.pose)[:2]) <= (
                keyframe.points.reach + own.points.reach)]
    poses = se2.between(np.tile(own.pose, (len(near), 1)), np.array([k.pose for k in near]))
    seen = np.concatenate([keyframe.points.xy for keyframe in near])
    normal = np.concatenate([keyframe.points.normals for keyframe in near])
    counts = np.array([len(keyframe.points.xy) for keyframe in near])
    # Of the points of a cell the first is kept, which is of the oldest scan.
    points, normals = native.voxel_grid.merge(seen, normal, counts, poses, _CELL)
    centres = np.array([[*keyframe.points.centre, 0.0] for keyframe in near])
    return Submap(points, normals, np.stack([k.points.view for k in near]),
                  se2.compose(poses, centres))


def submap_of_scan(points: Points) -> Submap:
    """Return what one scan has seen, in its own frame."""
    xy, normals = points.surface
    return Submap(xy, normals, points.view[None], np.array([[*points.centre, 0.0]]))


def seen_by(viewer: Submap, seen: Submap, pose: Array) -> tuple[int, int]:
    """
    Return how many points of a submap at a pose (3,) end rays of another, and how many do not.

    The latter are where the viewer's rays pass through; where it did not look, none are counted.
    """
    points = np.ascontiguousarray(transformed(pose, seen.xy))
    return native.ray_casting.contradictions(points, viewer.views, viewer.centres, _PAST)


class Submaps:
    """The submaps of keyframes that are asked for, the last few kept."""

    def __init__(self, keyframes: Sequence[Keyframe]):
        self._keyframes = keyframes
        self._kept: OrderedDict[int, Submap] = OrderedDict()

    def __getitem__(self, at: int) -> Submap:
        """Return the submap of a keyframe; those after it must be there."""
        if at not in self._kept:
            self._kept[at] = submap_of(self._keyframes, at)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(at)
        return self._kept[at]
