# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a robust solve refused, and what it found of the noise, in sentences for people."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.robust.judgement import (
    DRIFTS,
    FAILED,
    MOSTLY_REFUSED,
    NORM,
    ONE_JOINS,
    ONE_PLACE,
    OTHER_MAP,
    PARTS,
    SLIP,
    UNFINISHED,
    UNSOLVED,
    Doubt,
    Judgement,
)
from l1slam_ros.io.files import counted, stamp_text
from l1slam_ros.io.graphs.graph_file import GraphRecord

# The status of a map that is not to be relied on.
DOUBTFUL = 'doubtful'

# So many edges are named one by one; `--json` lists all.
_NAMED = 20
# A gross slip of the odometry: said apart, because nothing that was driven after it can be trusted
# without the loops across it.
_SLIP = 'odometry {pair} lies: {sigmas:.1f} sigmas off what the loops say; left out'
# The odometry of the map is not that which was measured: who takes the file of it has to know.
_DRIFT = ('the odometry drifts by {drift:+.3g} rad on each metre, as the loops agree: the map is '
          'made of odometry that is corrected by that')
# Sigmas so many times the stated ones are worth a word; less is what people are wrong by.
_NOISY = 2.0
# Of odometry and of loops, as `Judgement.variance` has them.
_NOISE = (
    'the odometry is about {times:.1f} times as noisy as it says: loops far apart in time are '
    'judged by little',
    'the loops are about {times:.1f} times as noisy as they say: a false one that is little off '
    'passes for noise')
_TOGETHER = ('the loops of a place err together: in the map each place counts as one loop, and '
             'all are as noisy as was found')

# By the kind of a doubt.
_REASONS = {
    MOSTLY_REFUSED: '{loops} loops, most of all, are refused or suspect, {where}: either they are '
                    'false, or the odometry is worse than it says',
    ONE_PLACE: 'all {loops} loops that are used are of one place, {where}, which the odometry '
               'alone hardly bears out, so they may be one mistake',
    ONE_JOINS: 'of how two parts lie to each other only loops of one place agree ({loops}, '
               '{where}), and they may be one mistake',
    OTHER_MAP: '{loops} refused loops agree with each other on another map, {where}',
    SLIP: 'whether the odometry slipped or not {where}, the {loops} loops across that are used '
          'do not say for sure',
    DRIFTS: 'the odometry turns by about {detail} rad too much on each metre, {where}, which the '
            '{loops} loops that are used were too few to correct: it was taken for noise',
    UNFINISHED: 'the judgement did not come to an end: the {loops} loops that are left out, '
                '{where}, were still coming in a few at a time',
    NORM: 'the map is further from the least squares map of the same {loops} loops than noise '
          'explains, so factors err together or are not what they say; `--norm l2` and `huber` '
          'make other maps',
    FAILED: 'judging the loops failed ({detail}): the map is of what was believed until then, and '
            '{loops} loops {where} are left out',
    UNSOLVED: 'solving for the {loops} loops that are believed failed ({detail}): this is the map '
              'by which they were judged',
    PARTS: '{detail} parts that nothing accepted joins, {where}, so where one lies from another '
           'is a guess; {loops} loops between them are left out',
}
_REMEDY = 'Vouch for a loop that is right, strike out one that is false, or state the noise'


def judgement_sentences(record: GraphRecord, judgement: Judgement) -> Iterator[str]:
    """Yield what was refused and why, the worst first; then what is noisier than it says."""
    factors = record.graph.between
    accepted = judgement.accepted
    is_loop = ~factors.is_odometry
    pairs = record.ids[factors.pairs]
    if judgement.drift:
        yield _DRIFT.format(drift=judgement.drift)
    for row in judgement.slips.tolist():
        yield _SLIP.format(pair=_named(pairs[row]), sigmas=judgement.sigmas[row])
    refused = np.flatnonzero(is_loop & ~accepted & ~judgement.suspect & ~factors.struck)
    suspect = np.flatnonzero(is_loop & judgement.suspect)
    if is_loop.any():
        yield f'{len(refused):,} of {doubted(factors)} refused'
    worst = refused[np.argsort(-judgement.sigmas[refused], kind='stable')]
    for row in worst[:_NAMED].tolist():
        yield f'  {_named(pairs[row])}: {judgement.sigmas[row]:.1f} sigmas off the accepted ones'
    if len(refused) > _NAMED:
        yield f'  and {len(refused) - _NAMED:,} more; `--json` lists all'
    if len(suspect):
        them, they = ('it', 'it') if len(suspect) == 1 else ('them', 'they')
        yield (f'{counted(len(suspect), "loop")} suspect and left out: nothing vouches for '
               f'{them}, and {they} could as well fit by chance')
    for sentence, times in zip(_NOISE, np.sqrt(judgement.variance).tolist(), strict=True):
        if times >= _NOISY:
            yield sentence.format(times=times)
    if not judgement.is_noise_stated:
        yield _TOGETHER


