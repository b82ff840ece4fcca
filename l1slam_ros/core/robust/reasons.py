# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Why a map is not to be relied on: what its judgement could not settle.

In: the end of a robust solve. Out: the reasons, each with the keyframes where a person may look.
A reason counts where maps were wrong for it: see `forecast`.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.graph.factor_graph import component_labels, lowest_of_components
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.forecast import drift_taken_for_noise
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.judgement import (
    DRIFTS,
    ONE_JOINS,
    OTHER_MAP,
    SLIP,
    UNCONFIRMED,
    UNFINISHED,
    Doubt,
    doubt_of,
)
from l1slam_ros.core.robust.odometry.slips import SURE, common_steps
from l1slam_ros.core.robust.odometry.untold import LEAST
from l1slam_ros.core.robust.pairwise_consistency import (
    NONE,
    RUN,
    agree_at_a_place,
    longest_run,
    runs,
    spanned,
    strongest_group,
)
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth


def doubts(growth: Growth, ended: bool = True, rival: float = 0.0,
           uncontested: Indices = NONE) -> tuple[Doubt, ...]:
    """
    Return the reasons to doubt a map; none: ().

    ended : nothing more can be accepted; rival : by how much more the odometry may drift [rad/m];
    uncontested : (k,) see `batch.with_uncontested`
    """
    graph, size = growth.given.graph, growth.given.size
    loops = growth.given.is_loop[:size]
    left_out = np.flatnonzero(loops & ~growth.accepted[:size])
    accepted = np.flatnonzero(loops & growth.accepted[:size])
    reasons = []
    if not ended and len(left_out):
        reasons.append(doubt_of(graph, left_out, UNFINISHED))
    if not len(uncontested) and _decides_alone(growth, accepted):
        uncontested = accepted
    if len(uncontested):
        reasons.append(doubt_of(graph, uncontested, UNCONFIRMED))
    if growth.given.gap.any():
        reasons += [doubt_of(graph, rows, ONE_JOINS) for rows in _joining_alone(growth)]
    agree = _agree(growth)
    reasons += _other_map(growth, agree)
    reasons += [doubt_of(graph, rows, OTHER_MAP) for rows in _joining_otherwise(growth)]
    reasons += [_slip_doubt(growth, step) for step in _may_have_slipped(growth, agree)]
    drift = rival or drift_taken_for_noise(growth)
    if drift:
        reasons.append(doubt_of(graph, accepted, DRIFTS, f'{-drift:+.2g}'))
    return tuple(dict.fromkeys(reasons))


def _decides_alone(growth: Growth, accepted: Indices) -> bool:
    """
    Return whether all accepted loops are of one place, and may be one mistake.

    As one loop, by the median of what they say, it would not be believed by odometry alone. A run
    hardly is a mistake: it only has to be likelier true than false.
    """
    given = growth.given
    if (len(accepted) < RUN or not given.may_err_as_one(accepted, TWO_PLACES)
            or (given.trusted | given.factors.is_absolute)[accepted].any()):
        return False
    odometry = growth.copy()
    odometry.accepted = ~given.is_loop
    odometry.solve()
    within = accepted[~odometry.across()[accepted]]
    if not len(within):
        return False
    least = 0.0 if runs(growth, within) else SURE
    return bool(np.median(odometry.innovations(within).log_ratio()) < least)


def _joining_alone(growth: Growth) -> Iterator[Indices]:
    """
    Yield the loops of one place, accepted or not, that alone say how two parts lie to each other.

    Parts are what is between two gaps, or beside these slips that were cut.
    """
    given = growth.given
    sure = ~given.is_loop | given.trusted | given.factors.is_absolute
    part = component_labels(given.graph.subset(growth.accepted & ~growth.cut & sure))
    rows = np.flatnonzero(growth.accepted & ~sure & (part[given.low] != part[given.high]))
    rows = np.concatenate((rows, agree_at_a_place(growth, growth.joining())))
    i, j = part[given.low[rows]], part[given.high[rows]]
    _, place, count = np.unique(given.place[rows], return_inverse=True, return_counts=True)
    joins = growth.accepted[rows]
    n = int(part.max()) + 1
    _, pair = np.unique(pair_key(i, j, n), return_inverse=True)
    for number in np.argsort(-count, kind='stable'):
        own = place == number
        if np.bincount(pair[joins & ~own], minlength=len(pair))[pair[own]].all():
            continue  # others join the same parts
        without, joined = (len(np.unique(lowest_of_components(i[some], j[some], n)))
                           for some in (joins & ~own, joins | own))
        if joined < without:
            # Rivals that say it otherwise are of the same doubt.
            joins |= own
            yield rows[own]


