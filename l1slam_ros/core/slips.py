# SPDX-License-Identifier: Apache-2.0
"""
Odometry that lies: found by what the loops across a slip have in common.

In: a robust solve in which nothing more can be believed. Out: one in which an odometry factor is
left out, and the loops that were refused because of it are accepted.

Where believed loops span a slip, they speak against it. Where none does, the two sides of it are
pieces of their own; every true loop across is refused, but from one of them, and from how its ends
lie to those of another, follows the other one.
"""

import numpy as np

from l1slam_ros.core.belief import DOUBT, log_odds_of_false
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.linearise import anchor
from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.noise import whiten
from l1slam_ros.core.prediction import (
    Posterior,
    chi2_quantile,
    claimed_volume,
    innovations,
    log_likelihood_ratio,
)
from l1slam_ros.core.robust_growth import Growth

# Loops of that many groups have to agree upon a slip.
_VOTES = 3
# So many refused loops are asked, and of those that agree so many say how the slip is mended.
_JURY, _PROPOSALS = 500, 20
# Of each one so many pairs are looked at closely, those that differ least.
_NEAREST = 20


def without_slip(growth: Growth) -> Growth | None:
    """Return a state without an odometry factor that loops agree is wrong; None: there is none."""
    before = np.count_nonzero(growth.accepted)
    for attempt in (_without_worst, _mended):
        trial = growth.copy()
        votes = attempt(trial)
        trial.accepted[votes] = True
        gained = np.count_nonzero(trial.accepted) - before
        if len(growth.heads(votes)) >= _VOTES and gained >= _VOTES:
            return trial
    return None


def _without_worst(growth: Growth) -> Indices:
    """Leave out the odometry factor that all others speak against; return who agrees, (k,)."""
    inside = np.flatnonzero(growth.accepted)
    against = np.where(growth.is_loop[inside], 0.0, growth.posterior.left_out())
    k = growth.graph.manifold.TANGENT_SIZE
    if against.max() < chi2_quantile(1 - DOUBT / len(inside), k):
        return np.zeros(0, np.int64)
    worst = int(inside[np.argmax(against)])
    growth.accepted[worst] = False
    growth.settle()
    rows = growth.undecided()
    rows = rows[growth.is_loop[rows]]
    # Steps between which no believed loop ends share what speaks against them.
    run = _run_about(worst, growth.low, inside[against > against.max() / 2])
    slipped = _best_place(growth, worst, run, rows)
    growth.accepted[worst], growth.accepted[slipped] = True, False
    growth.poses = _slipped_elsewhere(growth, worst, int(growth.low[slipped]))
    growth.settle()
    return growth.believable(rows)


def _best_place(growth: Growth, worst: int, run: Indices, rows: Indices) -> int:
    """Return at which of a run of odometry factors the refused loops that end there fit best."""
    first, last, ends = growth.low[run[0]], growth.low[run[-1]], (growth.low, growth.high)
    inside = np.any([(end[rows] > first) & (end[rows] <= last) for end in ends], axis=0)
    jury = _some(growth, rows[inside], _JURY)
    return int(max(run, key=lambda factor: _support(
        growth, jury, _slipped_elsewhere(growth, worst, int(growth.low[factor]))).sum()))


def _run_about(worst: int, low: Indices, suspects: Indices) -> Indices:
    """Return those of some odometry factors that follow one another up to the worst and on."""
    suspects = suspects[np.argsort(low[suspects])]
    runs = np.cumsum(np.diff(low[suspects], prepend=-1) > 1)
    run: Indices = suspects[runs == runs[suspects == worst]]
    return run


def _slipped_elsewhere(growth: Growth, worst: int, step: int) -> Array:
    """Return the poses if the odometry did not slip at the factor `worst` but at another step."""
    manifold, factors, poses = growth.graph.manifold, growth.factors, growth.poses
    i, j = factors.i[worst], factors.j[worst]
    measurement = factors.measurement[worst][None]
    if i > j:
        i, j, measurement = j, i, manifold.inverse(measurement)
    ahead = manifold.compose(poses[i][None], measurement)
    motion = manifold.compose(ahead, manifold.inverse(poses[j][None]))
    part = slice(j, step + 1)
    if step < i:
        motion, part = manifold.inverse(motion), slice(step + 1, j)
    moved = poses.copy()
    moved[part] = manifold.compose(np.broadcast_to(motion, poses[part].shape), poses[part])
    return moved


