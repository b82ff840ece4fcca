# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The cells as Markdown: what updates cost, what the maps were, and which bars are missed."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from robust.kinds import CITY, LIES
from updates.cells import GRAPHS, RECORDED, Row

NOTHING = '–'
# Maps of fewer keyframes are not held to the bars on excess and error: they change with each loop.
YOUNG = 1300
# Bars, in the order of the table below: of ISAM2's p99, longest update and sum of updates, of that
# sum all that ours takes in all threads; [ms] the p95 of the last quarter.
CITY_P99 = 1 / 4
CITY_MAX = 1 / 4
CITY_TOTAL = 1 / 3
CITY_ALL = 1.0
CITY_LAST = 5.0
# Excess [%]: mean, most, a second after the end. Error over that of the map of all true loops, and
# three times that plus [m] where there are lies.
EXCESS = 0.5
EXCESS_MOST = 2.0
EXCESS_AT_REST = 0.1
ERROR = 1.05
ERROR_TIMES = 3.0
ERROR_PLUS = 0.5
# Recorded lies: over the error of the batch in the end, and [m] above the odometry on the way.
RECORDED_ERROR, WORSE = 1.1, 1.0
# A large sparse world: p99 [ms], memory [MiB].
LARGE = 'world50k'
LARGE_P99 = 20.0
LARGE_MEMORY = 1024.0


def document(recorded: Mapping[str, Any], rows: Sequence[Row]) -> list[str]:
    """Return the whole report."""
    machine, versions = recorded['machine'], recorded['versions']
    named = ', '.join(f'{name} {versions[name]}' for name in ('python', 'numpy', 'gtsam')
                      if name in versions)
    ordered = sorted(rows, key=_order)
    return [
        '# Updates of a growing map', '',
        'Made by `python benchmarks/incremental.py --datasets DIR`. '
        f'{machine["cpu"]}, {machine["used"]} of {machine["cores"]} cores; {named}. Each cell is '
        'a process of its own: the graph comes pose by pose, an update of ours after each, loops '
        'doubted, and then an update of ISAM2 (L2, linearised again above 0.1, true loops alone), '
        'which has a process of its own: here it would hold the lock of the interpreter. '
        'Milliseconds of the updating threads; *behind*: seconds of our other threads. '
        f'Excess and error from keyframe {YOUNG:,} on, at {_checkpoints(rows)} checkpoints.', '',
        '## Time', '', *_table(_TIME, (_time(row) for row in ordered)),
        '- **/ ISAM2**: p99, longest, sum of the updates, and that sum with what goes on behind, '
        "over ISAM2's, of the same updates; *cut at*: ISAM2 had no more time there. **growth**: "
        "p95 of the last quarter of the updates over that of the second, ISAM2's in brackets. "
        '**per s**: keyframes, as both came along.', '',
        '## Maps', '', *_table(_MAPS, (_maps(row) for row in ordered)),
        '- **excess**: mean / most above the L1 optimum of what is believed; a second after the '
        'end. **error**: most of the error over that of the L1 map of all true loops so far; the '
        'last one, and of the batch [m]. **above odometry**: most, anywhere [m]. **kept**: most '
        'false loops at a checkpoint; **lost**: true ones in the end; **differs**: loops that '
        'only one of batch and running back end believes then. **missed**: bars (`tables.py`).']


def missed(row: Row) -> list[str]:
    """Return the bars that a row misses, by name."""
    bars = {'excess at rest': row.excess[-1] <= EXCESS_AT_REST}
    if _old(row):
        excess = _from(row, row.excess)
        bars |= {'excess': np.mean(excess) <= EXCESS, 'most excess': max(excess) <= EXCESS_MOST,
                 'error': row.cell.kind == RECORDED or max(_over(row)) <= ERROR}
    if row.cell.kind in LIES:
        bars |= {'lies': max(row.kept) == 0, 'final set': row.differs == 0,
                 'running error': all(error <= ERROR_TIMES * clean + ERROR_PLUS for error, clean in
                                      zip(row.error, row.clean, strict=True))}
    if row.cell.kind == RECORDED:
        bars |= {'final error': row.error[-1] <= RECORDED_ERROR * row.batch,
                 'odometry': _worse(row) <= WORSE}
    if row.cell.graph == LARGE:
        bars |= {'p99': row.ours['p99'] <= LARGE_P99, 'memory': row.memory <= LARGE_MEMORY}
    if row.cell.graph == CITY and row.peer and row.peer_poses == row.n:
        bars |= {'p99 / ISAM2': _ratio(row, 'p99') <= CITY_P99,
                 'longest / ISAM2': _ratio(row, 'max') <= CITY_MAX,
                 'sum / ISAM2': _ratio(row, 'total') <= CITY_TOTAL,
                 'all / ISAM2': _all(row) <= CITY_ALL,
                 'last quarter': row.ours['last'] <= CITY_LAST,
                 'growth': _growth(row.ours) <= _growth(row.peer)}
    return [name for name, reached in bars.items() if not reached]


