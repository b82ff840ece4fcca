# SPDX-License-Identifier: Apache-2.0
"""
Loops that agree with each other, whatever the map says of them (pairwise consistency, PCM).

In: loops of a robust solve. Out: those that agree with one of them, in the surest way: from that
one, and from how its ends lie to those of the others, the others follow. Where nothing accepted
spans a slip of the odometry, or a gap, both sides are right in themselves: every true loop across
is far off, but all of them agree.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import claimed_volume, log_claims, log_likelihood_ratio
from l1slam_ros.core.robust.rounds import Growth

# So many loops are asked.
ASKED = 250
# Of each one so many pairs are looked at closely, those that differ least.
_NEAREST = 20


@dataclass(frozen=True)
class Group:
    """Loops that agree: rows (k,), the first one that with which all others do; their places."""

    rows: Indices
    places: Indices


NO_GROUP = Group(np.zeros(0, np.int64), np.zeros(0, np.int64))


def strongest_group(growth: Growth, rows: Indices) -> Group:
    """
    Return of some loops the group that agrees best, empty where that may be chance.

    Each place has one vote: the best log ratio of its loops, less ln m, for each could have agreed
    by chance with any of the m that were asked.
    """
    rows = growth.some(rows, ASKED)
    if len(rows) < 2:
        return NO_GROUP
    one, other, log_ratio = agreement(growth, rows)
    place = np.unique(growth.place[rows], return_inverse=True)[1]
    vote = np.zeros((len(rows), place.max() + 1))
    np.maximum.at(vote, (one, place[other]), log_ratio - np.log(len(rows)))
    own = np.arange(len(rows))
    vote[own, place] = 0.0
    evidence = vote.sum(axis=1)
    best = int(np.argmax(evidence))
    if evidence[best] < np.log(len(rows) / DOUBT):
        return NO_GROUP
    found = rows[np.concatenate(([best], other[one == best]))]
    return Group(found, np.unique(growth.place[found]))


def spanned(low: Indices, high: Indices, n: int) -> Indices:
    """Return how many factors span the step from each of n keyframes to the next, (n - 1,)."""
    change = np.zeros(n, np.int64)
    np.add.at(change, np.maximum(low, 0), 1)  # the world is before all keyframes
    np.add.at(change, high, -1)
    count: Indices = np.cumsum(change)[:-1]
    return count


def agreement(growth: Growth, rows: Indices) -> tuple[Indices, Indices, Array]:
    """
    Return the pairs of some loops that rather agree than not, three (pairs,).

    Positions of the one and the other in `rows`, each pair both ways round, and the logarithm of
    how much likelier their difference is if they agree than by chance.

    From the one loop follows the other, if the map is right about how their first ends lie to
    each other, and their second ends; whatever it says of the loops themselves.
    """
    from l1slam_ros.core.kernels.prediction import normalise

    manifold, poses = growth.graph.manifold, growth.poses
    first, second, Z = _ends_by_part(growth, rows)
    same_way = growth.part[first] * (growth.part.max() + 1) + growth.part[second]
    a, b = np.triu_indices(len(rows), 1)
    alike = same_way[a] == same_way[b]
    a, b = a[alike], b[alike]
    if not len(a):
        return a, b, np.zeros(0)
    ends = first, second, Z
    error = _difference(manifold, ends, poses, a, b)
    scatter = np.linalg.pinv(error.T @ error, hermitian=True)
    near = np.argsort(np.einsum('mi,ij,mj->m', error, scatter, error), kind='stable')
    near = near[: _NEAREST * len(rows)]
    a, b, error = a[near], b[near], error[near]
    factors, fixed = growth.subgraph(rows).between, growth.posterior.fixed
    roots = factors.sqrt_information[b]
    start = manifold.identity(len(a))
    there = manifold.retract(start, error)
    k, steps = manifold.TANGENT_SIZE, growth.posterior.samples[:-1].transpose(2, 0, 1)
    covariance = np.tile(2 * np.eye(k), (len(a), 1, 1))
    for step in steps:
        moved = np.concatenate((poses[:fixed], manifold.retract(poses[fixed:], step)))
        here = manifold.retract(start, _difference(manifold, ends, moved, a, b))
        change = whiten(roots, manifold.local(there, here))
        covariance += change[:, :, None] * change[:, None, :] / len(steps)
    square, log_det = normalise(covariance, whiten(roots, error))
    volume = claimed_volume(manifold, poses, np.random.default_rng(0))
    freedom = factors.freedom[b]
    log_ratio = log_likelihood_ratio(square, log_det, log_claims(factors, volume)[b], freedom)
    good = np.flatnonzero((square < growth.gate(freedom)) & (log_ratio > np.log(len(rows))))
    a, b, log_ratio = a[good], b[good], log_ratio[good]
    return np.concatenate((a, b)), np.concatenate((b, a)), np.tile(log_ratio, 2)


def _ends_by_part(growth: Growth, rows: Indices) -> tuple[Indices, Indices, Array]:
    """Return loops as from an earlier part to a later one, within a part to the later keyframe."""
    low, high, Z = growth.low[rows], growth.high[rows], growth.forward[rows]
    turn = growth.part[low] > growth.part[high]
    return (np.where(turn, high, low), np.where(turn, low, high),
            np.where(turn[:, None], growth.graph.manifold.inverse(Z), Z))


def _difference(
    manifold: Manifold, ends: tuple[Indices, Indices, Array], poses: Array, a: Indices, b: Indices
) -> Array:
    """Return t2v(Z_b^-1 Z) for pairs of factors, (pairs, k); Z : what follows from a for b."""
    low, high, Z = ends
    poses = with_world(manifold, poses)
    first = manifold.between(poses[low[b]], poses[low[a]])
    second = manifold.between(poses[high[a]], poses[high[b]])
    return manifold.local(Z[b], manifold.compose(manifold.compose(first, Z[a]), second))
