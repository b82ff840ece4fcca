# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What the page of a doubt shows: a map and its rivals, each loop, its fate and the reason."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from l1slam_ros.cli.report.rivals import Rival
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch_map import Outcome
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
    Judgement,
)
from l1slam_ros.io import formats
from l1slam_ros.io.files import counted, stamp_text
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.side_files import beside
from l1slam_ros.io.sentences import DOUBTFUL, doubt_reasons, doubted, doubted_rows

# The fate of a loop or an odometry step: the word, the sentence where its sigmas are known, the
# sentence where they are not.
_FATES = (
    ('accepted', 'agrees with the map, {} sigmas off it', 'is in the map, and was not judged'),
    ('rejected', 'contradicts what is accepted: {} sigmas off the map without it',
     'was refused before its place was known'),
    ('suspect', 'fits, {} sigmas off, but nothing else confirms it: it could be chance',
     'could not be tested: nothing accepted leads from one end of it to the other'),
    ('slip', 'is odometry that the loops contradict, {} sigmas off: left out',
     'is odometry that the loops contradict: left out'),
    ('trusted', 'is vouched for, so never refused; {} sigmas off the map',
     'is vouched for, so never refused'),
    ('struck', 'was struck out, so not used', 'was struck out, so not used'),
    ('odometry', 'is odometry that is in this map, {} sigmas off it',
     'is odometry that is in this map'))
_ACCEPTED, _REJECTED, _SUSPECT, _SLIP, _TRUSTED, _STRUCK, _ODOMETRY = range(len(_FATES))

_LOOK = 'Look at the images or scans of a few of them'
# What a person can do about a doubt, by its kind.
_ADVICE = {
    WEAK: f'Record loops of more places, or calibrate the odometry. {_LOOK}: tick as true those '
          'of places that you know.',
    UNCONFIRMED: f'{_LOOK}. Ticked as true, they settle it; ticked as false, they all go.',
    OTHER_MAP: 'Switch to the rival map: which of the two is the place as you know it? If it is '
               'the one solved, tick these loops as false. If it is the rival, tick them as true, '
               'and the loops that contradict them as false.',
    SLIP: 'Did the robot slip, hit something or get carried there? Loops across the step that are '
          'surely true, ticked as true, say where the robot went.',
    DRIFTS: 'Calibrate the wheels or the gyroscope. Far loops that are surely true, ticked as '
            'true, hold the map meanwhile.',
    UNFINISHED: 'A few loops ticked as true or as false shorten the judgement.',
    NORM: 'No single loop settles this. Switch to the least squares map: if that is the place as '
          'you know it, solve with `--norm l2`.',
    PARTS: 'Loops between the parts that are surely true, ticked as true, say where one lies from '
           'another. Each part on its own is a map.',
    NO_WHEELS: 'Record the odometry of the wheels beside the scans.',
    FAILED: 'Please report the sentence.', UNSOLVED: 'Please report the sentence.'}
# Doubts that no decision about loops settles.
_UNSETTLED = NORM, NO_WHEELS, FAILED, UNSOLVED


def content(path: Path, norm: str | None, record: GraphRecord, outcome: Outcome,
            rivals: Sequence[Rival], cost_name: str, remarks: Sequence[str]) -> dict[str, Any]:
    """
    Return what the page shows, as JSON has it; loops and keyframes by their numbers, from 0.

    Parameters
    ----------
    path : of the input
    norm : as it was asked for; None: the default
    cost_name : what the cost of the map is called
    remarks : sentences that were said besides

    """
    factors = record.graph.between
    judgement = outcome.judgement
    maps = _maps(record, outcome, rivals, cost_name)
    slips = np.flatnonzero(np.any([one.fate == _SLIP for one in maps], axis=0))
    rows = np.concatenate((np.flatnonzero(~factors.is_odometry), slips))
    doubts = judgement.doubts if judgement else ()
    number_of = np.full(len(factors), -1)
    number_of[rows] = np.arange(len(rows))
    said = np.where(factors.trusted & ~factors.is_odometry, 1, np.where(factors.struck, 2, 0))
    name = path.name.encode(errors='replace').decode()
    return {
        'name': name,
        'doubtful': bool(doubts),
        'verdict': _verdict(record, outcome),
        'doubts': [
            {'text': text, 'advice': _ADVICE[doubt.kind],
             'settled': doubt.kind not in _UNSETTLED,
             'loops': number_of[doubted_rows(doubt, factors)].tolist()}
            for doubt, text in zip(doubts, doubt_reasons(doubts, record.ids, record.stamps),
                                   strict=True)],
        'remarks': list(remarks),
        # As text: JavaScript's numbers do not hold 64 bits.
        'ids': [str(name) for name in record.ids.tolist()],
        'stamps': [] if record.stamps is None else [
            stamp_text(stamp) for stamp in record.stamps.tolist()],
        'path': _path(record.graph),
        'i': factors.pairs[rows, 0].tolist(), 'j': factors.pairs[rows, 1].tolist(),
        'said': said[rows].tolist(), 'loops': len(rows) - len(slips),
        'fates': [dict(zip(('word', 'reason', 'unknown'), fate, strict=True)) for fate in _FATES],
        'maps': _drawn(maps, rows),
        'files': _files(path, name, norm, record,
                        any(doubt.kind == NORM for doubt in doubts)),
    }


