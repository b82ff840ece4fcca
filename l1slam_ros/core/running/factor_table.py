# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The state of the factors of a growing graph: a table with one row per factor.

In: the results of the front's gate for new factors and of the judge for all factors, and which
factors a map uses. Out: which factors are accepted, and whether the front or the judge decided it.

A person's decisions, `trusted` and `struck`, are columns of the factors themselves, and overrule
this table. Factors behind the last row were not examined yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from l1slam_ros.core.bordered.front import BELIEVE, GATE, SKIP, Look
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.robust.judgement import Judgement

# Who set a row last. Nobody: the factor was in a graph that was solved without a judgement.
NOBODY, FRONT, JUDGE, PERSON = range(4)

# accepted, suspect, sigmas, noise : see `Judgement`, noise is NaN until a judgement; said_by : one
# of the above; in_map : the published map uses it; proved : the map whose lower bound was proved
# uses it.
ROW = np.dtype([('accepted', bool), ('suspect', bool), ('in_map', bool), ('proved', bool),
                ('said_by', np.int32), ('sigmas', float), ('noise', float)])
# The same rows, each a whole: of `ROW` NumPy copies entry by entry, which takes 15 times as long.
_WHOLE = np.dtype((np.void, ROW.itemsize))

# Least number of rows for which room is made.
_ROOM = 64


