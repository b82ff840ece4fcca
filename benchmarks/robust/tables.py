# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The runs of the false-loop suite as Markdown: a table for each suite and graph."""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from robust.kinds import GRAPHS, HOLDS, HOLDS_ELSEWHERE, KINDS, SUITES
from robust.runs import KEPT_PROBABILITY, WORSE, Run
from robust.solvers import DOUBTFUL, LOOK

Lines = list[str]
NOTHING = '–'
_HEAD = ('kind', 'false', 'solver', 'runs', 'pass', 'right', 'doubtful', 'kept', 'lost', 'slips',
         'error [m]', 'worst [m]', 'seconds')


def document(recorded: Mapping[str, Any], runs: Sequence[Run]) -> Lines:
    """Return the whole report."""
    lines = ['# False loops', '', *_introduction(recorded), '## Runs that pass', '',
             *_summary(runs)]
    for suite in _in_order(SUITES, (run.suite for run in runs)):
        lines += [f'## {suite}', '']
        of_suite = [run for run in runs if run.suite == suite]
        for graph in _in_order(GRAPHS, (run.graph for run in of_suite)):
            mine = [run for run in of_suite if run.graph == graph]
            lines += [f'### {suite}: {graph}', '', *_table(_HEAD, _body(mine))]
    return lines


def _introduction(recorded: Mapping[str, Any]) -> Lines:
    machine, versions = recorded['machine'], recorded['versions']
    named = ', '.join(f'{name} {versions[name]}' for name in ('python', 'numpy', 'gtsam')
                      if name in versions)
    limits = ', '.join(f'{name} {limit:g} m' for name, limit in HOLDS.items())
    return [
        'Made by `python benchmarks/false_loops.py --datasets DIR`; medians over the seeds, '
        'seconds of the processor, one core and one thread. '
        f'{machine["cpu"]}, {machine["used"]} of {machine["cores"]} cores; {named}. What the '
        'kinds are, and the bar of each, stands in `robust/kinds.py`.', '',
        '- **false**: part of all loops that is false; of n true ones, n p / (1 - p) are added: '
        '`random` (says two far poses are near), `identity` (says they are the same), `grouped` '
        '(10 to 20 that agree with each other). `aliased-`: runs of 50 that agree, how many, each '
        'with its own wrong transform or all the same, beside all true loops or half of them.',
        '- **error**: position, RMSE after alignment, to the truth of a recording, else to the '
        'map of the true loops in the same norm. A map is **right** when its error is at most '
        f'that of its bar (most kinds: {limits}, elsewhere {HOLDS_ELSEWHERE:g} m), false loops '
        'kept and true ones lost are within it, no slip is named that is none, and what is '
        'believed leaves as many parts as there are. **pass**: right, or doubtful where that is '
        'an answer.',
        '- **kept**, **lost**: mean of the false and of the true loops. gtsam does not say which '
        'it believes: those whose residual at its map is within the '
        f'{KEPT_PROBABILITY:.1%} quantile of chi2. **slips**: named and there, of those there; '
        'after a plus, named and not there.',
        f'- **{NOTHING}**: the time was up; then the solver did not get the other seeds.',
        '- gtsam: Levenberg-Marquardt, kernels on loops only, GNC told that the odometry is sure. '
        'The last word is the start: the odometry chain, our seed (L1, Algorithm 3, of all '
        'loops), or the poses stored in the file, which are much better than what a robot has. '
        'Neither start nor graph is counted in the seconds, but both in the limit.',
        f'- **Online**: pose by pose; every {LOOK} poses the map is compared with the truth, and '
        f'may be {WORSE:g} m worse than the odometry. In brackets: the most by which it was.', '']


def _summary(runs: Sequence[Run]) -> Lines:
    """Return the runs that pass: solvers down, suites across."""
    suites = _in_order(SUITES, (run.suite for run in runs))
    body = [[solver, *(_counted((run for run in runs if (run.suite, run.solver) == which),
                                lambda run: run.passed)
                       for which in ((suite, solver) for suite in suites))]
            for solver in _solvers(runs)]
    return _table(['solver', *suites], body)


def _body(runs: Sequence[Run]) -> Iterable[Lines]:
    for kind in _in_order([kind.name for kind in KINDS], (run.kind for run in runs)):
        for share in sorted({run.share for run in runs if run.kind == kind}):
            part = [run for run in runs if (run.kind, run.share) == (kind, share)]
            for solver in _solvers(part):
                mine = [run for run in part if run.solver == solver]
                yield [kind, f'{share:.0%}', solver, str(len(mine)),
                       *(_counted(mine, told) for told in (
                           lambda run: run.passed, lambda run: run.right,
                           lambda run: run.status == DOUBTFUL)),
                       *_numbers([run for run in mine if run.seconds is not None])]


def _numbers(ended: list[Run]) -> Lines:
    if not ended:
        return [NOTHING] * 6
    slips, named, wrongly = (sum(getattr(run, name) for run in ended)
                             for name in ('slips', 'named', 'wrongly'))
    worse = [run.worse for run in ended if run.worse is not None]
    errors = [run.error for run in ended if run.error is not None]
    return [_ratio(ended, 'kept', 'false'), _ratio(ended, 'lost', 'true'),
            f'{named - wrongly}/{slips}' + (f' + {wrongly}' if wrongly else ''),
            _number(statistics.median(errors)) + (f' ({max(worse):+.2f})' if worse else ''),
            _number(max(errors)), _number(statistics.median(run.seconds or 0 for run in ended))]


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
