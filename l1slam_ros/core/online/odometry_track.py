# SPDX-License-Identifier: Apache-2.0
"""The raw odometry so far: where the robot was at any time, and which samples are keyframes."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.measurements import LONGEST_PAUSE
from l1slam_ros.core.online.odometry_stream import UNSEEN, UNSEEN_TURN, is_identity

# So many keyframes tell how fast the robot goes.
_RECENT = 16


class OdometryTrack:
    """
    Samples of the odometry in one frame, in order of time.

    Parameters
    ----------
    manifold : what the poses live on

    """

    def __init__(self, manifold: Manifold):
        self._manifold = manifold
        self._stamps = GrowingArray((), np.int64)
        self._poses = GrowingArray((manifold.POSE_SIZE,))
        self._keyframes = GrowingArray((), np.int64)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def first(self) -> int:
        """Stamp of the first sample [ns]."""
        return int(self._stamps.view()[0])

    @property
    def last(self) -> int:
        """Stamp of the last sample [ns]."""
        return int(self._stamps.view()[-1])

    @property
    def last_pose(self) -> Array:
        """Pose of the last sample, (1, p)."""
        pose: Array = self._poses.view()[-1:]
        return pose

    @property
    def keyframe_stamps(self) -> Indices:
        """Stamps of the keyframes, (n,) [ns]."""
        stamps: Indices = self._stamps.view()[self._keyframes.view()]
        return stamps

    @property
    def keyframe_poses(self) -> Array:
        """Poses of the keyframes, (n, p)."""
        poses: Array = self._poses.view()[self._keyframes.view()]
        return poses

    def append(self, stamp: int, pose: Array) -> None:
        """Append a sample after the last one, pose (1, p)."""
        self._stamps.extend(np.array([stamp]))
        self._poses.extend(pose)

    def mark_keyframe(self) -> None:
        """Make the last sample a keyframe."""
        self._keyframes.extend(np.array([len(self._stamps) - 1]))

    def extend_by_keyframes(self, stamps: Indices, poses: Array) -> None:
        """Append samples (n,) [ns], (n, p), a keyframe each."""
        self._keyframes.extend(len(self._stamps) + np.arange(len(stamps)))
        self._stamps.extend(stamps)
        self._poses.extend(poses)

    def goes_on(self, stamp: int, pose: Array, offset: Array) -> bool:
        """
        Tell whether odometry after a pause is in the frame that it was in, by a first pose (1, p).

        It does not begin anew, and offset (1, p) takes it to where the robot can have gone: twice
        as fast as of late, or as one that nobody saw.
        """
        if is_identity(self._manifold, pose):
            return False
        pose = self._manifold.compose(offset, pose)
        recent = slice(-_RECENT, None)
        times, poses = self.keyframe_stamps[recent], self.keyframe_poses[recent]
        step = self._manifold.local(np.concatenate((poses[:-1], self.last_pose)),
                                    np.concatenate((poses[1:], pose)))
        seconds = np.append(np.diff(times), stamp - self.last) * 1e-9
        pause = float(seconds[-1])
        return pause <= LONGEST_PAUSE and all(
            way[-1] <= pause * max(2 * (way[:-1] / seconds[:-1]).max(initial=0.0), unseen)
            for way, unseen in zip(self._manifold.motion(step), (UNSEEN, UNSEEN_TURN),
                                   strict=True))

    def known_until(self, arrivals: Indices, stamps: Indices) -> Indices:
        """
        Return up to which stamp odometry had come when each loop could first be used, (m,) [ns].

        Only keyframes of that time are candidates, so a loop becomes the same factor whenever an
        update happens to look for it.
        """
        times = self._stamps.view()
        reached: Indices = np.maximum(arrivals, times[np.searchsorted(times, stamps)])
        return reached

    def nearest_keyframe(self, stamps: Indices, known: Indices) -> Indices:
        """Return the keyframe nearest to each stamp among those up to `known`, (m,)."""
        keyframes = self.keyframe_stamps
        last = np.searchsorted(keyframes, known, side='right') - 1
        after = np.minimum(np.searchsorted(keyframes, stamps), last)
        before = np.maximum(after - 1, 0)
        nearer_before = stamps - keyframes[before] <= keyframes[after] - stamps
        nearest: Indices = np.where(nearer_before, before, after)
        return nearest

    def at(self, stamps: Indices) -> Array:
        """Return the poses at `stamps`, interpolated between samples, (m, p)."""
        times, poses = self._stamps.view(), self._poses.view()
        after = np.clip(np.searchsorted(times, stamps), min(1, len(times) - 1), len(times) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(times[after] - times[before], 1)
        fraction = (stamps - times[before]) / span
        return self._manifold.interpolate(poses[before], poses[after], fraction)
