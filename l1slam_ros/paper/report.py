# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What is measured of every graph of the paper, and the report's tables of it in Markdown.

In: what was measured. Out: lines; what comes of it, the numbers say.
"""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import (
    PROBLEMS,
    TIMED,
    Costs,
    Effort,
    Seconds,
    measure_largest,
)
from l1slam_ros.paper.printed import PaperGraph

WORLD_SEED = 0
_MISSING = ('The files come with Vertigo (https://github.com/OpenSLAM-org/openslam_vertigo; its '
            '`manhattanOlson3500.g2o` is `manhattan3500.g2o` here); `--datasets` names the folder '
            f'of {", ".join(f"`{name}`" for name in paper.FILES)}, `--worlds all` simulates the '
            'others.')
_HEAD = ('J. J. Casafranca, L. M. Paz and P. Pinies, "L1 Factor Graph SLAM: going beyond the L2 '
         'norm" (2013): what it printed, beside what `l1slam reproduce` makes of the same. *As '
         'printed* is the algorithm without the primal weight, the shortened steps and the warm '
         'dual that this package adds.')
_COSTS = ("A graph is the paper's own where the costs of both starts agree. (*) simulated anew in "
          f"the paper's size (seed {WORLD_SEED}). (+) ended before it had settled: too large.")
_SECONDS = ('Of the processor; the paper ran C++ on an Intel i7 at 2.9 GHz. *Plain* is Algorithm '
            '2 as printed, in SciPy; *fused* the compiled form that this package uses.')
_LARGEST = ('Algorithm 2 with the projection onto the L1 ball as the resolvent of the dual, from '
            'the L2 map. The worst factor is all that this norm sees.')


@dataclass(frozen=True)
class GraphResult:
    """
    A graph of the paper, or a world of its size, and what was measured on it.

    start, seed : (n, p) poses; truth_cost : L1 cost of the true poses, where they are known.
    """

    paper: PaperGraph
    graph: FactorGraph
    start: Array
    seed: Array
    costs: Costs
    seconds: Seconds
    truth_cost: float | None = None


@dataclass(frozen=True)
class Study:
    """What a section reports on: the graphs that there are, by name; how long it may run."""

    graphs: dict[str, GraphResult]
    effort: Effort


def head(study: Study) -> list[str]:
    """Return the title, on what it was run, and what is not in the report and why."""
    lines = ['# The experiments of "L1 Factor Graph SLAM", run again', '', _HEAD, '',
             f'Run with Python {platform.python_version()}, NumPy {np.__version__}, '
             f'SciPy {scipy.__version__}, {platform.system()} {platform.machine()}.']
    missing = [graph.name for graph in paper.GRAPHS if graph.name not in study.graphs]
    return lines + ['', f'**Not run: {", ".join(missing)}**. {_MISSING}'] * bool(missing)


def table_1(study: Study, _: Path) -> list[str]:
    """Return Table I, the L1 costs."""
    header = ['L1 cost', 'poses, edges', 'start: paper', 'start: ours', 'seed: ours',
              'final: paper', 'final: as printed', 'final: ours', 'solver', 'of the L2 map',
              'of the true poses']
    rows = [[_title(r), f'{r.graph.n_poses:,}, {len(r.graph.between):,}', cost(r.paper.initial),
             cost(r.costs.initial), cost(r.costs.seed), cost(r.paper.final),
             cost(r.costs.printed[-1]) + (' (+)' if r.costs.cut_short else ''),
             f'**{cost(r.costs.solution.cost)}**', r.costs.solver, cost(r.costs.l2),
             '' if r.truth_cost is None else cost(r.truth_cost)] for r in study.graphs.values()]
    return [*table(header, rows), '', _COSTS]


def table_2(study: Study, _: Path) -> list[str]:
    """Return Table II, the time per iteration."""
    header = ['ms per iteration', *(f'{problem}: {method}' for problem in PROBLEMS
                                    for method in ('paper', *TIMED))]
    rows = []
    for r in study.graphs.values():
        times: list[float | None] = []
        for k in range(len(PROBLEMS)):
            times += [r.paper.seconds[k], *(r.seconds.methods[method][k] for method in TIMED)]
        rows.append([_title(r), *map(milliseconds, [*times, r.paper.l2_seconds, r.seconds.l2])])
    return [*table([*header, 'L2: paper (g2o)', 'L2: ours'], rows), '', _SECONDS]


def future_work(study: Study, _: Path) -> list[str]:
    """Return what the paper left for later: the map of the smallest largest residual."""
    name = paper.NOISY.name
    if name not in study.graphs:
        return [f'It is of {name}, which was not run.']
    noisy = study.graphs[name]
    found = measure_largest(noisy.graph, noisy.start, study.effort)
    rows = [[norm, *map(cost, values)] for norm, values in found.items()]
    return [*table([f'{name}: the map of', 'largest residual [sigmas]', 'L1 cost', 'chi2'], rows),
            '', _LARGEST]


def _title(result: GraphResult) -> str:
    """Return the paper's name of a graph, with a star where it was simulated anew."""
    return result.paper.name + ('' if result.paper.file else ' (*)')


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table whose first column holds words, the others numbers."""
    lines = [header, ['---'] + ['---:'] * (len(header) - 1), *rows]
    return [f'| {" | ".join(cells)} |' for cells in lines]


def cost(value: float) -> str:
    """Return a cost in six digits, as the paper prints them."""
    return f'{value:.6g}'.replace('e+0', 'e')


def milliseconds(seconds: float | None) -> str:
    """Return a time [s] in ms, without the unit."""
    if seconds is None:
        return 'did not finish'
    return f'{1e3 * seconds:.3g}' if seconds < 1 else f'{1e3 * seconds:.0f}'