def _mended(growth: Growth) -> Indices:
    """Leave out the odometry factor that most refused loops span in accord; as above."""
    agreed = _accord(growth)
    if len(growth.heads(agreed)) < _VOTES:
        return agreed
    low, high = growth.low, growth.high
    across = spanned(low[agreed], high[agreed], growth.graph.n_poses)
    steps = np.flatnonzero(across == across.max())
    affected = growth.is_loop & (low <= steps[-1]) & (high > steps[0])
    growth.accepted &= ~affected | growth.trusted
    growth.settle()
    affected &= ~growth.accepted
    jury = _some(growth, np.flatnonzero(affected), _JURY)
    proposals = _some(growth, agreed, _PROPOSALS).tolist()
    loop, _ = _most_support(growth, jury, [(loop, int(steps[0])) for loop in proposals])
    # Where exactly it is, only those tell that span some of the steps.
    telling = affected & ((low > steps[0]) | (high <= steps[-1]))
    jury = _some(growth, np.flatnonzero(telling), _JURY)
    loop, step = _most_support(growth, jury, [(loop, step) for step in steps.tolist()])
    growth.poses = mended(growth.graph, growth.poses, loop, step)
    growth.accepted &= growth.is_loop | (low != step)
    rows = np.flatnonzero(affected)
    return rows[_support(growth, rows, growth.poses) > 0]


def _accord(growth: Growth) -> Indices:
    """Return the refused loops that agree with one of them, and that one: the surest such camp."""
    rows = growth.undecided()
    rows = rows[growth.is_loop[rows]]
    if not len(rows):
        return rows
    rows = _some(growth, rows[growth.innovations(rows).square > growth.gate()], _JURY)
    if len(rows) < _VOTES:
        return rows
    volume = claimed_volume(growth.graph.manifold, growth.poses, growth.rng)
    one, other, log_ratio = agreement(growth.part(rows), growth.poses, growth.posterior, volume,
                                      growth.gate())
    camp, surest = rows[:0], float(np.log(growth.graph.n_poses / DOUBT))
    for k in range(len(rows)):
        mine = np.flatnonzero(one == k)
        mine = mine[np.argsort(-log_ratio[mine], kind='stable')]
        members = rows[other[mine]]
        # Each of them could have agreed by chance with any of the others.
        sure = (log_ratio[mine] - np.log(len(rows)))[growth.heads(members)].sum()
        if sure > surest:
            camp, surest = np.append(members, rows[k]), sure
    return camp


def _some(growth: Growth, rows: Indices, count: int) -> Indices:
    """Return so many factors of these, at random, or all."""
    chosen: Indices = growth.rng.permutation(rows)[:count]
    return chosen


def _most_support(
    growth: Growth, jury: Indices, proposals: list[tuple[int, int]]
) -> tuple[int, int]:
    """Return the loop and the step after which a jury fits best, see `mended`."""
    return max(proposals, key=lambda proposal: _support(
        growth, jury, mended(growth.graph, growth.poses, *proposal)).sum())


def _support(growth: Growth, rows: Indices, poses: Array) -> Array:
    """Return the log odds of factors to be true at mended poses, 0 where not believed, (k,)."""
    if not len(rows):
        return np.zeros(0)
    graph = growth.part(rows)
    volume = claimed_volume(graph.manifold, poses, np.random.default_rng(0))
    found = innovations(graph, poses, growth.posterior, volume)
    # The loop that mended the poses is as uncertain as the one that is judged by it.
    fits = found.square < 2 * growth.gate()
    log_ratio = found.log_ratio(2.0)
    odds = log_odds_of_false(log_ratio[fits], int(np.count_nonzero(~fits)))
    return np.where(fits & (log_ratio > odds + np.log(1 / DOUBT - 1)), log_ratio - odds, 0.0)


