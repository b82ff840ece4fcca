# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Gaps and slips of the odometry: steps of which only the loops across can tell.

A gap is a slip whose place is known. Where both sides of a step are parts of their own, each right
in itself, the true loops across agree with each other (`pairwise_consistency`): parts are joined
where loops of two places or more do. A slip is suspected where the odds of one are not small
(`motion`), or where loops that are left out agree. Then slip and lies are compared: the step is
cut, the loops across are asked anew, and the rounds go on from there. To the odds comes half a
gate for each place that is won and that nothing else explains, less one for each that is lost. A
slip is believed if that makes it likelier than not. Loops do not make a robot jump: the slip
repaired, it has to move as at some other step, or rather so than as measured. What fits the loops
that came in without it did not slip: a lie had bent the map.
"""

from collections.abc import Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.odometry.motion import (
    Motion,
    log_odds_of_slips,
    steps_of,
    unwhitening,
    usual_motion,
)
from l1slam_ros.core.robust.odometry.noisier import with_runs
from l1slam_ros.core.robust.odometry.untold import LEAST, slips_told, untold_slip
from l1slam_ros.core.robust.pairwise_consistency import (
    Group,
    asked,
    by_pair_of_parts,
    gain_of,
    longest_run,
    spanned,
    strongest_across,
    strongest_group,
)
from l1slam_ros.core.robust.rounds.evidence import FEWEST_PLACES, TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth, gain_of_places

# So many steps are tried for each reason.
_TRIED = 2
# What is nearly sure: ln of the odds.
SURE = float(np.log(1 / DOUBT - 1))
# Of fewer steps there is no habit.
_FEWEST_STEPS = 20


def join(growth: Growth, by_runs: bool = False) -> bool:
    """
    Move parts to where loops across agree that they are; return whether any was.

    by_runs : where loops of two places do not, those of one that is long may
    """
    joined = False
    while (rows := growth.joining()).size:
        group = strongest_across(growth)
        if len(group.places) < TWO_PLACES and by_runs:
            group = max((longest_run(growth, some) for some in by_pair_of_parts(growth, rows)),
                        key=lambda group: len(group.rows))
        elif len(group.places) < TWO_PLACES:
            return joined
        if not len(group.rows):
            return joined
        _join_by(growth, group)
        joined = True
    return joined


def _join_by(growth: Growth, group: Group) -> None:
    """Move the later one of two parts to where the first loop of a group says, accept all."""
    given = growth.given
    manifold, loop = given.graph.manifold, group.rows[0]
    fixed, moving = given.low[loop], given.high[loop]
    Z = given.factors.measurement[loop, None]
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


def without_slip(growth: Growth, as_stated: Growth) -> Growth | None:
    """
    Return a state in which an odometry factor is cut that slipped; None: there is none.

    Or one that a lie does not bend any more, because an odometry factor was out for a while.

    as_stated : the state where all may be as noisy as they say; what that explains needs no slip
    """
    growth.slip_odds = {
        step: odds for step, odds in growth.slip_odds.items() if growth.cut[step]}
    if np.count_nonzero(~growth.given.is_loop & ~growth.cut) < _FEWEST_STEPS:
        return None
    motion = usual_motion(growth)
    found, most = None, 0.0
    for steps, odds, costs, state, usual in _tried(growth, as_stated, motion):
        back = _put_back(state, steps, motion) if state else None
        if back and costs:  # a loop that was chosen shows a slip, or nothing
            continue
        state, odds = back or (state, odds)
        gain = gain_of(growth, as_stated, state) if state and usual else 0.0
        if state and usual and not back and not (state.accepted & ~growth.accepted).any():
            # The noise was learnt of the slip, too, and explains it better than it is.
            odds = max(odds, float(log_odds_of_slips(state, motion)[steps].min()))
        # No slip has to be believed where only a lie had bent the map.
        evidence = gain if back else odds - costs + gain
        if len(steps) == 1:
            growth.slip_odds[steps[0]] = odds if back else evidence
        if state and evidence > most and (usual or (odds > 0 and len(steps) == 1)):
            found, most = state, evidence
            state.slip_odds.update(dict.fromkeys(steps, evidence))
    found = found or with_runs(growth)
    if not found:
        growth.slip_odds |= _odds_in_the_end(growth, as_stated, motion)
    return found


def _odds_in_the_end(growth: Growth, as_stated: Growth, motion: Motion) -> dict[int, float]:
    """Return ln of the odds to have slipped of steps that are cut, or of which no loop tells."""
    last = {step: odds for step, odds in untold_slip(as_stated, motion).items() if odds > LEAST}
    if growth.cut.any():
        # More is known than when it was cut.
        now = log_odds_of_slips(growth, motion)
        last |= {step: float(now[step]) for step in growth.slip_odds if growth.cut[step]}
    return {step: max(odds, growth.slip_odds.get(step, odds)) for step, odds in last.items()}


def _tried(growth: Growth, as_stated: Growth, motion: Motion, after: bool | None = None
           ) -> Iterator[tuple[list[int], float, float, Growth | None, bool]]:
    """
    Yield steps, their log odds to have slipped, costs, the state without, whether it is usual.

    costs : see `_without`. None: it falls apart. It is usual if the robot, repaired, moves as
    elsewhere at each of them. Where it is not, a second step bends what the loops across the first
    one say: the likeliest are tried, however unlikely each is by itself. Where it is, and the
    loops say too little, only one that would be suspected now.

    after : whether the first step that was cut is usual; None: this one is the first
    """
    odds, left_out = log_odds_of_slips(growth, motion), as_stated.undecided()
    # Where loops are left out, one more place may be won.
    most = max(SURE, growth.given.log_odds_of_place) if len(left_out) else SURE
    least = most if after is None else SURE if after else np.inf
    for step in _suspected(growth, odds, left_out[:0] if after else left_out, least):
        state, costs = _without(growth, step, motion)
        usual = False
        if state:
            state, step, usual = _cut_rather(state, step, motion)
        gain = gain_of_places(growth, as_stated, state) if state else 0.0
        if costs and after is None and gain <= costs:  # as if it had fallen apart
            yield [step], float(odds[step]), 0.0, None, False
        else:
            yield [step], float(odds[step]), costs, state, usual
        if state and after is None and (not usual or odds[step] + gain <= costs):
            for second, other, more, both, moves in _tried(state, state, motion, usual):
                one = step
                if both:
                    both, one, as_ever = _cut_rather(both, step, motion)
                    moves = moves and as_ever
                yield [one, *second], float(odds[one]) + other, costs + more, both, moves


def _suspected(growth: Growth, odds: Array, left_out: Indices, least: float) -> list[int]:
    """
    Return the odometry factors that may have slipped: two by their odds, two by groups.

    least : how large the odds are against those that are suspected for their own, at most
    """
    given = growth.given
    tell = growth.accepted & given.is_loop
    tell[left_out] = True
    across = spanned(given.low[tell], given.high[tell], given.graph.n_poses)
    # Where no loop can tell, an unusual motion is no more than that.
    told = np.where((across[given.low] > 0) & ~growth.cut, odds, -np.inf)
    order = np.argsort(-told, kind='stable')[:_TRIED]
    suspects: list[int] = order[told[order] > -least].tolist()
    for _ in range(_TRIED):
        group = strongest_group(growth, left_out)
        if len(group.places) < FEWEST_PLACES:
            break
        common = common_steps(growth, group.rows)
        common = common[~growth.cut[common]]
        if len(common):
            suspects.append(int(common[np.argmax(odds[common])]))
        left_out = np.setdiff1d(left_out, group.rows)
    return list(dict.fromkeys(suspects))


def common_steps(growth: Growth, rows: Indices) -> Indices:
    """Return the odometry that most of some loops span, (k,)."""
    given = growth.given
    across = spanned(given.low[rows], given.high[rows], given.graph.n_poses)
    common = np.flatnonzero(across == across.max())
    steps: Indices = np.flatnonzero(~given.is_loop & np.isin(given.low, common))
    return steps


def _without(growth: Growth, step: int, motion: Motion) -> tuple[Growth | None, float]:
    """
    Return the state after the rounds that follow if a step is cut, and what it costs, ln of odds.

    None: it falls apart. Where loops of two places or a long run do not join its sides, those do
    that came in before, else the one that shows a slip best: chosen, its place says nothing.
    """
    state, span = growth.copy(), growth.given.spanning(step)
    state.cut[step] = True
    state.drops[:] = 0
    kept = state.copy()
    costs = 0.0
    told = (state.accepted & span).any()
    if told:
        state.accepted[span] = state.given.trusted[span]
        state.solve()
    else:  # each side stays as it is
        state.label_parts()
    if not join(state, by_runs=True) or state.across()[step]:
        if told:
            kept.solve()
        if told and not kept.across()[step]:
            state = kept
        elif _join_as_usual(state, step, motion):
            costs = state.given.log_odds_of_place
        else:
            return None, 0.0
    state.accept_more()
    return state, costs


def _join_as_usual(state: Growth, step: int, motion: Motion) -> bool:
    """Join the sides of a step by the loop that shows a slip there rather than lies, or none."""
    given, part = state.given, state.part
    cut = np.array([step])
    rows = state.joining()
    rows = asked(state, rows[(part[given.low[rows]] == part[given.low[step]])
                             & (part[given.high[rows]] == part[given.high[step]])
                             & (given.factors.freedom[rows] == len(motion.mean))])
    told = slips_told(state, motion, cut, rows)[:, 0]
    if told.max(initial=-np.inf) < motion.log_density(steps_of(state, cut))[0]:
        return False
    best = rows[[np.argmax(told)]]
    _join_by(state, Group(best, given.place[best]))
    return not state.across()[step]


def _likeliest(state: Growth, cut: int, motion: Motion) -> int:
    """Return the step that slipped, by how the robot moves, of those that no loop tells apart."""
    given = state.given
    loops = given.is_loop & state.accepted
    ends = np.unique((given.low[loops], given.high[loops]))
    stretch = np.searchsorted(ends, given.low, side='right')
    odometry = ~given.is_loop & (~state.cut | (np.arange(len(state.cut)) == cut))
    steps = np.flatnonzero(odometry & (stretch == stretch[cut]))
    gain = motion.log_density(*_repaired(state, cut, steps)) - motion.log_density(
        steps_of(state, steps))
    return int(steps[np.argmax(gain)])


def _cut_rather(state: Growth, cut: int, motion: Motion) -> tuple[Growth, int, bool]:
    """
    Return the state cut at the likeliest step between the same loops; that; whether usual.

    That is, whether the robot, repaired, moves there as elsewhere.
    """
    step = _likeliest(state, cut, motion)
    if step != cut:
        state = _cut_at(state, cut, step)
    return state, step, _moves_as_usual(state, step, motion)


def _cut_at(state: Growth, cut: int, step: int) -> Growth:
    """Return the state that is cut at a step and not where it is."""
    state, given = state.copy(), state.given
    state.cut[[cut, step]] = False, True
    # What lies between goes over to the other side.
    side = given.low[cut] if given.low[step] > given.low[cut] else given.high[cut]
    between = np.arange(*np.sort(given.high[[cut, step]]))
    chain, manifold = given.chain, given.graph.manifold
    here, start = (np.tile(poses[side], (len(between), 1)) for poses in (state.poses, chain))
    state.poses = state.poses.copy()
    state.poses[between] = manifold.compose(here, manifold.between(start, chain[between]))
    state.solve()
    state.accept_more()
    return state


def _put_back(state: Growth, steps: list[int], motion: Motion) -> tuple[Growth, float] | None:
    """Return the state where steps say what they measured, and their odds, where that fits."""
    odds = float(log_odds_of_slips(state, motion)[steps].max())
    found = state.uncut().innovations(np.array(steps))
    if odds > 0 or (found.square > state.given.gate(found.freedom)).any():
        return None
    back = state.copy()
    back.cut[steps] = False
    back.solve()
    return back, odds


def _moves_as_usual(state: Growth, cut: int, motion: Motion) -> bool:
    """
    Return whether the robot, repaired, moves as elsewhere, or rather so than as measured.

    A slip is as rare as a mistake that many loops share. So the odds of the one against the other
    are those of the motion that each leaves.
    """
    row = np.array([cut])
    repaired, spread = _repaired(state, cut, row)
    gate = state.given.gate(np.array([len(motion.mean)]))[0]
    # All may be as noisy as they turn out, or as they say.
    said = state.noise.word[0] / state.noise.variance[0]
    density = max(motion.log_density(repaired, noise * spread)[0] for noise in (1.0, said))
    return bool(motion.distance(repaired[0], spread[0]).min() < gate
                or density > motion.log_density(steps_of(state, row))[0])


def _repaired(state: Growth, cut: int, steps: Indices) -> tuple[Array, Array]:
    """
    Return how the robot moved at some steps if one of these slipped rather than that which is cut.

    Tangents (m, k) and their covariances (m, k, k): all that follows is moved alike.
    """
    given = state.given
    manifold, chain = given.graph.manifold, given.chain
    measured = state.uncut()
    row = np.array([cut])
    count = len(steps)
    root, spread = unwhitening(measured, row), measured.innovations(row).spread
    low, high = given.low[row], given.high[row]
    moved = manifold.between(state.poses[low], state.poses[high])
    before = manifold.between(chain[given.low[steps]], np.repeat(chain[low], count, axis=0))
    after = manifold.between(np.repeat(chain[high], count, axis=0), chain[given.high[steps]])
    moved = manifold.compose(manifold.compose(before, np.repeat(moved, count, axis=0)), after)
    start = manifold.identity(count)
    carried = manifold.local_jacobian(start, moved) @ manifold.adjoint(
        manifold.inverse(after)) @ root
    return manifold.local(start, moved), carried @ spread @ carried.transpose(0, 2, 1)
