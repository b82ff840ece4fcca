# SPDX-License-Identifier: Apache-2.0
"""
The report of `l1slam reproduce` in Markdown: tables, and the sentences that their numbers make.

In: what was measured. Out: lines. What the paper printed comes from `paper`; no result of this
package is written down here, so no sentence can outlive the numbers it is about.
"""

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.paper.experiments import PROBLEMS, Costs, Seconds
from l1slam_ros.paper.markdown import bullets, cost, listed, milliseconds, percent, table
from l1slam_ros.paper.printed import PaperGraph
from l1slam_ros.paper.trials import LoopTrials, StartTrials

WORLD_SEED = 0
# Costs at the start that differ by less are those of one file: the paper prints 4 to 6 digits.
_SAME_FILE = 1e-4
# Two costs nearer than this are called level; the solvers promise no more.
_LEVEL = 1e-6
# From this factor on, "times" reads better than per cent.
_TIMES = 2.0
# Within this of the lowest cost of a diagram, a method has arrived.
_ARRIVED = 0.001
_SOURCE_OF_FILES = 'https://github.com/OpenSLAM-org/openslam_vertigo'
_NOTE = ("(*) The paper's world is the authors' own simulation. Ours is another of the same size "
         f'(`l1slam simulate`, seed {WORLD_SEED}): the times compare, the costs do not.')


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
    def is_of_paper(self) -> bool:
        """Whether this is the paper's own graph, judged by its file's cost at the start."""
        difference = abs(self.costs.initial - self.paper.initial)
        return bool(self.paper.file) and difference < _SAME_FILE * self.paper.initial

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
    false_loops : of Figure 6, by the name of the graph.
    """

    graphs: Sequence[GraphResult]
    missing: Sequence[PaperGraph] = ()
    convergence: dict[str, dict[str, Array]] = field(default_factory=dict)
    starts: StartTrials | None = None
    false_loops: dict[str, LoopTrials] = field(default_factory=dict)


def head(results: Results) -> list[str]:
    """Return the title, on what it was run, and what is not in the report and why."""
    versions = (f'Python {platform.python_version()}, NumPy {np.__version__}, '
                f'SciPy {scipy.__version__}, {platform.system()} {platform.machine()}')
    lines = ['# The experiments of "L1 Factor Graph SLAM", run again', '',
             'J. J. Casafranca, L. M. Paz and P. Pinies, "L1 Factor Graph SLAM: going beyond the '
             'L2 norm" (2013): what it printed, beside what l1slam_ros makes of the same '
             '(`l1slam reproduce`). *As printed* is the algorithm without what this package adds '
             'to it: no primal weight, full steps, and in Algorithm 4 a dual that starts from '
             'zero at each linearisation.', '',
             f'Run with {versions}.']
    for sentence in _on_missing(results.missing):
        lines += ['', sentence]
    return lines


def _on_missing(missing: Sequence[PaperGraph]) -> Iterator[str]:
    files = [graph for graph in missing if graph.file]
    worlds = [graph for graph in missing if not graph.file]
    if files:
        yield (f"**Not run: {listed([g.name for g in files])}**, the paper's own graphs. They "
               f'come with Vertigo ({_SOURCE_OF_FILES}, folder `datasets`; its '
               '`manhattanOlson3500.g2o` is `manhattan3500.g2o` here). Put '
               f'{listed([f"`{g.file}`" for g in files])} into one folder and name it with '
               '`--datasets`.')
    if worlds:
        yield (f'**Not run: {listed([g.name for g in worlds])}**; `--worlds all` simulates all '
               'such worlds.')


def table_1(results: Results) -> list[str]:
    """Return Table I, the L1 costs, and what they say."""
    header = ['L1 cost', 'poses, edges', 'start: paper', 'start: ours', 'seed: ours',
              'final: paper', 'final: as printed', 'final: ours', 'solver', 'of the L2 map']
    rows = [[r.title, f'{r.poses:,}, {r.edges:,}', cost(r.paper.initial), cost(r.costs.initial),
             cost(r.costs.seed), cost(r.paper.final), cost(r.costs.printed[-1]),
             f'**{cost(r.costs.solution.cost)}**', r.costs.solver, cost(r.costs.l2)]
            for r in results.graphs]
    return [*table(header, rows), *_note(results), '', *bullets(_on_costs(results.graphs))]


def _on_costs(graphs: Sequence[GraphResult]) -> Iterator[str]:
    own = [r for r in graphs if r.is_of_paper]
    if own:
        difference = max(abs(r.costs.initial / r.paper.initial - 1) for r in own)
        yield (f"{_names(own)}: the cost at the start is the paper's to {percent(difference)}, "
               "so these are the paper's own graphs.")
    for r in graphs:
        yield _on_final(r)
    groups = [
        ("The seed alone (Algorithm 3) is below the paper's final",
         [r for r in own if r.costs.seed < r.paper.final]),
        ("The L2 map has a lower L1 cost than the paper's final, which is no optimum then",
         [r for r in own if r.costs.l2 < r.paper.final]),
        ('Algorithm 4 as printed ends above the seed that it began from',
         [r for r in graphs if r.costs.printed[-1] > r.costs.seed]),
        ('Algorithm 4 as printed ends below ours',
         [r for r in graphs if r.costs.printed[-1] < r.costs.solution.cost]),
    ]
    for sentence, found in groups:
        if found:
            yield f'{sentence}: {_names(found)}.'
    for r in graphs:
        if r.costs.cut_short:
            yield (f'{r.paper.name}: Algorithm 4 as printed was ended after '
                   f'{len(r.costs.printed) - 1} linearisations, before it had settled, because '
                   'the graph is so large.')


def _on_final(r: GraphResult) -> str:
    """Compare the finals of one graph, with the paper's only where that was its graph."""
    costs, ours = r.costs, r.costs.solution.cost
    said = [f'Algorithm 4 as printed, from our seed, is {compared(costs.printed[-1], ours)} ours',
            f'the L2 map is {compared(costs.l2, ours)} ours']
    if r.is_of_paper:
        said[0] += f" and {compared(costs.printed[-1], r.paper.final)} the paper's final"
        said.insert(0, f"our final is {compared(ours, r.paper.final)} the paper's")
    elif r.paper.file:
        said.insert(0, f'the cost at the start is {compared(costs.initial, r.paper.initial)} the '
                    f"paper's: `{r.paper.file}` is not the file of the paper, and no cost of it "
                    'is compared')
    if r.truth_cost is not None:
        said.append(f'our final is {compared(ours, r.truth_cost)} the cost of the true poses, '
                    f'{cost(r.truth_cost)}')
    return f'{r.paper.name}: {"; ".join(said)}.'


