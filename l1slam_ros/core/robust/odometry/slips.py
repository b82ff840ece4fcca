# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Slips of the odometry: hypotheses that some of its factors are outliers.

In: a robust state that accepts no more loops. Out: states in which odometry factors are cut, the
loops across them judged again (`cuts`), with ln of their odds. Candidates are

1. the steps that a rejected loop points at: were it true and the step z slipped, the robot moved
   by y there. Where few loops span it, this is all the evidence:

       p(y as motion) p_slip(z | y) V true / (n p(z as motion) rejected)

   with V the volume of an outlier's claims, true the number of accepted places, rejected that of
   the rejected loops, n that of the steps. A slip has a uniform rotation and a Cauchy translation,
   as wide as steps are long and as y is unsure;
2. the steps whose own odds to have slipped, by all accepted loops, are the largest (`motion`).

The odds of a state are those of its cuts, and half a gate for each place that is won, less half a
gate for each that is lost. A slip, repaired, leaves the robot a usual motion, or a likelier one
than was measured: other cuts are taken by their own odds alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import component_labels
from l1slam_ros.core.robust.confidence import CONFIDENT
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import claimed_volume
from l1slam_ros.core.robust.inspection import FEWEST
from l1slam_ros.core.robust.odometry.cuts import (
    cut_and_joined,
    cut_at_loops,
    motion_repaired,
    moved_to_likeliest,
    unusual,
)
from l1slam_ros.core.robust.odometry.hypotheses import Hypothesis, best
from l1slam_ros.core.robust.odometry.motion import (
    log_odds_of_slips,
    log_slip,
    steps_of,
    unwhitening,
    usual_motion,
)
from l1slam_ros.core.robust.pairwise_consistency import asked, gain_of, spanned
from l1slam_ros.core.robust.rounds.evidence import FEWEST_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth

# Steps that are tried by their own odds, and by loops that hardly point at them, at most.
_TRIED = 2
# ln of the odds of near certainty, and of a slip that makes a map doubtful.
_SURE = float(np.log(1 / DOUBT - 1))
_DOUBTFUL = float(np.log(1 / CONFIDENT - 1))
# Pairs of a loop and a step that are worked out together, to bound the memory.
_PAIRS = 20_000


@dataclass(frozen=True)
class _Candidate:
    """A step to cut, the state without it and others (None: it falls apart), ln of the price."""

    step: int
    state: Growth | None
    costs: float = 0.0


@dataclass(frozen=True)
class _Pointer:
    """A rejected loop, the step that slipped if it is true, and ln of the odds of that."""

    loop: int
    step: int
    log_odds: float


def slips(growth: Growth, as_stated: Growth) -> list[Hypothesis]:
    """
    Return the hypotheses that odometry factors slipped, of the first stage in which one wins.

    Notes in `growth.slip_odds` the odds of each step that was tried, taken or not.

    growth : the state with the estimated noise; as_stated : that with the larger of the stated and
    the estimated noise, which may explain loops without a slip
    """
    growth.slip_odds = {
        step: odds for step, odds in growth.slip_odds.items() if growth.cut[step]}
    if np.count_nonzero(~growth.given.is_loop & ~growth.cut) < FEWEST:
        return []
    search = _Search(growth, as_stated)
    for candidates in search.stages():
        found = search.compared(candidates)
        if best(found):
            return found
    return []