@dataclass(frozen=True)
class FactorTable:
    """
    The table at one moment; later changes make new tables.

    rows : (m,) of `ROW`, in the order of the factors; looked : how many of the first rows the
    front or the judge has examined; is_map_of_accepted : whether the map uses the accepted ones of
    these, and no other
    """

    rows: Any
    looked: int
    is_map_of_accepted: bool
    _store: GrowingArray

    @staticmethod
    def of(rows: Any) -> 'FactorTable':
        """Return a table of these rows, with room for more; the caller gives up the array."""
        store = GrowingArray((), _WHOLE, len(rows) + len(rows) // 8 + _ROOM)
        store.extend(rows.view(_WHOLE))
        looked = rows['said_by'] != NOBODY
        same = not (looked & (rows['accepted'] != rows['in_map'])).any()
        return FactorTable(store.view().view(ROW), int(looked.sum()), same, store)

    @staticmethod
    def of_judgement(judgement: Judgement) -> 'FactorTable':
        """Return the table of a judgement whose map uses exactly the accepted factors."""
        return FactorTable.of(_rows(judgement, JUDGE))

    @property
    def accepted(self) -> Mask:
        """Which of the examined factors are accepted, (looked,) bool."""
        accepted: Mask = self.rows['accepted'][:self.looked]
        return accepted

    @property
    def is_proof_of_accepted(self) -> bool:
        """Whether all factors of which a bound was proved are accepted still."""
        return not (self.rows['proved'][:self.looked] & ~self.accepted).any()

    def continues(self, earlier: 'FactorTable') -> bool:
        """Tell whether the table only has rows more than an earlier one, in the same memory."""
        return self._store is earlier._store

    def judgement(self, of_all: Judgement) -> Judgement:
        """Return the rows as a judgement; of_all : the last one, for values that have no rows."""
        rows, judged = self.rows, ~np.isnan(self.rows['noise'])
        return replace(of_all, accepted=rows['accepted'][judged], suspect=rows['suspect'][judged],
                       sigmas=rows['sigmas'][judged], noise=rows['noise'][judged])

    def behind(self, judgement: Judgement) -> Judgement:
        """Return a judgement of the first factors, extended by the rows of the later ones."""
        rest = self.rows[len(judgement.accepted):self.looked]
        return replace(judgement, accepted=np.append(judgement.accepted, rest['accepted']),
                       suspect=np.append(judgement.suspect, rest['suspect']),
                       sigmas=np.append(judgement.sigmas, rest['sigmas']))

    def with_looks(self, looks: Sequence[Look]) -> 'FactorTable':
        """Return the table with rows for the next factors, which the front took."""
        if not looks:
            return self
        # Where another table has appended rows in the same memory by now, there is no room.
        store = self._store if len(self._store) == self.looked else FactorTable.of(
            self.rows[:self.looked])._store
        store.extend(_rows_of_looks(looks).view(_WHOLE))
        return FactorTable(
            store.view().view(ROW), len(store), self.is_map_of_accepted, store)

    def told(self, factors: BetweenFactors) -> 'FactorTable':
        """Return the table with a person's decisions applied; itself if nothing changes."""
        if not factors.has_marks or not (factors.trusted.any() or factors.struck.any()):
            return self
        before = self.accepted
        after = _by_person(before, factors)
        changed = np.flatnonzero(after != before)
        if not len(changed):
            return self
        rows = self.rows.copy()
        rows['accepted'][changed] = after[changed]
        rows['suspect'][changed] &= ~after[changed]
        rows['said_by'][changed] = PERSON
        return FactorTable.of(rows)

    def judged(self, judgement: Judgement, factors: BetweenFactors) -> 'FactorTable':
        """Return the table with the first factors as judged; a person's decisions stay."""
        rows = _rows(judgement, JUDGE)
        rows['accepted'] = _by_person(judgement.accepted, factors)
        rows['said_by'][rows['accepted'] != judgement.accepted] = PERSON
        rows['suspect'] &= ~rows['accepted']
        known = min(len(self.rows), len(rows))
        rows['in_map'][:known] = self.rows['in_map'][:known]
        rows['proved'][:known] = self.rows['proved'][:known]
        return FactorTable.of(_joined(rows, self.rows[len(rows):]))

    def adopted(self, made: Judgement, looks: Sequence[Look], end: int, again: bool,
                proved: bool) -> 'FactorTable':
        """
        Return the table after a map was published.

        Parameters
        ----------
        made : of the first factors, as the map was made of those that are accepted there
        looks, end : what the front of that map says of the last factors up to row `end`, which
            may be among the first ones; without a front that is the end of these
        again : the front has looked again at factors that were not accepted
        proved : a bound was proved of the map

        """
        size = len(made.accepted)
        begun = end - len(looks)
        said = _rows(made, FRONT)
        seen = _rows_of_looks(looks)
        said['noise'] = np.nan
        said['said_by'][end:] = NOBODY
        among = slice(begun, min(size, end))
        in_map = made.accepted.copy()
        in_map[among] |= seen['accepted'][:size - begun]
        # What the map is made of was not for its front to take.
        part = made.accepted[among]
        seen[:size - begun][part] = said[among][part]
        rows = _joined(said[:begun], seen, said[end:])
        rows = _joined(rows, self.rows[len(rows):self.looked])
        before = self.rows[:self.looked]
        stays = (before['said_by'] != FRONT) | before['accepted'] | (not again)
        stays[end:] = True
        rows.view(_WHOLE)[:self.looked][stays] = before.view(_WHOLE)[stays]
        rows['in_map'] = rows['accepted']
        rows['in_map'][:size] = in_map
        known = min(len(self.rows), len(rows))
        rows['proved'][:known] = self.rows['proved'][:known]
        if proved:
            rows['proved'] = False
            rows['proved'][:size] = made.accepted
        return FactorTable.of(rows)

    def for_front(self, factors: BetweenFactors, first: int, last: int,
                  robust: bool) -> Indices:
        """Return what a front does with the factors from `first` to `last`, see `Front.take`."""
        next_ones = slice(first, min(last, len(factors)))
        what = np.where(factors.trusted[next_ones] | (not robust), BELIEVE, GATE)
        if first < self.looked:
            known = self.accepted[next_ones]
            what[:len(known)] = np.where(known, BELIEVE, SKIP)
        return np.where(factors.struck[next_ones], SKIP, what)

    def for_new_front(self, factors: BetweenFactors, part: Mask, again: bool) -> Indices:
        """
        Return what a new front does with the factors, as far as anybody looked at them.

        part : (k,) bool, those of the first factors that its map is of; again : examine factors
        that were not accepted once more: others may fit the new map
        """
        known = self.accepted
        what = np.full(max(len(part), len(known)), GATE)
        what[:len(known)] = np.where(known, BELIEVE, GATE if again else SKIP)
        what[factors.struck[:len(what)]] = SKIP
        what[:len(part)][part] = SKIP
        return what


def _by_person(accepted: Mask, factors: BetweenFactors) -> Mask:
    """Return which of the first factors are accepted once a person has the last word."""
    size = len(accepted)
    return (accepted | factors.trusted[:size]) & ~factors.struck[:size]


def _joined(*parts: Any) -> Any:
    """Return rows one part after the other."""
    return np.concatenate([part.view(_WHOLE) for part in parts]).view(ROW)


def _rows(judgement: Judgement, said_by: int) -> Any:
    """Return rows of a map of what is accepted."""
    rows = np.zeros(len(judgement.accepted), ROW)
    rows['accepted'] = rows['in_map'] = judgement.accepted
    rows['suspect'], rows['sigmas'] = judgement.suspect, judgement.sigmas
    rows['noise'], rows['said_by'] = judgement.noise, said_by
    return rows


def _rows_of_looks(looks: Sequence[Look]) -> Any:
    """Return the rows of factors that a front took: its map is of what it accepted."""
    return np.array([(look.accepted, look.suspect, look.accepted, False, FRONT, look.sigmas,
                      np.nan) for look in looks], ROW)