def _joining_otherwise(growth: Growth) -> Iterator[Indices]:
    """
    Yield refused loops that agree how two parts lie to each other, otherwise than accepted ones.

    Parts are what no odometry joins, so that loops alone speak for either. What is refused counts
    where it is of half as many places as what is accepted, or more, or a long run.
    """
    given = growth.given
    part = component_labels(given.graph.subset(~given.is_loop & ~growth.cut))
    if not part.max(initial=0):
        return
    ends = np.sort((part[given.low], part[given.high]), axis=0)
    rows = np.flatnonzero((ends[0] != ends[1]) & ~given.factors.is_absolute)
    _, pair = np.unique(
        pair_key(ends[0, rows], ends[1, rows], part.max() + 1), return_inverse=True)
    refused = np.isin(rows, growth.undecided())
    for number in np.unique(pair[refused]):
        own = pair == number
        known = given.count_places(rows[own & growth.accepted[rows]])
        if not known:
            continue
        group = strongest_group(growth, rows[own & refused])
        if 2 * given.count_places(group) < known:
            group = longest_run(growth, rows[own & refused])
        if len(group):
            yield group


def _agree(growth: Growth) -> list[Indices]:
    """Return groups of refused loops that agree: of several places, and of one each."""
    rows = growth.undecided()
    place = growth.given.place
    agree = agree_at_a_place(growth, rows)
    groups = [strongest_group(growth, rows), *(
        agree[place[agree] == one] for one in np.unique(place[agree]))]
    return [group for group in groups if len(group)]


def _other_map(growth: Growth, groups: list[Indices]) -> list[Doubt]:
    """
    Return a doubt where refused loops agree, and no accepted one speaks against them.

    They may be right then: the odometry slipped, and nothing else knows of it. A place against
    the odometry alone is one word against another.
    """
    alone = [group for group in groups if _may_be_right(growth, group)]
    return [doubt_of(growth.given.graph, max(alone, key=len), OTHER_MAP)] if alone else []


def _may_have_slipped(growth: Growth, groups: list[Indices]) -> list[int]:
    """
    Return the odometry factors that slipped, or not, neither of which is nearly sure.

    Of two slips each is unlikely by itself, since the other one bends what the loops across it
    say: so where one is cut, another one has to be nearly ruled out, and less so where none is.
    Refused loops that span a step and agree do so by chance as rarely as what is nearly sure.
    """
    told = [step for group in groups for step in common_steps(growth, group)]
    alone = -SURE if (growth.cut & ~growth.given.gap).any() else LEAST
    return [step for step, odds in growth.slip_odds.items()
            if (odds < SURE if growth.cut[step] else odds > alone - SURE * (step in told))
            and not _is_vouched(growth, step)]


def _is_vouched(growth: Growth, step: int) -> bool:
    """Return whether all loops across a step are vouched for: they say where the robot went."""
    across = growth.accepted & growth.given.spanning(step)
    return bool(across.any() and growth.given.trusted[across].all())


def _may_be_right(growth: Growth, group: Indices) -> bool:
    """
    Return whether a group of loops, (k,), may be right, and no accepted one false.

    Then the odometry slipped at a step that the group spans and no accepted loop does. Of all
    steps one is expected to have slipped: if these are less than a hundredth of them, a place is
    rather one mistake. Or the group is of several places, all seen from one keyframe that is out
    of line: the odometry slipped to it, and back.
    """
    given = growth.given
    low, high, accepted = given.low, given.high, growth.loops
    across = spanned(low[accepted], high[accepted], given.graph.n_poses)
    untold = np.count_nonzero(across[low[common_steps(growth, group)]] == 0)
    if given.may_err_as_one(group, TWO_PLACES):
        return bool(untold >= DOUBT * np.count_nonzero(~given.is_loop))
    told = np.concatenate((low[accepted], high[accepted]))
    return bool(untold) or any(not np.ptp(ends) and ends[0] not in told
                               for ends in (low[group], high[group]))


def _slip_doubt(growth: Growth, step: int) -> Doubt:
    given = growth.given
    span = given.spanning(step)
    used = growth.accepted & span
    doubt = doubt_of(given.graph, used if used.any() else span, SLIP)
    return replace(doubt, first=int(given.low[step]), last=int(given.high[step]))