_TIME = ('graph', 'kind', 'false', 'keyframes', 'per s', 'median', 'p95', 'p99', 'longest',
         'sum [s]', 'behind [s]', 'MiB', 'ISAM2: median', 'p95', 'p99', 'longest', 'sum [s]',
         '/ ISAM2: p99', 'longest', 'sum', 'all', 'growth')
_MAPS = ('graph', 'kind', 'false', 'keyframes', 'excess [%]', 'at rest', 'error', 'last', 'batch',
         'above odometry', 'kept', 'lost', 'differs', 'missed', 'commit')


def _time(row: Row) -> list[str]:
    columns = ('median', 'p95', 'p99', 'max')
    cells = [*_name(row), f'{row.reached:.0f}', *(f'{row.ours[key]:.2f}' for key in columns),
             f'{row.ours["total"]:.1f}', f'{row.behind:.1f}', f'{row.memory:.0f}']
    if row.peer is None:
        return [*cells, *[NOTHING] * 9, f'{_growth(row.ours):.2f}']
    cut = '' if row.peer_poses == row.n else f', cut at {row.peer_poses:,}'
    return [*cells, *(f'{row.peer[key]:.2f}' for key in columns),
            f'{row.peer["total"]:.1f}{cut}',
            *(f'{_ratio(row, key):.2f}' for key in ('p99', 'max', 'total')),
            NOTHING if cut else f'{_all(row):.2f}',
            f'{_growth(row.ours):.2f} ({_growth(row.peer):.2f})']


def _maps(row: Row) -> list[str]:
    excess, old = _from(row, row.excess), _old(row)
    return [*_name(row), f'{np.mean(excess):.2f} / {max(excess):.2f}' if old else NOTHING,
            f'{row.excess[-1]:.3f}', f'{max(_over(row)):.3f}' if old else NOTHING,
            f'{row.error[-1]:.3f}', f'{row.batch:.3f}', f'{_worse(row):+.2f}',
            f'{max(row.kept)}/{row.false}', f'{row.lost[-1]}/{row.true}', str(row.differs),
            ', '.join(missed(row)) or 'none', row.commit]


def _name(row: Row) -> list[str]:
    cell = row.cell
    doubted = '' if cell.robust else ', none doubted'
    return [cell.graph, f'{cell.kind}{doubted}', f'{cell.share:.0%}', f'{row.n:,}']


def _old(row: Row) -> bool:
    return row.keyframes[-1] >= YOUNG


def _from(row: Row, values: Sequence[float]) -> list[float]:
    """Return those of the checkpoints that are held to the bars."""
    return [value for n, value in zip(row.keyframes, values, strict=False) if n >= YOUNG]


def _over(row: Row) -> list[float]:
    """Return the error over that of the map of all true loops, at the same checkpoints."""
    return _from(row, [error / max(clean, 1e-6) for error, clean in
                       zip(row.error, row.clean, strict=True)])


def _worse(row: Row) -> float:
    return max(error - odometry for error, odometry in zip(row.error, row.odometry, strict=True))


def _ratio(row: Row, key: str) -> float:
    assert row.beside and row.peer
    return row.beside[key] / row.peer[key]


def _all(row: Row) -> float:
    assert row.peer
    return (row.ours['total'] + row.behind) / row.peer['total']


def _growth(of: Mapping[str, float]) -> float:
    return of['last'] / of['second']


def _checkpoints(rows: Sequence[Row]) -> int:
    return max((len(row.keyframes) for row in rows), default=0)


def _order(row: Row) -> tuple[Any, ...]:
    cell = row.cell
    known = GRAPHS.index(cell.graph) if cell.graph in GRAPHS else len(GRAPHS)
    kinds = ('clean', *LIES, RECORDED)
    return known, cell.graph, kinds.index(cell.kind), cell.share, cell.poses, cell.rate


def _table(header: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    rows = [header, ['---'] * len(header), *body]
    return ['| ' + ' | '.join(cells) + ' |' for cells in rows] + ['']
