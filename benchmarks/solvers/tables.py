# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The measurements as Markdown: one function for each part, from rows to lines of text."""

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from measuring import Row, rows_of
from solvers import growth, inner, iteration, whole

Lines = list[str]
NOT_REACHED = '–'


def document(recorded: Mapping[str, Mapping[str, Any]]) -> Lines:
    """Return the whole report of the parts that there are, by name."""
    lines = ['# Measurements', '',
             'Made by `python benchmarks/solvers`; what is measured, and how, says '
             '[README.md](README.md). One core and one thread; medians; all in seconds where '
             'nothing else is said.', '', '![The same as a picture](results.png)', '']
    for part, (title, tables) in PARTS.items():
        if part in recorded:
            lines += [f'## {title}', '', _machine(recorded[part]), '',
                      *tables(rows_of(recorded[part])), '']
    return lines


def table(header: Sequence[str], body: Iterable[Sequence[str]]) -> Lines:
    """Return a Markdown table, then an empty line."""
    rows = [header, ['---'] * len(header), *body]
    return ['| ' + ' | '.join(cells) + ' |' for cells in rows] + ['']


def ratios(rows: Sequence[Row], reference: str) -> dict[tuple[str, str, str], float | None]:
    """
    Return each row's seconds as a multiple of the reference solver's, by the rows' keys.

    The reference is that of the same problem and group; None where either was not reached.
    """
    of = {(r.problem, r.group): r.seconds for r in rows if r.solver == reference}
    found: dict[tuple[str, str, str], float | None] = {}
    for r in rows:
        base = of.get((r.problem, r.group))
        found[r.key] = r.seconds / base if r.seconds is not None and base else None
    return found


def number(value: float | None) -> str:
    """Return three significant digits, without an exponent where that is short."""
    if value is None:
        return NOT_REACHED
    if value != 0 and not 1e-4 <= abs(value) < 1e5:
        return f'{value:.1e}'
    return f'{value:#.3g}'.rstrip('.')


def inner_tables(rows: Sequence[Row]) -> Lines:
    """Return a table for each mark: problems down, solvers across."""
    lines = ['In brackets: how many times faster than plain Algorithm 2. '
             f'{NOT_REACHED}: not reached within the time limit. The optima are proved to '
             f'{number(max(r.numbers["gap"] for r in rows))} of themselves.', '']
    of, solvers = ratios(rows, inner.REFERENCE), _unique(r.solver for r in rows)
    by_key = {r.key: r for r in rows}
    for group in _unique(r.group for r in rows):
        body = []
        for problem in _unique(r.problem for r in rows):
            keys = [(problem, group, solver) for solver in solvers]
            body.append([problem, *(_cell(by_key[k].seconds, _inverse(of[k])) for k in keys)])
        lines += [f'### {group} above the optimum', '', *table(('problem', *solvers), body)]
    return lines


def whole_tables(rows: Sequence[Row]) -> Lines:
    """Return a table for each graph: starts and solvers down."""
    of = _references(rows)
    lines = ["Ratio: to gtsam's plain L2 Gauss-Newton from the same start; from nothing, to "
             'LAGO and Gauss-Newton. Above: the part of the L1 cost above the lowest known.', '']
    for problem in _unique(r.problem for r in rows):
        body = [(r.group, r.solver, number(r.seconds), number(of[r.key]),
                 f'{r.numbers["l1"]:.3f}', f'{r.numbers["excess"]:.1e}',
                 f'{r.numbers["chi2"]:.3f}') for r in rows if r.problem == problem]
        lines += [f'### {problem}', '', *table(
            ('start', 'solver', 's', 'ratio', 'L1 cost', 'above', 'chi2'), body)]
    return lines


def starts_tables(rows: Sequence[Row]) -> Lines:
    """Return one table: for each graph and solver the spread over the perturbed starts."""
    of, body = ratios(rows, whole.REFERENCE), []
    for problem in _unique(r.problem for r in rows):
        for solver in _unique(r.solver for r in rows):
            own = [r for r in rows if (r.problem, r.solver) == (problem, solver)]
            excess = [r.numbers['excess'] for r in own]
            times = [r.seconds for r in own if r.seconds is not None]
            ratio = statistics.median(v for r in own if (v := of[r.key]) is not None)
            body.append((problem, solver, str(len(own)), number(statistics.median(times)),
                         number(ratio), *(f'{v:.1e}' for v in (
                             min(excess), statistics.median(excess), max(excess)))))
    return table(('graph', 'solver', 'starts', 's', 'ratio', 'L1 above lowest: least', 'median',
                  'most'), body)


