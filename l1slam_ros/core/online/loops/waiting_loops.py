# SPDX-License-Identifier: Apache-2.0
"""Loop closures that wait for odometry to reach their times, or for their time to be over."""

import heapq
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import (
    LEAST_VARIANCE,
    MOST_VARIANCE,
    Mask,
    at_most,
    bounds,
    filled,
    or_model,
    silenced,
    silent_components,
    usable,
)
from l1slam_ros.core.graph.measurements import LoopClosure


@dataclass(frozen=True)
class WaitingLoop:
    """
    A loop, and what it says on the manifold.

    arrival, begin, end : times [ns], when it came, and what its stamps mean; measurement : (1, p);
    covariance : (1, d, d), sound, zeros where it says nothing; key : what equal loops have in
    common.
    """

    loop: LoopClosure
    arrival: int
    begin: int
    end: int
    measurement: Array
    covariance: Array
    key: bytes


class WaitingLoops:
    """Loops by the times they wait for; each costs O(log n) once, however long it waits."""

    def __init__(self) -> None:
        self._loops: dict[int, WaitingLoop] = {}
        self._by_end: list[tuple[int, int]] = []
        self._by_arrival: deque[int] = deque()
        self._count = 0
        self._stamps: Indices | None = None

    def __len__(self) -> int:
        return len(self._loops)

    def all(self) -> Iterable[WaitingLoop]:
        """Return the loops in the order they came."""
        return self._loops.values()

    def add(self, waiting: WaitingLoop) -> None:
        """Add a loop, which comes not before those that are there."""
        self._loops[self._count] = waiting
        heapq.heappush(self._by_end, (waiting.end, self._count))
        self._by_arrival.append(self._count)
        self._count += 1
        self._stamps = None

    def is_due(self, now: int) -> bool:
        """Tell whether odometry has reached the times of any loop."""
        return bool(self._by_end) and self._by_end[0][0] <= now

    def due(self, now: int) -> list[WaitingLoop]:
        """Take out the loops whose times odometry has reached by `now`, in the order they came."""
        due = []
        while self._by_end and self._by_end[0][0] <= now:
            _, number = heapq.heappop(self._by_end)
            if number in self._loops:  # else it has expired
                due.append(number)
        return [self._take(number) for number in sorted(due)]

    def expired(self, since: int) -> list[WaitingLoop]:
        """Take out the loops that came before `since`, in the order they came."""
        expired = []
        while self._by_arrival:
            number = self._by_arrival[0]
            if number in self._loops:  # else it was due
                if self._loops[number].arrival >= since:
                    break
                expired.append(self._take(number))
            self._by_arrival.popleft()
        return expired

    def begin_anew(self, time: Callable[[int], int], arrival: int | None = None) -> None:
        """
        Look anew what stamps mean: the odometry went back in time.

        time : of a stamp; arrival : when all are to have come, None: as they did
        """
        self._loops = {number: replace(
            one, begin=time(one.loop.stamps[0]), end=time(one.loop.stamp),
            arrival=one.arrival if arrival is None else arrival)
            for number, one in self._loops.items()}
        self._by_end = [(one.end, number) for number, one in self._loops.items()]
        heapq.heapify(self._by_end)

    def arrivals(self, now: int) -> tuple[tuple[LoopClosure, int], ...]:
        """Return each loop and how long it has waited until `now`, in the order they came."""
        return tuple((one.loop, now - one.arrival) for one in self._loops.values())

    def stamps(self) -> Indices:
        """Return reference and end [ns] of each, (k, 2)."""
        if self._stamps is None:
            self._stamps = np.array(
                [one.loop.stamps for one in self._loops.values()], np.int64).reshape(-1, 2)
        return self._stamps

    def _take(self, number: int) -> WaitingLoop:
        self._stamps = None
        return self._loops.pop(number)


def carried(manifold: Manifold, used: list[WaitingLoop], to_reference: Array,
            to_keyframe: Array) -> tuple[Array, Array, Mask]:
    """
    Return what loops say between keyframes near their times.

    Parameters
    ----------
    to_reference : (m, p) the robot at the reference, seen from the first keyframe; an absolute
        pose has none
    to_keyframe : (m, p) the second keyframe, seen from the robot at the end

    Returns
    -------
    measurement : (m, p); covariance : (m, d, d) in the axes of the keyframe. A loop that leaves
        components unsaid keeps its own axes, the way being short; one without a heading goes that
        way in a direction unknown, which is noise.
    sound : (m,) bool, the covariance is one: a heading nearly unknown, at the end of a long lever,
        leaves rounding where position was.

    """
    stated = np.concatenate([one.measurement for one in used])
    covariance = np.concatenate([one.covariance for one in used])
    absolute = np.array([one.loop.is_absolute for one in used])
    silent = np.diagonal(covariance, axis1=1, axis2=2) == 0
    unturned = silent[:, manifold.ROTATION].any(axis=1)
    measurement = np.where(absolute[:, None], stated, manifold.compose(to_reference, stated))
    measurement = np.where(unturned[:, None], measurement,
                           manifold.compose(measurement, to_keyframe))
    # The error lives in the axes of the measured pose; see it from the keyframe instead.
    Ad = manifold.adjoint(manifold.inverse(to_keyframe))
    turned = Ad @ covariance @ Ad.transpose(0, 2, 1)
    if not silent.any():
        return measurement, turned, usable(turned)
    way = manifold.local(manifold.identity(len(used)), to_keyframe)
    lost = np.zeros(silent.shape)
    lost[:, manifold.TRANSLATION] = (way[:, manifold.TRANSLATION] ** 2).mean(axis=1)[:, None]
    kept = covariance + (lost * (unturned[:, None] & ~silent))[:, :, None] * np.eye(lost.shape[1])
    covariance = np.where(silent.any(axis=1)[:, None, None], kept, turned)
    return measurement, covariance, usable(filled(covariance, silent))


def loop_covariance(stated: Array, model: Array | None,
                    verbatim: bool) -> tuple[Array | None, list[tuple[float, float]]]:
    """
    Return a covariance by what a loop states, (1, d, d), and variances found and used instead.

    Zeros stand for what is left unsaid. Where nothing can be used it is the model.

    Parameters
    ----------
    stated : (1, d, d) of a message
    model : (d, d); None for an absolute pose, there is no model of these: None is returned then
    verbatim : as stated, though its variances be none of a measurement

    """
    silent = silent_components(stated, absolute=model is None)
    whole = filled(stated, silent)
    if silent.all() or not usable(whole)[0]:
        return None if model is None else model[None], []
    if verbatim:
        return silenced(stated, silent), []
    cut, large = at_most(whole, MOST_VARIANCE)
    used, small = or_model(cut, LEAST_VARIANCE * np.eye(len(cut[0])) if model is None else model)
    return silenced(used, silent), bounds(whole, used, large | small)


def said(manifold: Manifold, loop: LoopClosure, covariance: Array) -> Array:
    """Return what a loop measures, (1, p), without a rotation that it leaves unsaid."""
    measurement = manifold.from_pose3(loop.pose3[None])
    if np.diagonal(covariance[0])[manifold.ROTATION].all():
        return measurement
    pose = manifold.local(manifold.identity(1), measurement)
    pose[:, manifold.ROTATION] = 0.0
    return manifold.retract(manifold.identity(1), pose)
