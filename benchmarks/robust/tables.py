# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The runs of the false-loop suite as Markdown: which pass, and ours beside others'."""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from robust.kinds import GRAPHS, HOLDS, HOLDS_ELSEWHERE, SUITES
from robust.runs import Run
from robust.solvers import DOUBTFUL

Lines = list[str]
NOTHING = '–'
# Whose runs stand beside each other, and of whose constants the first is what its authors give.
_PEERS = ('GM', 'DCS', 'GNC')
_BESIDE = ('protocol', 'recorded')


def document(recorded: Mapping[str, Any], runs: Sequence[Run]) -> Lines:
    """Return the whole report."""
    return ['# False loops', '', *_introduction(recorded), '## Beside others', '',
            *_beside([run for run in runs if run.suite in _BESIDE]), '## Runs that pass', '',
            *_summary(runs), '## Runs of ours that do not pass', '',
            *(f'- {run}' for run in runs if run.solver.startswith('ours') and not run.passed)]


def _introduction(recorded: Mapping[str, Any]) -> Lines:
    machine, versions = recorded['machine'], recorded['versions']
    named = ', '.join(f'{name} {versions[name]}' for name in ('python', 'numpy', 'gtsam')
                      if name in versions)
    limits = ', '.join(f'{name} {limit:g} m' for name, limit in HOLDS.items())
    return [
        'Made by `python benchmarks/false_loops.py --datasets DIR`; medians over the seeds, '
        'seconds of the processor, one core and one thread. '
        f'{machine["cpu"]}, {machine["used"]} of {machine["cores"]} cores; {named}. What the '
        'kinds are, and the bar of each, stands in `robust/kinds.py`. gtsam: Levenberg-Marquardt '
        'from the odometry chain, kernels on loops only, GNC told that the odometry is sure.', '',
        '- **Beside others**: the error [m] of positions, RMSE after alignment, to the truth '
        'where it is known, else to the map of the true loops. The graphs with a share of false '
        "loops are riSAM's protocol: of n true loops, n p / (1 - p) false ones are added that "
        'say that two far poses are the same; in the others place recognition made the false '
        "ones. Of each peer the first column is the constant that its authors give (a kernel's "
        "1, GNC's quantile .99), the second the best of three (1, 3, 10; 1, 10, 100; of two: "
        '.99, .999), picked with the truth in hand, and which that is. kept: false loops; lost: '
        'true ones.',
        '- **pass**: the map is near enough '
        f'({limits}, elsewhere {HOLDS_ELSEWHERE:g} m, where its bar does not say otherwise), '
        'false loops kept and true ones lost are within the bar, no slip is named that is none, '
        'and what is believed leaves as many parts as there are; or it is doubtful where that is '
        'an answer.',
        f'- **{NOTHING}**: the time was up, or not measured.', '']


def _summary(runs: Sequence[Run]) -> Lines:
    """Return the runs that pass: solvers down, suites across."""
    suites = _in_order(SUITES, (run.suite for run in runs))
    body = [[solver, *(_counted((run for run in runs if (run.suite, run.solver) == which),
                                lambda run: run.passed)
                       for which in ((suite, solver) for suite in suites))]
            for solver in _solvers(runs)]
    return _table(['solver', *suites], body)


def _beside(runs: Sequence[Run]) -> Lines:
    """Return the errors [m] of ours and of peers: graphs and shares down."""
    head = ['graph', 'false', 'ours L2', 'kept', 'lost', 'seconds',
            *(f'{peer} {of}' for peer in _PEERS for of in ('1', 'best')), 'seconds of the best']
    body = []
    for graph in _in_order(GRAPHS, (run.graph for run in runs)):
        for share in sorted({run.share for run in runs if run.graph == graph}):
            part = [run for run in runs if (run.graph, run.share) == (graph, share)]
            ours = [run for run in part if run.solver == 'ours L2']
            if not ours:
                continue
            peers = {peer: {solver: _error([run for run in part if run.solver == solver])
                            for solver in _solvers(part) if f' {peer} ' in solver}
                     for peer in _PEERS}
            best = min(((error, name) for found in peers.values()
                        for name, error in found.items()), default=(float('inf'), ''))
            body.append([
                graph, f'{share:.0%}' if share else '', _told(_error(ours)) + _word(ours),
                _ratio(ours, 'kept', 'false'), _ratio(ours, 'lost', 'true'), _seconds(ours),
                *(cell for found in peers.values() for cell in _cells(found)),
                _seconds([run for run in part if run.solver == best[1]])])
    return _table(head, body)


def _cells(found: Mapping[str, float]) -> Lines:
    """Return the error at the first constant, and the least with its constant."""
    if not found:
        return [NOTHING, NOTHING]
    least = min(found, key=lambda name: found[name])
    return [_told(next(iter(found.values()))), f'{_told(found[least])} ({least.split()[2]})']


def _error(runs: Sequence[Run]) -> float:
    """Return the median error [m], to the truth where it is known; infinite: the time was up."""
    errors = [run.error if run.truth is None else run.truth
              for run in runs if run.seconds is not None and run.error is not None]
    return statistics.median(errors) if errors else float('inf')


def _told(error: float) -> str:
    return NOTHING if error == float('inf') else _number(error)


def _word(runs: Sequence[Run]) -> str:
    return ', doubtful' if any(run.status == DOUBTFUL for run in runs) else ''


def _seconds(runs: Sequence[Run]) -> str:
    took = [run.seconds for run in runs if run.seconds is not None]
    return _number(statistics.median(took)) if took else NOTHING


def _counted(runs: Iterable[Run], told: Callable[[Run], bool]) -> str:
    answers = [told(run) for run in runs]
    return f'{sum(answers)}/{len(answers)}' if answers else NOTHING


def _ratio(runs: list[Run], part: str, whole: str) -> str:
    """Return the mean count of a part, of how many."""
    counts = [statistics.mean(getattr(run, field) for run in runs) for field in (part, whole)]
    return '/'.join(f'{count:g}' for count in counts)


def _number(value: float) -> str:
    return f'{value:.4f}' if value < 1 else f'{value:.3g}'


def _solvers(runs: Iterable[Run]) -> list[str]:
    """Return the solvers, ours first."""
    names = {run.solver for run in runs}
    return sorted(names, key=lambda name: (not name.startswith('ours'), name))


def _in_order(order: Sequence[str], names: Iterable[str]) -> list[str]:
    there = set(names)
    return [*(name for name in dict.fromkeys(order) if name in there), *sorted(there - set(order))]


def _table(header: Sequence[str], body: Iterable[Sequence[str]]) -> Lines:
    rows = [header, ['---'] * len(header), *body]
    return ['| ' + ' | '.join(cells) + ' |' for cells in rows] + ['']