class _Search:
    """
    The search for slips in a state; see `slips`.

    motion : how the robot moves; odds : (m,) ln of those of each factor to have slipped; prior :
    ln of those that a rejected loop is true and a step slipped.
    """

    def __init__(self, growth: Growth, as_stated: Growth):
        self.growth, self.as_stated, self.given = growth, as_stated, growth.given
        self.motion = usual_motion(growth)
        self.odds = log_odds_of_slips(growth, self.motion)
        true = self.given.count_places(as_stated.loops) + 1
        steps = np.count_nonzero(~self.given.is_loop & ~as_stated.cut)
        self.prior = float(np.log(true / (len(as_stated.undecided()) + 1) / steps))

    def stages(self) -> Iterator[Iterator[_Candidate]]:
        """Yield candidates: where loops point clearly, by own odds, where loops point hardly."""
        pointers = self.pointers()
        likely = [one for one in pointers if one.log_odds > -_SURE]
        yield self.pointed_at(likely)
        yield self.by_own_odds()
        for one in pointers[len(likely):len(likely) + _TRIED]:
            yield self.pointed_at([one])

    def compared(self, candidates: Iterator[_Candidate]) -> list[Hypothesis]:
        """Return the hypotheses that candidates are, each with the odds of its state."""
        found, tried = [], dict[bytes, int]()
        for one in candidates:
            state, steps = one.state, np.array([one.step])
            if state:
                steps = np.flatnonzero(state.cut & ~self.growth.cut)
            if not state or (one.costs and not len(steps)):
                self.suspect(one.step, float(self.odds[one.step]))
                continue
            # With fewer loops the same cuts would be less unusual.
            accepted = int(np.count_nonzero(state.accepted))
            if tried.get(state.cut.tobytes(), -1) > accepted:
                continue
            tried[state.cut.tobytes()] = accepted
            is_usual = not np.isin(steps, unusual(state, self.motion)).any()
            odds = self.log_odds_of_cuts(state, is_usual) - one.costs
            pointed = -np.inf
            if is_usual:
                odds += gain_of(self.growth, self.as_stated, state)
                pointed = self.log_odds_of_pointed(state, steps)
            odds = max(odds, pointed)
            if not len(steps):
                self.suspect(one.step, float(log_odds_of_slips(state, self.motion)[one.step]))
            # One loop points at a step only if no other slip bends what it measures.
            elif (np.count_nonzero(state.cut != self.growth.cut) == 1
                  and not -np.inf < pointed < _DOUBTFUL):
                self.suspect(int(steps[0]), odds)
            if is_usual or (self.odds[steps] > 0).all():
                state.slip_odds.update(dict.fromkeys(steps.tolist(), odds))
                found.append(Hypothesis(state, odds))
        return found

    def suspect(self, step: int, odds: float) -> None:
        """Note ln of the odds of a step to have slipped, the largest of all attempts."""
        noted = self.growth.slip_odds
        noted[step] = max(odds, noted.get(step, odds))

    def log_odds_of_cuts(self, state: Growth, is_usual: bool) -> float:
        """Return ln of the odds of the cuts of a state against those before."""
        new, gone = state.cut & ~self.growth.cut, self.growth.cut & ~state.cut
        own = float(self.odds[new].sum())
        if gone.any():  # another step in place of one before: loops have to decide
            before = float(log_odds_of_slips(state, self.motion)[gone].sum())
            return min(own - before, 0.0)
        if new.any() and is_usual and not (state.accepted & ~self.growth.accepted).any():
            # The noise was estimated with the slip, which it explains too well.
            return max(own, float(log_odds_of_slips(state, self.motion)[new].min()))
        return own

    def by_own_odds(self) -> Iterator[_Candidate]:
        """Yield states without each of the steps whose own odds are largest, if not small."""
        given, growth = self.given, self.growth
        left_out = self.as_stated.undecided()
        # Where loops are rejected, one more place may be won.
        least = max(_SURE, given.log_odds_of_place) if len(left_out) else _SURE
        tell = growth.loops
        tell[left_out] = True
        across = spanned(given.low[tell], given.high[tell], given.graph.n_poses)
        odds = np.where((across[given.low] > 0) & ~growth.cut, self.odds, -np.inf)
        order = np.argsort(-odds, kind='stable')[:_TRIED]
        for step in order[odds[order] > -least].tolist():
            state = cut_and_joined(growth, step)
            yield _Candidate(step, state and moved_to_likeliest(state, self.motion))

    def pointed_at(self, pointers: list[_Pointer]) -> Iterator[_Candidate]:
        """Yield states without steps that loops point at: all of these together, then each."""
        tries = [pointers] if pointers else []
        if len(pointers) > 1:
            tries += [[one] for one in pointers]
        for some in tries:
            state = cut_at_loops(self.growth, [one.step for one in some],
                                 [one.loop for one in some])
            if state:
                # One loop that is hardly likely shows nothing but which step slipped.
                costs = self.given.log_odds_of_place if some[0].log_odds <= -_SURE else 0.0
                yield _Candidate(some[0].step, moved_to_likeliest(state, self.motion), costs)

    def log_odds_of_pointed(self, state: Growth, steps: Indices) -> float:
        """
        Return ln of the odds of the cuts of a state by one new loop for each step.

        That loop counts by the motion that it implies, be its place known or not; other places
        that are won count as always. -inf where loops accepted before imply the same, and where
        the cuts before are not among these.
        """
        given, growth = self.given, self.growth
        if not len(steps) or (growth.cut & ~state.cut).any():
            return -np.inf
        before = (growth.accepted | self.as_stated.accepted) & state.accepted & ~state.cut
        part = component_labels(given.graph.subset(before))
        if not (part[given.low[steps]] != part[given.high[steps]]).any():
            return -np.inf
        manifold, start = given.graph.manifold, given.graph.manifold.identity(1)
        shown = len(steps) * (self.prior + self._log_volume(state))
        for row in steps[:, None]:
            moved, spread = motion_repaired(state, int(row[0]), row, np.zeros(1, np.int64))
            slip = manifold.local(manifold.retract(start, moved), given.factors.measurement[row])
            shown += float((self.motion.log_density(moved, spread)
                            + log_slip(manifold, slip, spread, self.motion)
                            - self.motion.log_density(steps_of(state, row)))[0])
        place, gain = given.log_odds_of_place, gain_of(growth, self.as_stated, state)
        lost = given.count_places(growth.accepted & ~state.accepted)
        return shown + max(gain - len(steps) * place, -lost * place)

    def pointers(self) -> list[_Pointer]:
        """Return the rejected loops that point at a slip each, the likeliest first."""
        given = self.given
        rows, steps = self._rejected(), self._hardly_known_steps()
        if not len(rows) or not len(steps):
            return []
        odds = self.prior + self._log_pointing(rows, steps) - self.motion.log_density(
            steps_of(self.as_stated, steps))
        first, most = np.argmax(odds, axis=0), odds.max(axis=0)
        found: list[_Pointer] = []
        for k in np.argsort(-most, kind='stable').tolist():
            if most[k] < -given.log_odds_of_place:
                break
            step, loop = int(steps[k]), int(rows[first[k]])
            # A loop points at a step if no other one that it spans slipped.
            if not any(given.spanning(step)[one.loop] or given.spanning(one.step)[loop]
                       for one in found):
                found.append(_Pointer(loop, step, float(most[k])))
        return found

    def _rejected(self) -> Indices:
        rows = self.as_stated.undecided()
        whole = self.given.factors.freedom[rows] == len(self.motion.mean)
        return asked(self.as_stated, rows[whole])

    def _hardly_known_steps(self) -> Indices:
        """Return the steps that loops of few places span, but for those across another cut."""
        given, n = self.given, self.given.graph.n_poses
        state = self.as_stated
        loops = np.flatnonzero(state.loops)
        loops = loops[np.unique(given.place[loops], return_index=True)[1]]
        cuts = np.append(0, np.cumsum(spanned(given.low[state.cut], given.high[state.cut], n)))
        tell = loops[cuts[given.low[loops]] == cuts[given.high[loops]]]
        across = spanned(given.low[tell], given.high[tell], n)
        steps = np.flatnonzero(given.is_step & ~state.cut)
        return np.asarray(steps[across[given.low[steps]] < FEWEST_PLACES])

    def _log_volume(self, state: Growth) -> float:
        """Return ln of the volume of an outlier's translations."""
        manifold = self.given.graph.manifold
        return float(claimed_volume(manifold, state.poses)[manifold.TRANSLATION].sum())

    def _log_pointing(self, rows: Indices, steps: Indices) -> Array:
        """Return ln p(y as motion) p_slip(z | y) V, (loops, steps); -inf: not spanned."""
        given, state = self.given, self.as_stated
        values = np.full((len(rows), len(steps)), -np.inf)
        root, spread = unwhitening(state, rows), state.innovations(rows).spread
        covariance = root @ (spread + np.eye(len(self.motion.mean))) @ root.transpose(0, 2, 1)
        size = max(1, _PAIRS // len(steps))
        for first in range(0, len(rows), size):
            some = rows[first:first + size]
            row, step = np.nonzero((given.low[some, None] <= given.low[steps])
                                   & (given.high[some, None] >= given.high[steps]))
            values[first + row, step] = self._log_pointing_of(
                steps[step], some[row], covariance[first + row])
        return values + self._log_volume(state)

    def _log_pointing_of(self, steps: Indices, rows: Indices, known: Array) -> Array:
        """
        Return ln p(y as motion) p_slip(z | y), (k,), of steps z and loops that span them.

        known : (k, d, d) the covariance of each loop's innovation, unwhitened
        """
        given, poses = self.given, self.as_stated.poses
        manifold = given.graph.manifold
        after = manifold.between(poses[given.high[steps]], poses[given.high[rows]])
        before = manifold.between(poses[given.low[steps]], poses[given.low[rows]])
        y = manifold.compose(before, manifold.compose(given.factors.measurement[rows],
                                                      manifold.inverse(after)))
        carried = manifold.adjoint(after)
        spread = carried @ known @ carried.transpose(0, 2, 1)
        start = manifold.identity(len(rows))
        J = manifold.local_jacobian(start, y)
        moved = self.motion.log_density(
            manifold.local(start, y), J @ spread @ J.transpose(0, 2, 1))
        slip = manifold.local(y, given.factors.measurement[steps])
        return moved + log_slip(manifold, slip, spread, self.motion)


def common_steps(growth: Growth, rows: Indices) -> Indices:
    """Return the odometry factors that most of some loops span, (k,)."""
    given = growth.given
    across = spanned(given.low[rows], given.high[rows], given.graph.n_poses)
    common = np.flatnonzero(across == across.max())
    steps: Indices = np.flatnonzero(~given.is_loop & np.isin(given.low, common))
    return steps
