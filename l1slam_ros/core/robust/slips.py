# SPDX-License-Identifier: Apache-2.0
"""
Gaps and slips of the odometry: steps of which only the loops across can tell.

A gap is a slip whose place is known. Where both sides of a step are parts of their own, each right
in itself, the true loops across agree with each other (`pairwise_consistency`): parts are joined
where loops of two places or more do. A slip is suspected where an accepted factor of the odometry
is far off by what all others say, or where refused loops agree. Then slip and lies are compared:

    gain = excess(without) - excess(with) + gate (places won - places lost)

with the excess of chi2 over its freedom: the step is cut, the loops across are asked anew, and the
rounds go on from there. The slip is believed if it gains three gates, three places span it, and
the odometry factor is off by more than one in all its factors is by chance; and where its motion
is no jump, if the loops across are not of one street.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask, whiten
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import chi2_quantile, exact_squares
from l1slam_ros.core.robust.pairwise_consistency import (
    NO_GROUP,
    Group,
    spanned,
    strongest_group,
)
from l1slam_ros.core.robust.rounds import Growth

# Places that join two parts, and that span a slip, at least.
_JOINING, SPANNING = 2, 3
# Gates to be gained at least; and places won for each that is lost.
_GAIN, _WON = 3.0, 2.0
# So many steps are tried of those that may have slipped.
_TRIED = 2
# A jump like no other is so many times as unusual as what is.
_UNHEARD = 4.0


def join(growth: Growth) -> bool:
    """Move parts to where loops across agree that they are; return whether any was."""
    joined = False
    while (rows := growth.joining()).size:
        parts = growth.part[np.stack((growth.low[rows], growth.high[rows]))]
        pair = np.sort(parts, axis=0).T @ np.array([growth.graph.n_poses, 1])
        groups = [strongest_group(growth, rows[pair == one]) for one in np.unique(pair)]
        group = max(groups, key=lambda group: len(group.places))
        if len(group.places) < _JOINING:
            return joined
        _join_by(growth, group)
        joined = True
    return joined


def _join_by(growth: Growth, group: Group) -> None:
    """Move the later one of two parts to where the first loop of a group says, accept all."""
    manifold, loop = growth.graph.manifold, group.rows[0]
    fixed, moving = growth.low[loop], growth.high[loop]
    Z = growth.forward[loop, None]
    if growth.part[fixed] > growth.part[moving]:
        fixed, moving, Z = moving, fixed, manifold.inverse(Z)
    wanted = manifold.compose(growth.poses[fixed, None], Z)
    motion = manifold.compose(wanted, manifold.inverse(growth.poses[moving, None]))
    part = growth.part == growth.part[moving]
    growth.poses = growth.poses.copy()
    growth.poses[part] = manifold.compose(
        np.broadcast_to(motion, growth.poses[part].shape), growth.poses[part])
    growth.accepted[group.rows] = True
    growth.solve()


def without_slip(growth: Growth) -> Growth | None:
    """Return a state in which an odometry factor is cut that slipped; None: there is none."""
    states = [cut for step in _suspected(growth) if (cut := _without(growth, step))
              and _slipped(growth, cut, step)]
    return max(states, key=lambda cut: np.count_nonzero(cut.accepted), default=None)


def _without(growth: Growth, step: int) -> Growth | None:
    """Return the state after the rounds that follow if a step is cut; None: it falls apart."""
    state = growth.copy()
    state.cut[step] = True
    span = spanning(growth, step)
    state.accepted[span] = state.trusted[span]
    state.solve()
    if not join(state) or state.part[state.low[step]] != state.part[state.high[step]]:
        return None
    while len(news := state.believable(state.undecided())):
        state.accepted[news] = True
        state.solve()
    return state


def spanning(growth: Growth, step: int) -> Mask:
    """Return which loops span an odometry factor, (m,) bool."""
    span: Mask = growth.is_loop & (growth.low < growth.high[step]) & (
        growth.high > growth.low[step])
    return span


def _slipped(growth: Growth, cut: Growth, step: int) -> bool:
    """Return whether a step slipped rather than that the loops lie that say so."""
    with_, without = (np.unique(growth.place[state.accepted & growth.is_loop])
                      for state in (cut, growth))
    across = np.flatnonzero(cut.accepted & spanning(growth, step))
    won, lost = len(np.setdiff1d(with_, without)), len(np.setdiff1d(without, with_))
    gate = _gate(growth)
    gain = _excess(growth, cut.variance) - _excess(cut, cut.variance) + gate * (won - lost)
    sure = unheard_of(growth)[step] or (gain > _GAIN * gate and _is_gross(cut, step))
    if not sure or len(np.unique(growth.place[across])) < SPANNING:
        return False
    # A robot that moved as ever slipped only if it is not one street that says so.
    believed = won >= _WON * lost and (
        step in jumping(growth) or not growth.of_one_street(across, step))
    if not believed:
        growth.suspected.append(across)
    return bool(believed)


def _gate(growth: Growth) -> float:
    """Return the gate of a loop that says all there is to say."""
    return float(growth.gate(np.array([growth.graph.manifold.TANGENT_SIZE]))[0])


def _excess(growth: Growth, variance: Array) -> float:
    """Return chi2 less its freedom of the accepted factors that say anything, the noise given."""
    state = growth.copy()
    state.variance = variance
    rows = np.flatnonzero(state.accepted & ~state.cut)
    residual = whitened_residual(state.subgraph(rows), state.poses)
    return float((residual**2).sum() - state.factors.freedom[rows].sum())


def _is_gross(growth: Growth, step: int) -> bool:
    """Return whether a cut factor is off, all others being as noisy as they say at least."""
    state = growth.copy()
    state.take_at_their_word()
    state.solve()
    state.cut[step] = False
    alone = state.subgraph(np.array([step]))
    square = exact_squares(alone, state.poses, state.posterior)
    steps = np.count_nonzero(~growth.is_loop)
    return bool((square > chi2_quantile(1 - DOUBT / steps, alone.between.freedom)).all())


def refused(growth: Growth) -> Indices:
    """Return the undecided loops that do not fit, (k,)."""
    rows = growth.undecided()
    if len(rows):
        found = growth.innovations(rows)
        rows = rows[found.square > growth.gate(found.freedom)]
    return rows


def _suspected(growth: Growth) -> list[int]:
    """Return the odometry factors that may have slipped, the most unusual of each reason."""
    group, against = strongest_group(growth, refused(growth)), _against(growth)
    square, jumps = unusual_motion(growth.graph, growth.forward), jumping(growth)
    if len(group.places) < SPANNING:
        steps = np.count_nonzero(~growth.is_loop)
        limit = chi2_quantile(1 - DOUBT / steps, growth.factors.freedom[jumps])
        group, jumps = NO_GROUP, jumps[against[jumps] > limit]
    runs = (jumps, np.flatnonzero(unheard_of(growth)), _spoken_against(growth, against),
            weakest_steps(growth, group))
    suspected = np.unique(np.concatenate(
        [run[np.argsort(-square[run], kind='stable')[:_TRIED]] for run in runs]))
    return [int(step) for step in suspected[np.argsort(-square[suspected], kind='stable')]]


def jumping(growth: Growth) -> Indices:
    """Return the odometry factors that move as the robot hardly ever does, (k,)."""
    odometry = np.flatnonzero(~growth.is_loop & ~growth.cut)
    limit = chi2_quantile(1 - DOUBT / len(odometry), growth.factors.freedom[odometry])
    jumps: Indices = odometry[
        unusual_motion(growth.graph, growth.forward[odometry]) > limit]
    return jumps


def unheard_of(growth: Growth) -> Mask:
    """
    Return the few jumps like no other, (m,) bool, of which all others say that there was none.

    With the covariance R of the residual r, the innovation of a factor by all others is R^-1 r,
    and its covariance R^-1: is it likelier that the robot moved as always, or as was measured?
    """
    odometry = np.flatnonzero(~growth.is_loop & ~growth.cut)
    square = unusual_motion(growth.graph, growth.forward[odometry])
    order, unheard = np.argsort(-square, kind='stable'), np.zeros(len(growth.factors), bool)
    if len(order) <= _TRIED:
        return unheard
    rows = odometry[order[:_TRIED][square[order[:_TRIED]] > _UNHEARD * square[order[_TRIED]]]]
    manifold, at = growth.graph.manifold, np.searchsorted(np.flatnonzero(growth.accepted), rows)
    R, r = growth.posterior.moment[at], growth.posterior.residual[at]
    measured = np.linalg.pinv(R, hermitian=True) @ r[:, :, None]
    usual = manifold.local(manifold.identity(1), np.median(growth.forward[odometry], axis=0)[None])
    usual = manifold.retract(manifold.identity(1), usual)
    moved = measured + whiten(growth.subgraph(rows).between.sqrt_information, manifold.local(
        np.broadcast_to(usual, growth.forward[rows].shape), growth.forward[rows]))[:, :, None]
    likelier = [(e.transpose(0, 2, 1) @ R @ e)[:, 0, 0] for e in (moved, measured)]
    unheard[rows[likelier[0] < likelier[1]]] = True
    return unheard


def _against(growth: Growth) -> Array:
    """Return by how much all others speak against each odometry factor, (m,), as noisy as said."""
    against, noise = np.zeros(len(growth.factors)), growth.variance_at_their_word()[0]
    against[growth.accepted] = growth.posterior.left_out()
    against[growth.is_loop | growth.cut] = 0.0
    if growth.takes_at_their_word or against.max() < _GAIN * _gate(growth) * (
            noise / growth.variance[0]):
        return np.asarray(against * (growth.variance[0] / noise))
    state = growth.copy()
    state.take_at_their_word()
    state.solve()
    return _against(state)


def _spoken_against(growth: Growth, against: Array) -> Indices:
    """Return the odometry factors about the worst, (k,); none if to cut it could gain nothing."""
    if against.max() < _GAIN * _gate(growth):
        return np.zeros(0, np.int64)
    # Steps between which no accepted loop ends share what speaks against them.
    suspects = np.flatnonzero(against > against.max() / 2)
    suspects = suspects[np.argsort(growth.low[suspects])]
    runs = np.cumsum(np.diff(growth.low[suspects], prepend=-1) > 1)
    run: Indices = suspects[runs == runs[suspects == np.argmax(against)]]
    return run


def weakest_steps(growth: Growth, group: Group) -> Indices:
    """Return the odometry that most of a group span, and of it what the fewest accepted do."""
    if not len(group.rows):
        return group.rows
    low, high, n = growth.low, growth.high, growth.graph.n_poses
    against = spanned(low[group.rows], high[group.rows], n)
    common = np.flatnonzero(against == against.max())
    accepted = growth.accepted & growth.is_loop
    across = spanned(low[accepted], high[accepted], n)[common]
    weakest = common[across == across.min()]
    return np.flatnonzero(~growth.is_loop & ~growth.cut & np.isin(low, weakest))


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
