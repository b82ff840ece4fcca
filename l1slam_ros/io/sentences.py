# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Sentences on a judgement: refused loops, slips, drift, estimated noise and doubts."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.robust.as_measured import identity_roots
from l1slam_ros.core.robust.inspection import OFF_SCALE
from l1slam_ros.core.robust.judgement import (
    DRIFTS,
    FAILED,
    NO_WHEELS,
    NORM,
    OTHER_MAP,
    PARTS,
    SLIP,
    UNCONFIRMED,
    UNFINISHED,
    UNSOLVED,
    WEAK,
    Doubt,
    Judgement,
)
from l1slam_ros.io.files import counted, stamp_text
from l1slam_ros.io.graphs.graph_file import GraphRecord

# The status of a map that is not to be relied on.
DOUBTFUL = 'doubtful'
# Behind a cost that counts the factors of the map alone.
WITHOUT = ', without what is left out'

# Number of loops that are named one by one; `--json` lists all.
_NAMED = 20
# A gross slip of the odometry comes first: nothing that was driven after it can be trusted without
# the loops across it.
_SLIP = ('the odometry slipped from {pair}: this step is {sigmas:.1f} sigmas off what the loops '
         'say, and is left out')
# The odometry in the written map is not as measured: whoever uses that file has to know.
_DRIFT = ('the odometry drifts by {drift:+.3g} rad per metre, as the loops agree; the map uses '
          'odometry that is corrected for that')
# What a file states as the identity nobody measured, and a radian is no metre.
_IDENTITY = ('the information of the {kind} is the identity: the map is weighed by the noise that '
             'was estimated, {metres:.2g} m and {degrees:.2g} degrees')
# Estimated sigmas this many times the stated ones are reported; smaller errors are common.
_NOISY = 2.0
# Of odometry and of loops, in the order of `Judgement.variance`.
_NOISE = (
    'the odometry is about {times:.1f} times as noisy as stated: it says little about loops '
    'between distant times',
    'the loops are about {times:.1f} times as noisy as stated: a false loop that is off by little '
    'cannot be told from noise')
# Loops so much more accurate than stated hardly move the map, which is that of the odometry.
_OVERSTATED = ('the loops are about {times:,.0f} times as accurate as stated: weighed as stated, '
               'they move the map less than they could; expected covariances of what the front '
               'end measures')
_TOGETHER = ('the errors of loops of one place are correlated: each place counts as one loop, '
             'with the noise that was estimated')

# Kind of a doubt -> its sentence.
_REASONS = {
    WEAK: 'no loop is accepted, so the map is the odometry; {loops} left out, {where}',
    UNCONFIRMED: 'all else hardly confirms {loops} in use, {where}: false ones could fit as well',
    OTHER_MAP: '{loops} refused, {where}, may be right: then the map is another one',
    SLIP: 'the odometry may have slipped {where}: undecided by {loops} across it',
    DRIFTS: 'the odometry may turn by about {detail} rad per metre too much, {where}, undecided '
            'by the {loops} in use',
    UNFINISHED: 'the judgement of the loops did not come to an end: {loops} left out, '
                '{where}, were still being accepted, a few at a time',
    NORM: 'the map differs by more than noise explains from the least squares map of the same '
          '{loops}: errors are correlated, or factors are noisier than stated; `--norm l2` '
          'and `--norm huber` make other maps',
    NO_WHEELS: 'the odometry beside the scans never moves, so nothing confirms the motion where '
               'scans do not match, {where}',
    FAILED: 'judging the loops failed ({detail}): the map is made of what was accepted until '
            'then, and {loops} {where} are left out',
    UNSOLVED: 'solving with {loops} accepted failed ({detail}): this is the map by which '
              'they were judged',
    PARTS: 'no accepted loop joins {detail} parts of the map, {where}, so their relative poses '
           'are guesses; {loops} between them are left out',
}
_REMEDY = 'Vouch for a true loop, strike out a false one, or state the right noise'


def judgement_sentences(record: GraphRecord, judgement: Judgement) -> Iterator[str]:
    """Yield slips, refused loops with the worst first, suspect loops, and misstated noise."""
    factors = record.graph.between
    accepted = judgement.accepted
    is_loop = ~factors.is_odometry
    pairs = record.ids[factors.pairs]
    if judgement.drift:
        yield _DRIFT.format(drift=judgement.drift)
    yield from _identity_sentences(record.graph, judgement)
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
        yield (f'{counted(len(suspect), "loop")} suspect and left out: nothing confirms '
               f'{"it" if len(suspect) == 1 else "them"}')
    for sentence, times in zip(_NOISE, np.sqrt(judgement.variance).tolist(), strict=True):
        if times >= _NOISY:
            yield sentence.format(times=times)
    times = math.sqrt(judgement.variance[1])
    if accepted[is_loop].any() and 0 < times < 1 / OFF_SCALE and (judgement.meant == 1).all():
        yield _OVERSTATED.format(times=1 / times)
    if not judgement.is_noise_stated:
        yield _TOGETHER


def _identity_sentences(graph: FactorGraph, judgement: Judgement) -> Iterator[str]:
    """Yield the noise that was found of what states the identity."""
    if (judgement.meant == 1).all():
        return
    manifold = graph.manifold
    found = np.sqrt(judgement.meant * judgement.variance_meant[:, None]) / identity_roots(graph)
    for kind, sigmas in zip(('odometry', 'loops'), found, strict=True):
        if np.isfinite(sigmas).all() and np.ptp(sigmas):
            yield _IDENTITY.format(
                kind=kind, metres=sigmas[manifold.TRANSLATION][0],
                degrees=math.degrees(sigmas[manifold.ROTATION][0]))


def known_false_sentence(record: GraphRecord, judgement: Judgement | None) -> Iterator[str]:
    """Yield how many loops that the file itself calls false were kept, and true ones left out."""
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
    """Yield a sentence on the offset (k,) that all loops share; nothing for None."""
    if offset is not None:
        length, angle = manifold.motion(offset[None])
        yield (f'loops share an offset of {length[0]:.2g} m and {math.degrees(angle[0]):.2g} '
               'degrees, more than noise explains: look at the mount of the sensor, or at the '
               'times that loops name')


def doubted(factors: BetweenFactors) -> str:
    """Return in words how many loops and absolute poses were judged."""
    absolute = int(factors.is_absolute.sum())
    loops = counted(int((~factors.is_odometry).sum()) - absolute, 'loop')
    return f'{loops} and {counted(absolute, "absolute pose")}' if absolute else loops


def doubt_sentence(doubts: Iterable[Doubt], ids: Indices, stamps: Indices | None) -> str:
    """
    Return why and where a map is doubtful, and what can be done; empty without doubts.

    ids, stamps : (n,) vertex ids and stamps [ns] of the keyframes
    """
    reasons = '; '.join(doubt_reasons(doubts, ids, stamps))
    return f'{DOUBTFUL}: {reasons}. {_REMEDY}' if reasons else ''


def doubt_reasons(doubts: Iterable[Doubt], ids: Indices, stamps: Indices | None) -> list[str]:
    """Return a clause for each doubt: its reason, and between which keyframes; see above."""
    reasons = []
    for doubt in doubts:
        where = f'between {ids[doubt.first]} and {ids[doubt.last]}'
        if stamps is not None:
            first, last = stamp_text(stamps[doubt.first]), stamp_text(stamps[doubt.last])
            where += f' ({first} s to {last} s)'
        reasons.append(_REASONS[doubt.kind].format(
            loops=counted(doubt.loops, 'loop'), where=where, detail=doubt.detail))
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
