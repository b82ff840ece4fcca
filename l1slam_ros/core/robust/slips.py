# SPDX-License-Identifier: Apache-2.0
"""
Odometry that lies: found by what the loops across a slip have in common.

In: a robust solve in which nothing more can be believed. Out: one in which an odometry factor is
left out, and the loops that were refused because of it are accepted.

Three ways lead to a factor that may lie: it moves as the robot never did; believed loops across
speak against it; or refused loops across agree with each other (`pairwise_consistency`). Each is
tried, and counts when leaving it out brings more loops in than it costs, of several places.
"""

from collections.abc import Callable, Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.robust.gating import DOUBT, log_odds_of_false
from l1slam_ros.core.robust.innovation import (
    chi2_quantile,
    claimed_volume,
    exact_squares,
    innovations,
)
from l1slam_ros.core.robust.pairwise_consistency import accord, weakest_steps
from l1slam_ros.core.robust.rounds import Growth

# So many loops more have to come in without the factor, and loops of that many groups to span it.
VOTES = 3
# So many steps of unusual motion are tried.
_TRIED = 2
# So many loops judge where a slip is, and of those that agree so many say how it is mended.
_JURY, _PROPOSALS = 500, 20
# A long way is searched by so many places at a time.
_AT_A_TIME = 20


def without_slip(growth: Growth) -> Growth | None:
    """Return a state without an odometry factor that loops agree is wrong; None: there is none."""
    if len(growth.undecided_loops()) < VOTES:
        return None
    before = np.count_nonzero(growth.accepted)
    for attempt in (_without_unusual, _without_worst, _mended):
        for trial in attempt(growth):
            _believe(trial)
            gained = np.count_nonzero(trial.accepted) - before
            left_out = np.flatnonzero(growth.accepted & ~trial.accepted & ~growth.is_loop)
            voters = trial.heads(_across(trial, left_out))
            if gained >= VOTES and len(voters) >= VOTES and _is_gross(trial, left_out):
                return trial
    return None


def _is_gross(growth: Growth, left_out: Indices) -> bool:
    """Return whether odometry factors lie, all others being as noisy as they say at least."""
    trial = growth.copy()
    trial.take_at_their_word()
    trial.settle()
    square = exact_squares(trial.part(left_out), trial.poses, trial.posterior)
    steps, freedom = np.count_nonzero(~growth.is_loop), growth.factors.freedom[left_out]
    return bool((square > chi2_quantile(1 - DOUBT / steps, freedom)).all())


def _believe(growth: Growth) -> None:
    """Accept the loops that can be believed, round by round."""
    while len(news := growth.believable(growth.undecided_loops())):
        growth.accepted[news] = True
        growth.settle()


def _across(growth: Growth, left_out: Indices) -> Indices:
    """Return the accepted loops across any of the odometry factors left out, (k,)."""
    steps = np.sort(growth.low[left_out])
    spans = np.searchsorted(steps, growth.low) < np.searchsorted(steps, growth.high)
    across: Indices = np.flatnonzero(growth.accepted & growth.is_loop & spans)
    return across


def _without_unusual(growth: Growth) -> Iterator[Growth]:
    """Leave out an odometry factor that moves as the robot never did."""
    rows = np.flatnonzero(growth.accepted & ~growth.is_loop)
    square = unusual_motion(growth.graph, growth.forward[rows])
    most = np.argsort(-square, kind='stable')[:_TRIED]
    limit = chi2_quantile(1 - DOUBT / len(rows), growth.factors.freedom[rows[most]])
    for row in rows[most[square[most] > limit]].tolist():
        trial = growth.copy()
        trial.accepted[row] = False
        trial.settle()
        yield trial


def unusual_motion(graph: FactorGraph, Z: Array) -> Array:
    """
    Return how far motions Z (k, p) are from how the odometry moves, (k,) squared sigmas.

    Motions are taken to be normal: a robot does not jump.
    """
    manifold, measured = graph.manifold, ends_in_time(graph)[2][graph.between.is_odometry]
    usual = manifold.local(manifold.identity(len(measured)), measured)
    mean = usual.mean(axis=0)
    precision = np.linalg.pinv((usual - mean).T @ (usual - mean) / len(usual), hermitian=True)
    off = manifold.local(manifold.identity(len(Z)), Z) - mean
    square: Array = np.einsum('mi,ij,mj->m', off, precision, off)
    return square


