# SPDX-License-Identifier: Apache-2.0
"""
What there is to report of the paper's experiments, and its tables in Markdown.

In: what was measured. Out: lines; what comes of it, the numbers say.
"""

import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.paper.experiments import PROBLEMS, Costs, Seconds
from l1slam_ros.paper.printed import NOISY, PaperGraph
from l1slam_ros.paper.runs import LoopRuns, StartRuns
from l1slam_ros.paper.updates import Growth

WORLD_SEED = 0
_SOURCE_OF_FILES = 'https://github.com/OpenSLAM-org/openslam_vertigo'
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
    What was measured on one graph of the paper, or on a world of its size.

    poses, edges : its size; truth_cost : the L1 cost of the true poses, where they are known.
    """

    paper: PaperGraph
    poses: int
    edges: int
    costs: Costs
    seconds: Seconds
    drawing: MapDrawing
    truth_cost: float | None = None

    @property
    def title(self) -> str:
        """The paper's name of the graph, with a star where it was simulated anew."""
        return self.paper.name + ('' if self.paper.file else ' (*)')


@dataclass(frozen=True)
class Results:
    """
    Everything there is to report.

    missing : graphs of the paper that were not run; convergence : of Figure 2, problem -> method
    -> (k, 2) rows (iteration, cost), empty where its graph was not run; starts : of Figure 4;
    growth : of Figure 5; false_loops : of Figure 6, by the name of the graph; largest : see
    `measure_largest`.
    """

    graphs: Sequence[GraphResult]
    missing: Sequence[PaperGraph] = ()
    convergence: dict[str, dict[str, Array]] = field(default_factory=dict)
    starts: StartRuns | None = None
    growth: Growth | None = None
    false_loops: dict[str, LoopRuns] = field(default_factory=dict)
    largest: dict[str, Array] = field(default_factory=dict)


def head(results: Results) -> list[str]:
    """Return the title, on what it was run, and what is not in the report and why."""
    lines = ['# The experiments of "L1 Factor Graph SLAM", run again', '', _HEAD, '',
             f'Run with Python {platform.python_version()}, NumPy {np.__version__}, '
             f'SciPy {scipy.__version__}, {platform.system()} {platform.machine()}.']
    files = [graph for graph in results.missing if graph.file]
    worlds = [graph for graph in results.missing if not graph.file]
    if files:
        lines += ['', f'**Not run: {_names(files)}**. They come with Vertigo '
                  f'({_SOURCE_OF_FILES}; its `manhattanOlson3500.g2o` is `manhattan3500.g2o` '
                  f'here); `--datasets` names the folder of '
                  f'{", ".join(f"`{graph.file}`" for graph in files)}.']
    if worlds:
        lines += ['', f'**Not run: {_names(worlds)}**; `--worlds all` simulates all.']
    return lines


def _names(graphs: Iterable[PaperGraph]) -> str:
    return ', '.join(graph.name for graph in graphs)


def table_1(results: Results) -> list[str]:
    """Return Table I, the L1 costs."""
    header = ['L1 cost', 'poses, edges', 'start: paper', 'start: ours', 'seed: ours',
              'final: paper', 'final: as printed', 'final: ours', 'solver', 'of the L2 map',
              'of the true poses']
    rows = [[r.title, f'{r.poses:,}, {r.edges:,}', cost(r.paper.initial), cost(r.costs.initial),
             cost(r.costs.seed), cost(r.paper.final),
             cost(r.costs.printed[-1]) + (' (+)' if r.costs.cut_short else ''),
             f'**{cost(r.costs.solution.cost)}**', r.costs.solver, cost(r.costs.l2),
             '' if r.truth_cost is None else cost(r.truth_cost)] for r in results.graphs]
    return [*table(header, rows), '', _COSTS]


def table_2(results: Results) -> list[str]:
    """Return Table II, the time per iteration."""
    methods = list(results.graphs[0].seconds.methods)
    header = ['ms per iteration']
    for problem in PROBLEMS:
        header += [f'{problem}: {method}' for method in ('paper', *methods)]
    rows = []
    for r in results.graphs:
        times: list[float | None] = []
        for k in range(len(PROBLEMS)):
            times += [r.paper.seconds[k], *(r.seconds.methods[m][k] for m in methods)]
        rows.append([r.title, *map(milliseconds, [*times, r.paper.l2_seconds, r.seconds.l2])])
    return [*table([*header, 'L2: paper (g2o)', 'L2: ours'], rows), '', _SECONDS]


def future_work(results: Results) -> list[str]:
    """Return what the paper left for later: the map of the smallest largest residual."""
    if not results.largest:
        return [f'It is of {NOISY.name}, which was not run.']
    rows = [[name, *map(cost, values)] for name, values in results.largest.items()]
    return [*table([f'{NOISY.name}: the map of', 'largest residual [sigmas]', 'L1 cost', 'chi2'],
                   rows), '', _LARGEST]


def table(header: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    """Return a table whose first columns hold words, the others numbers."""
    lines = [header, ['---'] * words + ['---:'] * (len(header) - words), *rows]
    return [f'| {" | ".join(cells)} |' for cells in lines]


def cost(value: float) -> str:
    """Return a cost in six digits, as the paper prints them."""
    return f'{value:.6g}'.replace('e+0', 'e')


def metres(length: float) -> str:
    """Return a length [m] with its unit, to the centimetre."""
    return f'{length:.2f} m'


def milliseconds(seconds: float | None) -> str:
    """Return a time [s] in ms, without the unit."""
    if seconds is None:
        return 'did not finish'
    return f'{1e3 * seconds:.3g}' if seconds < 1 else f'{1e3 * seconds:.0f}'
