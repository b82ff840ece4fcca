# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Slips of the odometry: steps of which only the loops across can tell.

A slip is suspected where a loop that is left out shows one: if it is true and the step slipped,
the robot moved there as elsewhere (`untold`); all that are shown so are tried first, together. Or
where the odds of one are not small (`motion`). Then slip and lies are compared: the step is cut,
the loops across are asked anew (`cuts`), and the rounds go on from there. To the odds comes half a
gate for each place that is won and that nothing else explains, less one for each that is lost; of
the loop that alone shows a slip, what it shows. A slip is believed if that makes it likelier than
not. Loops do not make a robot jump: the slip repaired, it has to move as at some other step, or
rather so than as measured.
"""

from collections.abc import Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import component_labels
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.inspection import FEWEST
from l1slam_ros.core.robust.odometry.cuts import (
    as_shown,
    odds_as_shown,
    settled,
    unusual,
    without,
)
from l1slam_ros.core.robust.odometry.motion import (
    Motion,
    log_odds_of_slips,
    usual_motion,
)
from l1slam_ros.core.robust.odometry.noisier import with_runs
from l1slam_ros.core.robust.odometry.untold import (
    LEAST,
    Shown,
    prior_of_slip,
    shown_slips,
)
from l1slam_ros.core.robust.pairwise_consistency import gain_of, spanned
from l1slam_ros.core.robust.rounds.growth import Growth

# A step that may have slipped, the state without it and others, and what that costs, ln of odds.
Attempt = tuple[int, Growth | None, float]
# A step, the refused loop that shows that it slipped, and ln of the odds.
Told = tuple[int, int, float]
# So many steps are tried for each reason.
_TRIED = 2
# What is nearly sure: ln of the odds.
SURE = float(np.log(1 / DOUBT - 1))


def without_slip(growth: Growth, as_stated: Growth) -> Growth | None:
    """
    Return a state in which an odometry factor is cut that slipped; None: there is none.

    Or one that a lie does not bend any more, because an odometry factor was out for a while.

    as_stated : the state where all may be as noisy as they say; what that explains needs no slip
    """
    growth.slip_odds = {
        step: odds for step, odds in growth.slip_odds.items() if growth.cut[step]}
    if np.count_nonzero(~growth.given.is_loop & ~growth.cut) < FEWEST:
        return None
    motion = usual_motion(growth)
    odds = log_odds_of_slips(growth, motion)
    shown = shown_slips(as_stated, motion)
    told = _told(as_stated, shown)
    likely = [one for one in told if one[2] > -SURE]
    for attempts in (_as_shown(growth, motion, likely), _tried(growth, as_stated, motion),
                     *(_as_shown(growth, motion, [one])
                       for one in told[len(likely):len(likely) + _TRIED])):
        found, most = _best(growth, as_stated, motion, odds, attempts)
        if found:
            break
    runs, gain = with_runs(growth)
    if runs and gain > most:
        found = runs
    if not found and growth.cut.any():  # more is known than when these were cut
        now = log_odds_of_slips(growth, motion)
        growth.slip_odds |= {step: float(now[step]) for step in growth.slip_odds
                             if growth.cut[step]}
    return found


def _best(growth: Growth, as_stated: Growth, motion: Motion, odds: Array,
          attempts: Iterator[Attempt]) -> tuple[Growth | None, float]:
    """
    Return the state that is the likeliest of some and ln of its odds against the one before.

    None: that one is likelier, see `_tried`.
    """
    found, most = None, 0.0
    tried: dict[bytes, int] = {}
    for step, state, costs in attempts:
        steps = np.flatnonzero(state.cut & ~growth.cut) if state else np.array([step])
        if not state or (costs and not len(steps)):  # a loop that was chosen shows a slip, or none
            _suspect(growth, step, float(odds[step]))
            continue
        # By fewer loops the same cuts would be less unusual.
        cuts, accepted = state.cut.tobytes(), np.count_nonzero(state.accepted)
        if tried.get(cuts, -1) > accepted:
            continue
        tried[cuts] = int(accepted)
        usual = not np.isin(steps, unusual(state, motion)).any()
        evidence = _odds_of_cuts(growth, state, motion, odds, usual) - costs
        evidence += gain_of(growth, as_stated, state) if usual else 0.0
        shown = -np.inf
        if usual and len(steps) and not (growth.cut & ~state.cut).any():
            shown = _odds_as_shown(growth, as_stated, state, motion)
        evidence = max(evidence, shown)
        if not len(steps):
            _suspect(growth, step, float(log_odds_of_slips(state, motion)[step]))
        # What one loop shows is not bent by another slip: then it would show none.
        elif np.count_nonzero(state.cut != growth.cut) == 1 and not -np.inf < shown < LEAST:
            _suspect(growth, int(steps[0]), evidence)
        if evidence > most and (usual or (odds[steps] > 0).all()):
            found, most = state, evidence
            state.slip_odds.update(dict.fromkeys(steps.tolist(), evidence))
    return found, most


def _told(growth: Growth, shown: Shown) -> list[Told]:
    """Return the steps that refused loops show to have slipped, the likeliest first."""
    given = growth.given
    rows, steps, odds = shown
    told: list[Told] = []
    if not len(odds):
        return told
    best, most = np.argmax(odds, axis=0), odds.max(axis=0)
    for k in np.argsort(-most, kind='stable').tolist():
        step, loop = int(steps[k]), int(rows[best[k]])
        if most[k] < -given.log_odds_of_place:
            break
        # What a loop says of a step holds if no other one that it spans slipped.
        if not any(given.spanning(step)[other] or given.spanning(one)[loop]
                   for one, other, _ in told):
            told.append((step, loop, float(most[k])))
    return told


def _as_shown(growth: Growth, motion: Motion, told: list[Told]) -> Iterator[Attempt]:
    """Yield states without steps that loops show to have slipped, all of them and each."""
    tries = [told, *([one] for one in told)] if len(told) > 1 else [told] * len(told)
    for some in tries:
        state = as_shown(growth, [step for step, *_ in some], [loop for _, loop, _ in some])
        if state:
            # One loop that is hardly likely says nothing but what slipped.
            costs = growth.given.log_odds_of_place if some[0][2] <= -SURE else 0.0
            yield some[0][0], settled(state, motion), costs


def _odds_as_shown(growth: Growth, as_stated: Growth, state: Growth, motion: Motion) -> float:
    """
    Return ln of the odds of the cuts of a state, where only loops that came in say what slipped.

    Of each step one of these is worth what it shows, be its place known or not; what else is won
    counts. -inf: loops that were there before say it.
    """
    given, steps = growth.given, np.flatnonzero(state.cut & ~growth.cut)
    before = (growth.accepted | as_stated.accepted) & state.accepted & ~state.cut
    part = component_labels(given.graph.subset(before))
    if not (part[given.low[steps]] != part[given.high[steps]]).any():
        return -np.inf
    gain = gain_of(growth, as_stated, state)
    shown = odds_as_shown(state, steps, motion) + len(steps) * prior_of_slip(as_stated)
    lost = len(np.unique(given.place[growth.accepted & ~state.accepted]))
    place = given.log_odds_of_place
    return shown + max(gain - len(steps) * place, -lost * place)


def _suspect(growth: Growth, step: int, odds: float) -> None:
    """Note the odds of a step to have slipped, ln, if no other attempt showed larger ones."""
    growth.slip_odds[step] = max(odds, growth.slip_odds.get(step, odds))


def _odds_of_cuts(growth: Growth, state: Growth, motion: Motion, odds: Array, usual: bool
                  ) -> float:
    """Return ln of the odds of the cuts of a state against those before; odds : (m,), of these."""
    new, gone = state.cut & ~growth.cut, growth.cut & ~state.cut
    own = float(odds[new].sum())
    if gone.any():  # it was moved, which loops have to say
        return min(own - float(log_odds_of_slips(state, motion)[gone].sum()), 0.0)
    if new.any() and usual and not (state.accepted & ~growth.accepted).any():
        # The noise was learnt of the slip, too, and explains it better than it is.
        return max(own, float(log_odds_of_slips(state, motion)[new].min()))
    return own


def _tried(growth: Growth, as_stated: Growth, motion: Motion) -> Iterator[Attempt]:
    """Yield steps that are cut, and the state without them; None: it falls apart."""
    odds, left_out = log_odds_of_slips(growth, motion), as_stated.undecided()
    # Where loops are left out, one more place may be won.
    least = max(SURE, growth.given.log_odds_of_place) if len(left_out) else SURE
    for step in _suspected(growth, odds, left_out, least):
        state = without(growth, step)
        yield step, state and settled(state, motion), 0.0


def _suspected(growth: Growth, odds: Array, left_out: Indices, least: float) -> list[int]:
    """
    Return the odometry factors that may have slipped by their odds, two at most.

    least : how large the odds are against them, at most
    """
    given = growth.given
    tell = growth.accepted & given.is_loop
    tell[left_out] = True
    across = spanned(given.low[tell], given.high[tell], given.graph.n_poses)
    # Where no loop can tell, an unusual motion is no more than that.
    told = np.where((across[given.low] > 0) & ~growth.cut, odds, -np.inf)
    order = np.argsort(-told, kind='stable')[:_TRIED]
    suspects: list[int] = order[told[order] > -least].tolist()
    return suspects


def common_steps(growth: Growth, rows: Indices) -> Indices:
    """Return the odometry that most of some loops span, (k,)."""
    given = growth.given
    across = spanned(given.low[rows], given.high[rows], given.graph.n_poses)
    common = np.flatnonzero(across == across.max())
    steps: Indices = np.flatnonzero(~given.is_loop & np.isin(given.low, common))
    return steps