def spanned(low: Indices, high: Indices, n: int) -> Indices:
    """Return how many factors span the step from each of n keyframes to the next, (n - 1,)."""
    change = np.zeros(n, np.int64)
    np.add.at(change, low, 1)
    np.add.at(change, high, -1)
    count: Indices = np.cumsum(change)[:-1]
    return count


def mended(graph: FactorGraph, poses: Array, loop: int, step: int) -> Array:
    """Return the poses, those behind a step of the odometry moved as one so that a loop fits."""
    manifold, factors = graph.manifold, graph.between
    i, j, measurement = factors.i[loop], factors.j[loop], factors.measurement[loop][None]
    if i > j:
        i, j, measurement = j, i, manifold.inverse(measurement)
    wanted = manifold.compose(poses[i][None], measurement)
    motion = manifold.compose(wanted, manifold.inverse(poses[j][None]))
    behind = poses[step + 1:]
    moved = manifold.compose(np.broadcast_to(motion, behind.shape), behind)
    return np.concatenate((poses[: step + 1], moved))


def agreement(
    graph: FactorGraph, poses: Array, posterior: Posterior, log_volume: float, limit: float,
) -> tuple[Indices, Indices, Array]:
    """
    Return the pairs of between factors of a graph that rather agree than not, three (pairs,).

    The one and the other, each pair both ways round, and the logarithm of how much likelier their
    difference is if they agree than by chance.

    From the one factor follows the other, if the map is right about how their first ends lie to
    each other, and their second ends; whatever it says of the factors themselves.

    Parameters
    ----------
    log_volume : see `claimed_volume`
    limit : of the squared difference of what follows and what is measured, over its covariance

    """
    from l1slam_ros.core.kernels.prediction import normalise

    manifold, (a, b) = graph.manifold, np.triu_indices(len(graph.between), 1)
    error = _difference(graph, poses, a, b)
    scatter = np.linalg.inv(error.T @ error)
    near = np.argsort(np.einsum('mi,ij,mj->m', error, scatter, error), kind='stable')
    near = near[: _NEAREST * len(graph.between)]
    a, b, error = a[near], b[near], error[near]
    roots, fixed = graph.between.sqrt_information[b], anchor(graph)
    there = manifold.retract(manifold.identity(len(a)), error)
    k, steps = manifold.TANGENT_SIZE, posterior.samples[:-1].transpose(2, 0, 1)
    covariance = np.tile(2 * np.eye(k), (len(a), 1, 1))
    for step in steps:
        moved = np.concatenate((poses[:fixed], manifold.retract(poses[fixed:], step)))
        here = manifold.retract(manifold.identity(len(a)), _difference(graph, moved, a, b))
        change = whiten(roots, manifold.local(there, here))
        covariance += change[:, :, None] * change[:, None, :] / len(steps)
    square, log_det = normalise(covariance, whiten(roots, error))
    claim = log_volume + np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    log_ratio = log_likelihood_ratio(square, log_det, claim, k)
    good = (square < limit) & (log_ratio > np.log(len(graph.between)))
    return (np.concatenate((a[good], b[good])), np.concatenate((b[good], a[good])),
            np.tile(log_ratio[good], 2))


def _difference(graph: FactorGraph, poses: Array, a: Indices, b: Indices) -> Array:
    """Return t2v(Z_b^-1 Z) for pairs of factors, (pairs, k); Z : what follows from a for b."""
    manifold, factors = graph.manifold, graph.between
    backwards = (factors.i > factors.j)[:, None]
    Z = np.where(backwards, manifold.inverse(factors.measurement), factors.measurement)
    low, high = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    first = manifold.between(poses[low[b]], poses[low[a]])
    second = manifold.between(poses[high[a]], poses[high[b]])
    return manifold.local(Z[b], manifold.compose(manifold.compose(first, Z[a]), second))
