# SPDX-License-Identifier: Apache-2.0
"""
Refused loops that agree with each other.

In: a robust solve. Out: the largest camp of refused loops from one of which, and from how its ends
lie to those of the others, the others follow. Where no believed loop spans a slip of the odometry,
the two sides of it are pieces of their own, each right in itself: every true loop across is
refused, but all of them agree.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.geometry.quantiles import gamma_probability
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import (
    Posterior,
    claimed_volume,
    log_claims,
    log_likelihood_ratio,
)
from l1slam_ros.core.robust.rounds import Growth

# So many refused loops are asked.
_ASKED = 500
# Of each one so many pairs are looked at closely, those that differ least.
_NEAREST = 20


def accord(growth: Growth) -> tuple[Indices, float]:
    """
    Return the refused loops that agree with one of them, and that one: the surest such camp.

    None, where the volume that false loops could fill says that it is chance. Else also how
    probable so large a camp is by what loops elsewhere agree upon: lies can have a pattern.
    """
    rows = growth.undecided_loops()
    if not len(rows):
        return rows, 1.0
    found = growth.innovations(rows)
    rows = growth.some(rows[found.square > growth.gate(found.freedom)], _ASKED)
    if not len(rows):
        return rows, 1.0
    volume = claimed_volume(growth.graph.manifold, growth.poses, growth.rng)
    part = growth.part(rows)
    one, other, log_ratio = agreement(part, growth.poses, growth.posterior, volume,
                                      growth.gate(part.between.freedom))
    # Each could have agreed by chance with any of the others.
    sure, camps = log_ratio - np.log(len(rows)), [rows[other[one == k]] for k in range(len(rows))]
    votes = [sure[one == k][growth.heads(camp)].sum() for k, camp in enumerate(camps)]
    k = int(np.argmax(votes))
    if votes[k] < np.log(growth.graph.n_poses / DOUBT):
        return rows[:0], 1.0
    places = np.array([len(growth.heads(np.append(row, camp))) - 1
                       for row, camp in zip(rows, camps, strict=True)])
    camp = np.append(camps[k], rows[k])
    # How many agree by chance, those say that are not across what the camp is about.
    steps = weakest_steps(growth, camp)
    rest = places[(growth.low[rows] > steps[-1]) | (growth.high[rows] <= steps[0])]
    # Where all agree with more than one other, that is no chance but another camp.
    rate = min((rest.sum() + 1) / (len(rest) + 1), 1.0)
    return camp, len(rows) * gamma_probability(float(max(places[k], 1)), rate)


def weakest_steps(growth: Growth, camp: Indices) -> Indices:
    """Return the steps that most of a camp span, and of these the fewest believed loops, (k,)."""
    if not len(camp):
        return camp
    low, high, n = growth.low, growth.high, growth.graph.n_poses
    against = spanned(low[camp], high[camp], n)
    common = np.flatnonzero(against == against.max())
    believed = growth.accepted & growth.is_loop
    across = spanned(low[believed], high[believed], n)[common]
    weakest: Indices = common[across == across.min()]
    return weakest


def spanned(low: Indices, high: Indices, n: int) -> Indices:
    """Return how many factors span the step from each of n keyframes to the next, (n - 1,)."""
    change = np.zeros(n, np.int64)
    np.add.at(change, np.maximum(low, 0), 1)  # the world is before all keyframes
    np.add.at(change, high, -1)
    count: Indices = np.cumsum(change)[:-1]
    return count


def agreement(
    graph: FactorGraph, poses: Array, posterior: Posterior, log_volume: Array, limit: Array,
) -> tuple[Indices, Indices, Array]:
    """
    Return the pairs of between factors of a graph that rather agree than not, three (pairs,).

    The one and the other, each pair both ways round, those that agree best first, and the
    logarithm of how much likelier their difference is if they agree than by chance.

    From the one factor follows the other, if the map is right about how their first ends lie to
    each other, and their second ends; whatever it says of the factors themselves.

    Parameters
    ----------
    log_volume : (k,) see `claimed_volume`
    limit : (m,) of the squared difference of what follows and what is measured

    """
    from l1slam_ros.core.kernels.prediction import normalise

    manifold, (a, b) = graph.manifold, np.triu_indices(len(graph.between), 1)
    ends = ends_in_time(graph)
    error = _difference(manifold, ends, poses, a, b)
    scatter = np.linalg.pinv(error.T @ error, hermitian=True)
    near = np.argsort(np.einsum('mi,ij,mj->m', error, scatter, error), kind='stable')
    near = near[: _NEAREST * len(graph.between)]
    a, b, error = a[near], b[near], error[near]
    factors, fixed = graph.between, posterior.fixed
    roots = factors.sqrt_information[b]
    start = manifold.identity(len(a))
    there = manifold.retract(start, error)
    k, steps = manifold.TANGENT_SIZE, posterior.samples[:-1].transpose(2, 0, 1)
    covariance = np.tile(2 * np.eye(k), (len(a), 1, 1))
    for step in steps:
        moved = np.concatenate((poses[:fixed], manifold.retract(poses[fixed:], step)))
        here = manifold.retract(start, _difference(manifold, ends, moved, a, b))
        change = whiten(roots, manifold.local(there, here))
        covariance += change[:, :, None] * change[:, None, :] / len(steps)
    square, log_det = normalise(covariance, whiten(roots, error))
    log_ratio = log_likelihood_ratio(square, log_det, log_claims(factors, log_volume)[b],
                                     factors.freedom[b])
    good = np.flatnonzero((square < limit[b]) & (log_ratio > np.log(len(factors))))
    good = good[np.argsort(-log_ratio[good], kind='stable')]
    a, b, log_ratio = a[good], b[good], log_ratio[good]
    return np.stack((a, b), 1).ravel(), np.stack((b, a), 1).ravel(), np.repeat(log_ratio, 2)


def _difference(
    manifold: Manifold, ends: tuple[Indices, Indices, Array], poses: Array, a: Indices, b: Indices
) -> Array:
    """
    Return t2v(Z_b^-1 Z) for pairs of factors, (pairs, k); Z : what follows from a for b.

    ends : of `ends_in_time`
    """
    low, high, Z = ends
    poses = with_world(manifold, poses)
    first = manifold.between(poses[low[b]], poses[low[a]])
    second = manifold.between(poses[high[a]], poses[high[b]])
    return manifold.local(Z[b], manifold.compose(manifold.compose(first, Z[a]), second))