def _without_worst(growth: Growth) -> Iterator[Growth]:
    """Leave out the odometry factor that all others speak against."""
    inside = np.flatnonzero(growth.accepted)
    against = np.where(growth.is_loop[inside], 0.0, growth.posterior.left_out())
    limit = chi2_quantile(1 - DOUBT / len(inside), growth.factors.freedom[inside])
    if (against < limit).all():
        return
    trial, worst = growth.copy(), int(inside[np.argmax(against)])
    # Steps between which no believed loop ends share what speaks against them.
    run = _run_about(worst, trial.low, inside[against > against.max() / 2])
    within = _ending_within(trial, run)
    trial.accepted[worst] = False
    trial.accepted[within] = trial.trusted[within]
    trial.settle()
    jury = trial.some(within[~trial.accepted[within]], _JURY)
    slipped = _likeliest(trial, jury, run, lambda step: _slipped_elsewhere(trial, worst, step))
    trial.accepted[worst], trial.accepted[slipped] = True, False
    trial.poses = _slipped_elsewhere(trial, worst, int(trial.low[slipped]))
    trial.settle()
    yield trial


def _ending_within(growth: Growth, run: Indices) -> Indices:
    """Return the loops that end between the steps of a run of odometry factors, (k,)."""
    first, last = growth.low[run[0]], growth.low[run[-1]]
    within = [(end > first) & (end <= last) for end in (growth.low, growth.high)]
    ending: Indices = np.flatnonzero(growth.is_loop & np.any(within, axis=0))
    return ending


