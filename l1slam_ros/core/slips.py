# SPDX-License-Identifier: Apache-2.0
"""
Odometry that lies: one gross slip, which all loops across it agree upon.

In: a map in which no more loop can be believed. Out: the odometry factor that slipped, the loops
that say so, and poses with the slip mended. Where no believed loop spans a factor, the two sides of
it are rigid pieces each, and any refused loop across says how they lie to each other; true ones
say the same.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.belief import one_of_each_group
from l1slam_ros.core.graph import BetweenFactors
from l1slam_ros.core.manifold import Array, Indices, Manifold
from l1slam_ros.core.noise import Mask

# So many loops across are asked how the sides lie, and so many judge each answer.
_PROPOSERS, _JURY = 30, 300
# Loops of this many groups have to agree: one may be one and the same mistake.
_VOTES = 3

# From loops and poses to the loops' log odds of being true there, (k,).
Judge = Callable[[Indices, Array], Array]


@dataclass(frozen=True)
class Slip:
    """
    A slip and its mending.

    factor : the odometry factor; loops : (k,) that agree about it; poses : (n, p) mended.
    """

    factor: int
    loops: Indices
    poses: Array


def find_slip(
    manifold: Manifold, factors: BetweenFactors, accepted: Mask, refused: Indices, poses: Array,
    judge: Judge, apart: int,
) -> Slip | None:
    """
    Return the slip that most loops agree upon, if any.

    Parameters
    ----------
    accepted : (m,) bool; refused : (k,) loops, the best predicted first
    judge : log odds of loops at poses
    apart : least distance of loops with a vote each, see `one_of_each_group`

    """
    best: Slip | None = None
    for first, last in bridges(factors, accepted, len(poses)):
        low = np.minimum(factors.i[refused], factors.j[refused])
        high = np.maximum(factors.i[refused], factors.j[refused])
        jury = refused[(low <= last) & (high > first)][:_JURY]
        for loop in jury[:_PROPOSERS]:
            k = _most_spanned(factors, jury, first, last)
            mended = _mended(manifold, factors, poses, loop, k)
            log_odds = judge(jury, mended)
            agree = jury[np.argsort(-log_odds, kind='stable')][: np.count_nonzero(log_odds > 0)]
            votes = one_of_each_group(factors.i[agree], factors.j[agree], apart)
            if len(votes) >= _VOTES and (best is None or len(agree) > len(best.loops)):
                k = _most_spanned(factors, agree, first, last)
                best = Slip(_odometry(factors, k), agree, mended)
    return best


def bridges(factors: BetweenFactors, accepted: Mask, n: int) -> list[tuple[int, int]]:
    """
    Return the runs of odometry factors that nothing accepted spans: first, last (of `spanned`).

    Factor k is that of the keyframes k and k + 1.
    """
    loops = accepted & ~factors.is_odometry
    free = np.flatnonzero(spanned(factors.i[loops], factors.j[loops], n) == 0)
    starts = np.flatnonzero(np.diff(free, prepend=-2) > 1)
    ends = np.append(starts[1:], len(free)) - 1
    return list(zip(free[starts].tolist(), free[ends].tolist(), strict=True))


def spanned(i: Indices, j: Indices, n: int) -> Indices:
    """Return how many of the factors (i, j) span the step from each keyframe to the next."""
    change = np.zeros(n, np.int64)
    np.add.at(change, np.minimum(i, j), 1)
    np.add.at(change, np.maximum(i, j), -1)
    count: Indices = np.cumsum(change)[:-1]
    return count


def _most_spanned(factors: BetweenFactors, loops: Indices, first: int, last: int) -> int:
    count = spanned(factors.i[loops], factors.j[loops], int(factors.j.max()) + 2)
    return first + int(np.argmax(count[first : last + 1]))


def _odometry(factors: BetweenFactors, k: int) -> int:
    low = np.minimum(factors.i, factors.j)
    return int(np.flatnonzero(factors.is_odometry & (low == k))[0])


def _mended(manifold: Manifold, factors: BetweenFactors, poses: Array, loop: int,
            k: int) -> Array:
    """Return the poses, those behind keyframe k moved as one so that a loop fits."""
    i, j, measurement = factors.i[loop], factors.j[loop], factors.measurement[loop][None]
    if i > j:
        i, j, measurement = j, i, manifold.inverse(measurement)
    wanted = manifold.compose(poses[i][None], measurement)
    motion = manifold.compose(wanted, manifold.inverse(poses[j][None]))
    behind = poses[k + 1:]
    moved = manifold.compose(np.broadcast_to(motion, behind.shape), behind)
    return np.concatenate((poses[: k + 1], moved))
