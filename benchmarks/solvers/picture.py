# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The measurements as one picture: inner problems, whole solves, growth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Row, rows_of
from solvers import growth, inner

from l1slam_ros.io.files import replacing

_PANEL = 6.0, 4.5  # [inch]
# Those of Okabe and Ito, which people who see red and green alike can tell apart.
_COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000', '#808080')
# For the first, second and third time round the colours.
_SPOTS, _CROSSES = 'os^', 'x+*'
# The lowest cost known has none, which a logarithm cannot show.
_LEAST_EXCESS = 1e-8


def draw(path: Path, recorded: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a picture of the parts that there are, by name."""
    from matplotlib.figure import Figure

    panels = [(rows_of(recorded[part]), panel) for part, panel in (
        ('inner', _inner), ('whole', _whole), ('growth', _growth)) if part in recorded]
    if not panels:
        return
    width, height = _PANEL
    figure = Figure(figsize=(width * len(panels), height), layout='constrained')
    for k, (rows, panel) in enumerate(panels, 1):
        panel(figure.add_subplot(1, len(panels), k), rows)
    with replacing(path) as temporary:
        figure.savefig(temporary, format='png', dpi=150)


def _inner(axes: Any, rows: Sequence[Row]) -> None:
    """Draw a dot for each problem and solver, at the tightest mark."""
    group = f'to {min(inner.MARKS):g}'
    problems = list(dict.fromkeys(r.problem for r in rows))
    for r, style in _styles([r for r in rows if r.group == group]):
        axes.plot(problems.index(r.problem), r.seconds or np.nan, **style)
    axes.set(yscale='log', ylabel='s', title=f'inner problems, {group} of the optimum')
    axes.set_xticks(range(len(problems)), problems, rotation=30, ha='right')
    axes.legend(frameon=False, fontsize='x-small')


def _whole(axes: Any, rows: Sequence[Row]) -> None:
    """Draw the L1 cost above the lowest known against the time, a dot for each solve."""
    for r, style in _styles(rows):
        axes.plot(r.seconds, max(r.numbers['excess'], _LEAST_EXCESS), **style)
    axes.set(xscale='log', yscale='log', xlabel='s', title='whole solves, all graphs and starts',
             ylabel='L1 cost above the lowest known')
    axes.legend(frameon=False, fontsize='x-small')


def _growth(axes: Any, rows: Sequence[Row]) -> None:
    """Draw the time of each phase against the edges."""
    reached = [r for r in rows if r.seconds is not None]
    for phase, colour in zip(growth.PHASES, _COLOURS, strict=False):
        for group, marker in (('sparse', 'o'), ('dense', 's')):
            own = [r for r in reached if r.group == group]
            axes.plot([r.numbers['edges'] for r in own], [r.numbers[phase] for r in own], marker,
                      color=colour, linestyle='-' if group == 'sparse' else '',
                      label=f'{phase}, {group}')
    axes.set(xscale='log', yscale='log', xlabel='edges', ylabel='s', title='growth with size')
    axes.legend(frameon=False, fontsize='small')


def _styles(rows: Sequence[Row]) -> list[tuple[Row, dict[str, Any]]]:
    """Return each row with how it is drawn: ours as spots; a solver's first row names it."""
    solvers = list(dict.fromkeys(r.solver for r in rows))
    seen: set[str] = set()
    styles = []
    for r in rows:
        lap, colour = divmod(solvers.index(r.solver), len(_COLOURS))
        style = {'color': _COLOURS[colour], 'linestyle': '',
                 'marker': (_SPOTS if r.ours else _CROSSES)[lap]}
        styles.append((r, style if r.solver in seen else style | {'label': r.solver}))
        seen.add(r.solver)
    return styles