def iteration_tables(rows: Sequence[Row]) -> Lines:
    """Return one table, in microseconds and GB/s."""
    of = ratios(rows, iteration.REFERENCE)
    body = []
    for r in rows:
        needed = r.numbers.get('needed')
        assert r.seconds is not None
        body.append((r.problem, r.solver, number(1e6 * r.seconds), number(_inverse(of[r.key])),
                     number(r.numbers.get('bytes_per_edge')),
                     number(_scaled(r.numbers.get('bandwidth'), 1e-9)),
                     number(1e-9 * r.numbers['bandwidth_large']), number(_scaled(needed, 1e6)),
                     number(r.seconds / needed if needed else None)))
    return table(('problem', 'iteration', 'µs', 'times faster', 'bytes per edge',
                  'GB/s at its size', 'GB/s of large arrays', 'µs its bytes need',
                  'multiple of that'), body)


def growth_tables(rows: Sequence[Row]) -> Lines:
    """Return one table, and the exponents."""
    body = [(r.problem, r.group, number(r.seconds), *(number(r.numbers.get(name)) for name in (
        *growth.PHASES, 'cost', 'true_cost', 'peak_before', 'peak'))) for r in rows]
    sparse = [r for r in rows if r.group == 'sparse' and r.seconds is not None]
    edges = np.array([r.numbers['edges'] for r in sparse])
    lines = table(('poses / edges', 'kind', 's', 'seed', 'solve', 'L1 cost', 'of the true poses',
                   'MiB before', 'MiB at most'), body)
    for phase in growth.PHASES:
        p = growth.exponent(edges, np.array([r.numbers[phase] for r in sparse]))
        lines.append(f'Time of the {phase} grows as edges^{p:.2f} (sparse worlds).')
    return lines


def comparison(now: Mapping[str, Any], before: Mapping[str, Any]) -> Lines:
    """
    Return seconds now and before, and their ratio, for all that was reached both times.

    The last lines have the geometric means, of ours and of peers: those show the machine's part.
    """
    lines, logs = [], {True: list[float](), False: list[float]()}
    for part in (part for part in PARTS if part in now and part in before):
        old = {r.key: r.seconds for r in rows_of(before[part])}
        for r in rows_of(now[part]):
            was = old.get(r.key)
            ratio = r.seconds / was if r.seconds is not None and was else None
            if ratio is not None:
                logs[r.ours].append(float(np.log(ratio)))
            lines.append(f'{part}: {", ".join(r.key)}: {number(r.seconds)} / {number(was)} s, '
                         f'{number(ratio)}')
    for word, values in (('ours', logs[True]), ('peers', logs[False])):
        if values:
            lines.append(f"{word}: {np.exp(np.mean(values)):.3f} of the baseline's time, "
                         f'geometric mean of {len(values)}')
    return lines


def _machine(recorded: Mapping[str, Any]) -> str:
    machine = recorded['machine']
    versions = ', '.join(f'{name} {version}' for name, version in recorded['versions'].items())
    return f'{machine["cpu"]}, {machine["used"]} of {machine["cores"]} cores; {versions}.'


def _references(rows: Sequence[Row]) -> dict[tuple[str, str, str], float | None]:
    """Return the ratios to the reference, which is another one where the start is counted."""
    nothing = ratios(rows, whole.REFERENCE_FROM_NOTHING)
    given = ratios(rows, whole.REFERENCE)
    return {key: nothing[key] if key[1] == whole.NOTHING else given[key] for key in given}


def _cell(seconds: float | None, times_faster: float | None) -> str:
    if seconds is None or times_faster is None:
        return number(seconds)
    return f'{number(seconds)} ({number(times_faster)})'


def _inverse(value: float | None) -> float | None:
    return None if value is None else 1 / value


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _unique(words: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(words))


PARTS: dict[str, tuple[str, Callable[[Sequence[Row]], Lines]]] = {
    'inner': ('Inner problems: min |A x - b|_1', inner_tables),
    'whole': ('Whole solves', whole_tables),
    'starts': ('Perturbed starts', starts_tables),
    'iteration': ('One iteration', iteration_tables),
    'growth': ('Growth with size', growth_tables),
}
