# SPDX-License-Identifier: Apache-2.0
"""
How the graph grows: odometry samples and loop closures in, keyframes and factors out.

A loop closure names two times. It waits until odometry has reached both, is then carried to the
nearest keyframes by the raw odometry in between, and becomes a between factor.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.growing import GrowingArray
from l1slam_ros.core.keyframes import (
    KeyframeOptions,
    Motion,
    OdometryOptions,
    diagonal_covariance,
    reduced_covariance,
)
from l1slam_ros.core.manifold import Array, Indices, Manifold
from l1slam_ros.core.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.noise import information_from_covariance, usable
from l1slam_ros.core.options import Options, option


@dataclass(frozen=True)
class LoopOptions(Options):
    """How loop closures are read."""

    covariance_source: str = option(
        'message', 'message: as stated, the model where that is unusable; model: the sigmas below',
        '', choices=('message', 'model'))
    sigma_translation: float = option(0.1, 'model: of the position', 'm', 1e-9, 1e6)
    sigma_rotation: float = option(0.05, 'model: of the heading', 'rad', 1e-9, 1e6)
    wait: float = option(
        10.0, 'how long a loop for times not yet seen waits, on the clock of the odometry', 's',
        0, 1e9)


@dataclass(frozen=True)
class GrowthOptions(Options):
    """What makes keyframes and factors of messages."""

    keyframe: KeyframeOptions = KeyframeOptions()
    odometry: OdometryOptions = OdometryOptions()
    loop: LoopOptions = LoopOptions()


class GraphGrowth:
    """
    Grows a factor graph from messages.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `GrowthOptions`; may be replaced at any time

    Attributes
    ----------
    graph : the factor graph so far; loops enter it in `add_due_loops`
    refused : why loops were not used, cause -> count
    offset : (1, p) takes poses of the odometry frame to those kept here; the identity, but after
        `restore`, when odometry goes on from the last keyframe wherever its frame now begins

    """

    def __init__(self, manifold: Manifold, options: GrowthOptions):
        self.options = options
        self.graph = FactorGraph(manifold)
        self.refused: Counter[str] = Counter()
        self._stamps = GrowingArray((), np.int64)
        self._odometry = GrowingArray((manifold.POSE_SIZE,))
        self._keyframe_samples = GrowingArray((), np.int64)
        self._motion: Motion | None = None
        self._glued = True
        self.offset = manifold.identity(1)
        self._waiting: list[tuple[int, LoopClosure]] = []
        self._expired = GrowingArray((2,), np.int64)
        self._loop_stamps = GrowingArray((2,), np.int64)
        self._loop_rows = GrowingArray((), np.int64)

    @property
    def stamps(self) -> Indices:
        """Stamps of the keyframes, (n,) [ns]."""
        stamps: Indices = self._stamps.view()[self._keyframe_samples.view()]
        return stamps

    @property
    def odometry(self) -> Array:
        """Poses of the keyframes in the odometry frame, (n, p)."""
        poses: Array = self._odometry.view()[self._keyframe_samples.view()]
        return poses

    @property
    def n_waiting(self) -> int:
        """How many loops are not in the graph yet, nor refused."""
        return len(self._waiting)

    @property
    def loop_stamps(self) -> tuple[Indices, Indices, Indices]:
        """
        Stamps (reference, end) [ns] of the loops in the graph, waiting and expired, (k, 2) each.

        Those in the graph are in the order of `loop_rows`, to which they stay tied.
        """
        waiting = [(loop.reference_stamp, loop.stamp) for _, loop in self._waiting]
        return (self._loop_stamps.view(), np.array(waiting, np.int64).reshape(-1, 2),
                self._expired.view())

    @property
    def loop_rows(self) -> Indices:
        """Which between factors of the graph are loops, (k,)."""
        return self._loop_rows.view()

    def add_odometry(self, sample: OdometrySample) -> bool:
        """
        Add one sample; return whether it made a keyframe.

        Raises
        ------
        MessageError : `old_stamp`, the stamp is not after the last one; nothing is added.

        """
        manifold = self.graph.manifold
        pose = manifold.from_pose3(sample.pose3[None])
        if not len(self._stamps):
            self._append_sample(sample.stamp, pose)
            self._begin_keyframe(sample.stamp)
            return True
        last = int(self._stamps.view()[-1])
        if sample.stamp <= last:
            raise MessageError('old_stamp', f'odometry stamp {sample.stamp} ns is not after the '
                               f'last one, {last} ns')
        if not self._glued:
            self.offset = manifold.compose(self._odometry.view()[-1:], manifold.inverse(pose))
            self._glued = True
        pose = manifold.compose(self.offset, pose)
        increment = manifold.between(self._odometry.view()[-1:], pose)
        self._append_sample(sample.stamp, pose)
        assert self._motion is not None
        self._motion.add(sample, increment, (sample.stamp - last) * 1e-9, self.options.odometry)
        if not self._motion.is_keyframe(sample.stamp, self.options.keyframe):
            return False
        covariance = self._motion.covariance(self.options.odometry)
        information = information_from_covariance(covariance[None])
        measurement = self._motion.pose
        self._begin_keyframe(sample.stamp)
        k = self.graph.n_poses - 1
        self.graph.add_between(np.array([k - 1]), np.array([k]), measurement, information)
        return True

    def restore(self, graph: FactorGraph, stamps: Indices, poses: Array) -> None:
        """
        Take over a graph of an earlier run, its stamps (n,) [ns] and poses (n, p).

        The robot is taken to stand where that run ended; its odometry may begin anywhere.
        """
        self.graph = graph
        self._stamps.extend(stamps)
        self._odometry.extend(poses)
        self._keyframe_samples.extend(np.arange(len(stamps)))
        self._motion = Motion(graph.manifold, int(stamps[-1]))
        self._glued = False
        factors = graph.between
        rows = np.flatnonzero(~factors.is_odometry)
        ends = stamps[factors.pairs[rows]]
        self._note_loops(rows, np.sort(ends, axis=1))

    def add_loop(self, loop: LoopClosure) -> None:
        """Take a loop closure in; it becomes a factor in `add_due_loops`."""
        arrival = int(self._stamps.view()[-1]) if len(self._stamps) else 0
        self._waiting.append((arrival, loop))

    def add_due_loops(self) -> int:
        """
        Make factors of the waiting loops whose times odometry has reached; return how many.

        Loops that can never become one are counted in `refused`: `before_start` (a time before
        the first odometry), `same_keyframe`, `expired`.
        """
        if not self._waiting or not len(self._stamps):
            return 0
        first, now = (int(stamp) for stamp in self._stamps.view()[[0, -1]])
        due = [entry for entry in self._waiting if entry[1].stamp <= now]
        patience = int(self.options.loop.wait * 1e9)
        later = [entry for entry in self._waiting if entry[1].stamp > now]
        self._waiting = [entry for entry in later if now - max(entry[0], first) <= patience]
        gone = [entry[1] for entry in later if now - max(entry[0], first) > patience]
        self._expired.extend(np.array([(loop.reference_stamp, loop.stamp) for loop in gone],
                                      np.int64).reshape(-1, 2))
        self.refused['expired'] += len(gone)
        return self._add_loops(due) if due else 0

    def _add_loops(self, due: list[tuple[int, LoopClosure]]) -> int:
        manifold = self.graph.manifold
        loops = [loop for _, loop in due]
        stamps = np.array([(loop.reference_stamp, loop.stamp) for loop in loops])
        early = stamps[:, 0] < self._stamps.view()[0]
        known = self._known_until(np.array([arrival for arrival, _ in due]), stamps[:, 1])
        i, j = (self._nearest_keyframe(end, known) for end in stamps.T)
        same = (i == j) & ~early
        self.refused['before_start'] += int(early.sum())
        self.refused['same_keyframe'] += int(same.sum())
        keep = ~early & ~same
        if not keep.any():
            return 0
        loops = [loop for loop, kept in zip(loops, keep, strict=True) if kept]
        i, j, stamps = i[keep], j[keep], stamps[keep]
        to_reference = manifold.between(self.odometry[i], self._odometry_at(stamps[:, 0]))
        to_keyframe = manifold.between(self._odometry_at(stamps[:, 1]), self.odometry[j])
        measured = manifold.from_pose3(np.array([loop.pose3 for loop in loops]))
        measurement = manifold.compose(manifold.compose(to_reference, measured), to_keyframe)
        # The error lives in the axes of the measured pose; see it from the keyframe instead.
        Ad = manifold.adjoint(manifold.inverse(to_keyframe))
        covariance = Ad @ self._covariances(loops) @ Ad.transpose(0, 2, 1)
        # A heading nearly unknown, at the end of a long lever, leaves rounding where position was.
        covariance = self._or_model(covariance, usable(covariance))
        self.graph.add_between(i, j, measurement, information_from_covariance(covariance),
                               np.array([loop.trusted for loop in loops]))
        last = len(self.graph.between)
        self._note_loops(np.arange(last - len(loops), last), stamps)
        return len(loops)

    def _note_loops(self, rows: Indices, stamps: Indices) -> None:
        self._loop_rows.extend(rows)
        self._loop_stamps.extend(stamps)

    def _covariances(self, loops: list[LoopClosure]) -> Array:
        manifold = self.graph.manifold
        stated = np.array([reduced_covariance(manifold, loop.covariance) for loop in loops])
        return self._or_model(
            stated, usable(stated) & (self.options.loop.covariance_source == 'message'))

    def _or_model(self, covariance: Array, good: np.ndarray) -> Array:
        """Return the covariances (m, d, d) that are good, (m,), and the model for the others."""
        options = self.options.loop
        model = diagonal_covariance(
            self.graph.manifold, options.sigma_translation, options.sigma_rotation)
        return np.where(good[:, None, None], covariance, model)

    def _known_until(self, arrivals: Indices, stamps: Indices) -> Indices:
        """
        Return up to which stamp odometry had come when each loop could first be used, (m,) [ns].

        Only keyframes of that time are candidates, so a loop becomes the same factor whenever an
        update happens to look for it.
        """
        times = self._stamps.view()
        reached: Indices = np.maximum(arrivals, times[np.searchsorted(times, stamps)])
        return reached

    def _nearest_keyframe(self, stamps: Indices, known: Indices) -> Indices:
        keyframes = self.stamps
        last = np.searchsorted(keyframes, known, side='right') - 1
        after = np.minimum(np.searchsorted(keyframes, stamps), last)
        before = np.maximum(after - 1, 0)
        nearer_before = stamps - keyframes[before] <= keyframes[after] - stamps
        nearest: Indices = np.where(nearer_before, before, after)
        return nearest

    def _odometry_at(self, stamps: Indices) -> Array:
        """Return the odometry poses at `stamps`, interpolated between samples, (m, p)."""
        times, poses = self._stamps.view(), self._odometry.view()
        after = np.clip(np.searchsorted(times, stamps), min(1, len(times) - 1), len(times) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(times[after] - times[before], 1)
        fraction = (stamps - times[before]) / span
        return self.graph.manifold.interpolate(poses[before], poses[after], fraction)

    def _append_sample(self, stamp: int, pose: Array) -> None:
        self._stamps.extend(np.array([stamp]))
        self._odometry.extend(pose)

    def _begin_keyframe(self, stamp: int) -> None:
        self._keyframe_samples.extend(np.array([len(self._stamps) - 1]))
        self.graph.add_poses(1)
        self._motion = Motion(self.graph.manifold, stamp)