def _likeliest(
    growth: Growth, jury: Indices, run: Indices, slipped_at: Callable[[int], Array]
) -> int:
    """
    Return which of a run of odometry factors slipped.

    That with whose poses, `slipped_at(step)` (n, p), a jury of loops fits best; of those between
    which none of these loops ends, the one whose motion is more usual so than as measured.
    """
    steps = growth.low[run]
    first = np.unique(_places(growth, jury, steps), return_index=True)[1]
    while len(first) > 1:
        stride = -(-len(first) // _AT_A_TIME)
        support = [_support(growth, jury, slipped_at(step)).sum()
                   for step in steps[first[::stride]].tolist()]
        best = stride * int(np.argmax(support))
        first = first[max(best - stride + 1, 0):best + stride]
    fits = _support(growth, jury, slipped_at(int(steps[first[0]]))) > 0
    place = _places(growth, jury[fits], steps)
    alike = np.flatnonzero(place == place[first[0]])
    moved = np.concatenate([_step_of(growth, slipped_at(step), step)
                            for step in steps[alike].tolist()])
    motions = np.concatenate((growth.forward[run[alike]], moved))
    measured, mended = unusual_motion(growth.graph, motions).reshape(2, -1)
    return int(run[alike[np.argmax(measured - mended)]])


def _places(growth: Growth, loops: Indices, steps: Indices) -> Indices:
    """Return of steps (k,) a number each, the same where no loop ends between them, (k,)."""
    ends = np.unique(np.concatenate((growth.low[loops], growth.high[loops])))
    return np.searchsorted(ends, steps, side='right')


def _step_of(growth: Growth, poses: Array, step: int) -> Array:
    return growth.graph.manifold.between(poses[step, None], poses[step + 1, None])


def _run_about(worst: int, low: Indices, suspects: Indices) -> Indices:
    """Return those of some odometry factors that follow one another up to the worst and on."""
    suspects = suspects[np.argsort(low[suspects])]
    runs = np.cumsum(np.diff(low[suspects], prepend=-1) > 1)
    run: Indices = suspects[runs == runs[suspects == worst]]
    return run


def _slipped_elsewhere(growth: Growth, worst: int, step: int) -> Array:
    """Return the poses if the odometry did not slip at the factor `worst` but at another step."""
    manifold, poses = growth.graph.manifold, growth.poses
    motion = _motion_to_fit(growth, poses, worst)
    part = slice(growth.high[worst], step + 1)
    if step < growth.low[worst]:
        motion, part = manifold.inverse(motion), slice(step + 1, growth.high[worst])
    moved = poses.copy()
    moved[part] = manifold.compose(np.broadcast_to(motion, poses[part].shape), poses[part])
    return moved


def _mended(growth: Growth) -> Iterator[Growth]:
    """Leave out an odometry factor that most refused loops span in accord."""
    agreed, _ = accord(growth)
    if len(growth.heads(agreed)) < VOTES:
        return
    low, weakest = growth.low, weakest_steps(growth, agreed)
    odometry = np.flatnonzero(~growth.is_loop & np.isin(low, weakest))
    odometry = odometry[np.argsort(low[odometry], kind='stable')]
    runs = np.split(odometry, np.flatnonzero(np.diff(low[odometry]) > 1) + 1)
    square = unusual_motion(growth.graph, growth.forward)
    for run in sorted(runs, key=lambda run: -square[run].max())[:_TRIED]:
        yield _mended_within(growth, agreed, run)


def _mended_within(growth: Growth, agreed: Indices, run: Indices) -> Growth:
    """Leave out one of a run of odometry factors, so that most loops across agree."""
    trial, low, high = growth.copy(), growth.low, growth.high
    first, last = int(low[run[0]]), int(low[run[-1]])
    affected = growth.is_loop & (low <= last) & (high > first)
    trial.accepted &= ~affected | growth.trusted
    trial.settle()
    affected &= ~trial.accepted
    jury, poses = trial.some(np.flatnonzero(affected), _JURY), trial.poses
    loop = max(trial.some(agreed, _PROPOSALS).tolist(), key=lambda loop: _support(
        trial, jury, _mended_poses(trial, poses, loop, first)).sum())
    # Where exactly it is, only those tell that span some of the steps.
    jury = trial.some(np.flatnonzero(affected & ((low > first) | (high <= last))), _JURY)
    slipped = _likeliest(trial, jury, run, lambda step: _mended_poses(trial, poses, loop, step))
    trial.poses = _mended_poses(trial, poses, loop, int(low[slipped]))
    trial.accepted[slipped] = False
    rows = np.flatnonzero(affected)
    trial.accepted[rows[_support(trial, rows, trial.poses) > 0]] = True
    trial.settle()
    return trial


def _support(growth: Growth, rows: Indices, poses: Array) -> Array:
    """Return the log odds of factors to be true at mended poses, 0 where not believed, (k,)."""
    if not len(rows):
        return np.zeros(0)
    graph = growth.part(rows)
    volume = claimed_volume(graph.manifold, poses, np.random.default_rng(0))
    found = innovations(graph, poses, growth.posterior, volume)
    # The loop that mended the poses is as uncertain as the one that is judged by it.
    fits = found.square < 2 * growth.gate(found.freedom)
    log_ratio = found.log_ratio(2.0)
    odds = log_odds_of_false(log_ratio[fits], int(np.count_nonzero(~fits)))
    return np.where(fits & (log_ratio > odds + np.log(1 / DOUBT - 1)), log_ratio - odds, 0.0)


def _mended_poses(growth: Growth, poses: Array, loop: int, step: int) -> Array:
    """Return the poses, those behind a step of the odometry moved as one so that a loop fits."""
    motion, behind = _motion_to_fit(growth, poses, loop), poses[step + 1:]
    moved = growth.graph.manifold.compose(np.broadcast_to(motion, behind.shape), behind)
    return np.concatenate((poses[: step + 1], moved))


def _motion_to_fit(growth: Growth, poses: Array, factor: int) -> Array:
    """Return how the later end of a factor is to be moved for the factor to fit, (1, p)."""
    manifold, low, high = growth.graph.manifold, growth.low[factor], growth.high[factor]
    start = with_world(manifold, poses)[low, None]
    wanted = manifold.compose(start, growth.forward[factor, None])
    return manifold.compose(wanted, manifold.inverse(poses[high, None]))