def _verdict(record: GraphRecord, outcome: Outcome) -> str:
    factors = record.graph.between
    judgement = outcome.judgement
    if judgement is None:
        return f'All of {doubted(factors)} were believed; none was judged.'
    used = int((judgement.accepted & ~factors.is_odometry).sum())
    said = f'{used:,} of {doubted(factors)} are in this map'
    if judgement.doubts:
        return f'{said}, but it is not to be relied on: {_counted_doubts(judgement)}.'
    return f'{said}, and nothing that was found speaks against it.'


def _counted_doubts(judgement: Judgement) -> str:
    count = len(judgement.doubts)
    return f'there {"is one doubt" if count == 1 else f"are {count} doubts"}'


class _Map(NamedTuple):
    """One map: (n, k) positions; the fate of each factor of the file and its sigmas, (m,)."""

    name: str
    note: str
    doubt: int
    positions: Array
    fate: Indices
    sigmas: Array


def _maps(record: GraphRecord, outcome: Outcome, rivals: Sequence[Rival],
          cost_name: str) -> list[_Map]:
    """Return the map that was solved and its rivals."""
    positions = record.graph.manifold.positions
    first = positions(outcome.solution.poses)
    fate, sigmas = _fates(record.graph, outcome.judgement)
    note = f'{_used(outcome, fate)}, {cost_name} {outcome.solution.cost:.6g}'
    maps = [_Map('the map', note, -1, first, fate, sigmas)]
    for rival in rivals:
        other = positions(rival.outcome.solution.poses)
        if rival.used.all():
            fate_there, sigmas_there = _fates(rival.graph, rival.outcome.judgement)
        else:  # of the same loops, but for one step
            odometry = np.where(rival.used, _ODOMETRY, _SLIP)
            fate_there = np.where(record.graph.between.is_odometry, odometry, fate)
            sigmas_there = np.where(fate_there == fate, sigmas, np.nan)
        maps.append(_Map(f'rival: {rival.name}', _note(rival, first, other, fate_there),
                         rival.doubt, other, fate_there, sigmas_there))
    return maps


def _drawn(maps: Sequence[_Map], rows: Indices) -> list[dict[str, Any]]:
    """Return maps as JSON has them, with some of the factors."""
    digits = _digits(maps[0].positions)
    return [{'name': one.name, 'note': one.note, 'doubt': one.doubt,
             'at': [axis.round(digits).tolist() for axis in one.positions.T],
             'fate': one.fate[rows].tolist(),
             'sigmas': [None if not np.isfinite(sigmas) else round(sigmas, 2)
                        for sigmas in one.sigmas[rows].tolist()]}
            for one in maps]


def _note(rival: Rival, first: Array, other: Array, fate: Indices) -> str:
    error = absolute_trajectory_error(other, first)
    return (f'{_used(rival.outcome, fate)}; {error:.2f} m from the map that was solved (RMSE '
            'after rigid alignment)')


def _used(outcome: Outcome, fate: Indices) -> str:
    used = int(np.isin(fate, (_ACCEPTED, _TRUSTED)).sum())
    judgement = outcome.judgement
    status = DOUBTFUL if judgement and judgement.doubts else outcome.solution.status.value
    return f'{counted(used, "loop")} used, {status.replace("_", " ")}'


def _fates(graph: FactorGraph, judgement: Judgement | None) -> tuple[Indices, Array]:
    """Return the fate of each factor, (m,), and its sigmas, (m,)."""
    factors = graph.between
    fate = np.where(factors.is_odometry, _ODOMETRY, _ACCEPTED)
    sigmas = np.full(len(factors), np.nan)
    if judgement is not None:
        sigmas = judgement.sigmas
        fate[~factors.is_odometry & ~judgement.accepted] = _REJECTED
        fate[judgement.suspect] = _SUSPECT
        fate[judgement.slips] = _SLIP
    fate[factors.trusted & ~factors.is_odometry] = _TRUSTED
    fate[factors.struck] = _STRUCK
    return fate, sigmas


def _path(graph: FactorGraph) -> list[int]:
    """Return the keyframes robot by robot, -1 before each that no odometry leads to."""
    robot = graph.robot
    path = list[int]()
    for number in np.unique(robot).tolist():
        for keyframe in np.flatnonzero(robot == number).tolist():
            path += [keyframe] if graph.between.step_to[keyframe] >= 0 else [-1, keyframe]
    return path[1:]


def _digits(positions: Array) -> int:
    """Return how many decimals a drawing of positions (n, k) needs."""
    extent = float(np.ptp(positions, axis=0).max(initial=1e-6))
    return int(np.clip(5 - np.floor(np.log10(max(extent, 1e-6))), 0, 12))


def _files(path: Path, name: str, norm: str | None, record: GraphRecord,
           by_norm: bool) -> dict[str, str]:
    """
    Return where the lines go, the command that obeys them, and what comes before.

    by_norm : whether another norm may settle it
    """
    first = ''
    if formats.is_bag(path) or record.remarks is not None:
        # Only beside graphs there are such files.
        graph = Path(f'{name}.g2o')
        first = shlex.join(['l1slam', 'convert', name, str(graph)])
        name = str(graph)
    more = ['--norm', norm] if norm else []
    least_squares = shlex.join(['l1slam', 'solve', name, '--norm', 'l2'])
    return {'trusted': beside(name, 'trusted').name, 'struck': beside(name, 'struck').name,
            'first': first, 'command': shlex.join(['l1slam', 'solve', name, *more]),
            'settled': least_squares if by_norm else ''}