def table_2(results: Results) -> list[str]:
    """Return Table II, the time per iteration, and what it says."""
    methods = list(results.graphs[0].seconds.methods)
    header = ['ms per iteration']
    for problem in PROBLEMS:
        header += [f'{problem}: paper', *(f'{problem}: {method}' for method in methods)]
    header += ['L2: paper (g2o)', 'L2: ours']
    rows = []
    for r in results.graphs:
        times: list[float | None] = []
        for k in range(len(PROBLEMS)):
            times += [r.paper.seconds[k], *(r.seconds.methods[m][k] for m in methods)]
        times += [r.paper.l2_seconds, r.seconds.l2]
        rows.append([r.title, *map(milliseconds, times)])
    return [*table(header, rows), *_note(results), '', *bullets(_on_seconds(results.graphs))]


def _on_seconds(graphs: Sequence[GraphResult]) -> Iterator[str]:
    methods = list(graphs[0].seconds.methods)
    yield ('The paper ran C++ on an Intel i7 at 2.9 GHz, this is another machine: within one row '
           'the ratios count. Ours is processor time. *Plain* is Algorithm 2 as printed, in '
           'SciPy; *fused* the compiled form of it that this package uses.')
    for method in methods:
        ratios = [(r.seconds.methods[method][k] / r.paper.seconds[k], f'{r.paper.name}, {problem}')
                  for r in graphs for k, problem in enumerate(PROBLEMS)]
        (low, where_low), (high, where_high) = min(ratios), max(ratios)
        yield (f'One {method} iteration takes {low:.2g} ({where_low}) to {high:.2g} '
               f"({where_high}) times as long as the paper's.")
    for method in methods[1:]:
        gains = [f'{r.paper.name} {r.seconds.methods[methods[0]][-1] / fast:.3g}'
                 for r in graphs if (fast := r.seconds.methods[method][-1])]
        yield (f'One {methods[0]} iteration of the global problem takes as long as so many '
               f'{method} ones: {", ".join(gains)}.')
    for method in methods:
        ours = [f'{r.paper.name} {r.seconds.l2 / r.seconds.methods[method][-1]:.3g} '
                f'({_paper_ratio(r.paper)})' for r in graphs]
        yield (f'One L2 step takes as long as so many {method} iterations of the global problem '
               f"(in brackets the paper's): {', '.join(ours)}.")


def _paper_ratio(paper: PaperGraph) -> str:
    if paper.l2_seconds is None:
        return 'did not finish'
    return f'{paper.l2_seconds / paper.seconds[-1]:.3g}'


def figure_2(results: Results) -> list[str]:
    """Return in numbers what the curves of Figure 2 show."""
    header = ['problem', 'method', 'iterations', 'cost at first', 'at last',
              'against the lowest', f'within {_ARRIVED:.1%} of it from']
    rows = []
    for problem, methods in results.convergence.items():
        lowest = min(history[:, 1].min() for history in methods.values())
        for method, history in methods.items():
            rows.append([problem, method, f'{history[-1, 0]:,.0f}', cost(history[0, 1]),
                         cost(history[-1, 1]), compared(history[-1, 1], lowest),
                         _arrival(history, (1 + _ARRIVED) * lowest)])
    return table(header, rows, words=2)


def _arrival(history: Array, bound: float) -> str:
    """Return the iteration from which on a cost stays within a bound."""
    outside = np.flatnonzero(history[:, 1] > bound)
    first = outside[-1] + 1 if len(outside) else 0
    return f'{history[first, 0]:,.0f}' if first < len(history) else 'not reached'


def compared(value: float, reference: float) -> str:
    """Return how a cost stands to another, as in 'ours is `2% below` theirs'."""
    ratio = value / reference
    if abs(ratio - 1) < _LEVEL:
        return 'level with'
    if ratio >= _TIMES:
        return f'{ratio:,.3g} times'
    return f'{percent(abs(ratio - 1))} {"above" if ratio > 1 else "below"}'


def _note(results: Results) -> list[str]:
    if any(not r.paper.file for r in results.graphs):
        return ['', _NOTE]
    return []


def _names(graphs: Sequence[GraphResult]) -> str:
    return listed([r.paper.name for r in graphs])