def known_false_sentence(record: GraphRecord, judgement: Judgement | None) -> Iterator[str]:
    """Yield how what is left out agrees with what the file says is false, where it says so."""
    if judgement is None or record.log is None or record.log.false is None:
        return
    factors, false = record.graph.between, record.log.false
    is_loop = ~factors.is_odometry & ~factors.is_absolute
    left_out = ~judgement.accepted | judgement.suspect
    false, true = false & is_loop, ~false & is_loop
    yield (f'of {counted(int(false.sum()), "loop")} that the file says are false '
           f'{int((false & ~left_out).sum()):,} are kept, of the {int(true.sum()):,} others '
           f'{int((true & left_out).sum()):,} are left out')


def offset_sentence(manifold: Manifold, offset: Array | None) -> Iterator[str]:
    """Yield that loops lack a step (k,); None: they lack nothing."""
    if offset is not None:
        length, angle = manifold.motion(offset[None])
        yield (f'loops share an offset of {length[0]:.2g} m and {math.degrees(angle[0]):.2g} '
               'degrees, more than noise explains: look at the mount of the sensor, or at the '
               'times that loops name')


def doubted(factors: BetweenFactors) -> str:
    """Return how many loops, and absolute poses if any, there are to be doubted."""
    absolute = int(factors.is_absolute.sum())
    loops = counted(int((~factors.is_odometry).sum()) - absolute, 'loop')
    return f'{loops} and {counted(absolute, "absolute pose")}' if absolute else loops


def doubt_sentence(doubts: Iterable[Doubt], ids: Indices, stamps: Indices | None) -> str:
    """
    Return why and where a map is not to be relied on, and what can be done; empty: it may be.

    ids, stamps : (n,) of the keyframes
    """
    reasons = '; '.join(doubt_reasons(doubts, ids, stamps))
    return f'{DOUBTFUL}: {reasons}. {_REMEDY}' if reasons else ''


def doubt_reasons(doubts: Iterable[Doubt], ids: Indices, stamps: Indices | None) -> list[str]:
    """Return why and where a map is not to be relied on, a clause on each doubt; see above."""
    reasons = []
    for doubt in doubts:
        where = f'between {ids[doubt.first]} and {ids[doubt.last]}'
        if stamps is not None:
            first, last = stamp_text(stamps[doubt.first]), stamp_text(stamps[doubt.last])
            where += f' ({first} s to {last} s)'
        reasons.append(_REASONS[doubt.kind].format(loops=f'{doubt.loops:,}', where=where,
                                                   detail=doubt.detail))
    return reasons


def doubted_rows(doubt: Doubt, factors: BetweenFactors) -> Indices:
    """Return the rows of the loops that a doubt is about, (k,), in the order of the file."""
    if not doubt.pairs:
        return np.zeros(0, np.int64)
    n = len(factors.predecessor)
    (of, pairs) = (np.sort(pairs, axis=1) for pairs in (factors.pairs, np.array(doubt.pairs)))
    named = np.isin(of @ [n, 1], pairs @ [n, 1])
    return np.flatnonzero(named & ~factors.is_odometry & ~factors.struck)


def _named(pair: np.ndarray) -> str:
    return f'{pair[0]} - {pair[1]}' if pair[0] != pair[1] else f'absolute pose of {pair[1]}'
