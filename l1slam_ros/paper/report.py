# SPDX-License-Identifier: Apache-2.0
"""
The tables of `l1slam reproduce`, in Markdown.

In: what was measured. Out: lines. The sentences are fixed and say what a table shows; what comes
of it, the numbers say.
"""

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.paper.experiments import PROBLEMS, Costs, Seconds
from l1slam_ros.paper.printed import PaperGraph
from l1slam_ros.paper.trials import (
    HUBER_WIDTHS,
    JOINT,
    L1,
    L2,
    NOISES,
    ROBUST,
    SEED,
    START,
    LoopTrials,
    Map,
    StartTrials,
    huber_name,
)

WORLD_SEED = 0
# Within this of the lowest cost of a diagram, a method has arrived.
_ARRIVED = 0.001
_SOURCE_OF_FILES = 'https://github.com/OpenSLAM-org/openslam_vertigo'
_HEAD = ('J. J. Casafranca, L. M. Paz and P. Pinies, "L1 Factor Graph SLAM: going beyond the L2 '
         'norm" (2013): what it printed, beside what l1slam_ros makes of the same '
         '(`l1slam reproduce`). *As printed* is the algorithm without what this package adds to '
         'it: no primal weight, full steps, and in Algorithm 4 a dual that starts from zero at '
         'each linearisation.')
_COSTS = ("A graph is the paper's own where both costs of its start agree, in the 4 to 6 digits "
          'that the paper prints; the costs of any other do not compare. (*) is simulated anew in '
          f"the size of the paper's (`l1slam simulate`, seed {WORLD_SEED}). (+) was ended before "
          'it had settled, because the graph is so large.')
_SECONDS = ('The paper ran C++ on an Intel i7 at 2.9 GHz, this is another machine: within one row '
            'the ratios count. Ours is processor time. *Plain* is Algorithm 2 as printed, in '
            'SciPy; *fused* the compiled form of it that this package uses.')


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
    false_loops : of Figure 6, by the name of the graph.
    """

    graphs: Sequence[GraphResult]
    missing: Sequence[PaperGraph] = ()
    convergence: dict[str, dict[str, Array]] = field(default_factory=dict)
    starts: StartTrials | None = None
    false_loops: dict[str, LoopTrials] = field(default_factory=dict)


def head(results: Results) -> list[str]:
    """Return the title, on what it was run, and what is not in the report and why."""
    lines = ['# The experiments of "L1 Factor Graph SLAM", run again', '', _HEAD, '',
             f'Run with Python {platform.python_version()}, NumPy {np.__version__}, '
             f'SciPy {scipy.__version__}, {platform.system()} {platform.machine()}.']
    files = [graph for graph in results.missing if graph.file]
    worlds = [graph for graph in results.missing if not graph.file]
    if files:
        lines += ['', f"**Not run: {', '.join(g.name for g in files)}**, the paper's own graphs. "
                  f'They come with Vertigo ({_SOURCE_OF_FILES}, folder `datasets`; its '
                  '`manhattanOlson3500.g2o` is `manhattan3500.g2o` here). Put '
                  f'{", ".join(f"`{g.file}`" for g in files)} into one folder and name it with '
                  '`--datasets`.']
    if worlds:
        lines += ['', f'**Not run: {", ".join(g.name for g in worlds)}**; `--worlds all` '
                  'simulates all such worlds.']
    return lines


def table_1(results: Results) -> list[str]:
    """Return Table I, the L1 costs."""
    header = ['L1 cost', 'poses, edges', 'start: paper', 'start: ours', 'seed: ours',
              'final: paper', 'final: as printed', 'final: ours', 'solver', 'of the L2 map',
              'of the true poses']
    rows = [[r.title, f'{r.poses:,}, {r.edges:,}', cost(r.paper.initial), cost(r.costs.initial),
             cost(r.costs.seed), cost(r.paper.final),
             cost(r.costs.printed[-1]) + (' (+)' if r.costs.cut_short else ''),
             f'**{cost(r.costs.solution.cost)}**', r.costs.solver, cost(r.costs.l2),
             '' if r.truth_cost is None else cost(r.truth_cost)]
            for r in results.graphs]
    return [*_table(header, rows), '', _COSTS]


def table_2(results: Results) -> list[str]:
    """Return Table II, the time per iteration."""
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
    return [*_table(header, rows), '', _SECONDS]


def figure_2(results: Results) -> list[str]:
    """Return in numbers what the curves of Figure 2 show."""
    header = ['problem', 'method', 'iterations', 'cost at first', 'at last', 'above the lowest',
              f'within {_ARRIVED:.1%} of it from']
    rows = []
    for problem, methods in results.convergence.items():
        lowest = min(history[:, 1].min() for history in methods.values())
        for method, history in methods.items():
            rows.append([problem, method, f'{history[-1, 0]:,.0f}', cost(history[0, 1]),
                         cost(history[-1, 1]), f'{history[-1, 1] / lowest - 1:.2%}',
                         _arrival(history, (1 + _ARRIVED) * lowest)])
    return _table(header, rows, words=2)


def _arrival(history: Array, bound: float) -> str:
    """Return the iteration from which on a cost stays within a bound."""
    outside = np.flatnonzero(history[:, 1] > bound)
    first = outside[-1] + 1 if len(outside) else 0
    return f'{history[first, 0]:,.0f}' if first < len(history) else 'not reached'


def figure_4(trials: StartTrials) -> list[str]:
    """Return what comes of noisy starts, and of the seed in their place."""
    header = ['start', 'its L1 cost', 'L2 from it: L1 cost', 'L2: off our map',
              'L2: keeps the shape', 'L1 from it: L1 cost', 'L1: off our map',
              'L1: keeps the shape']
    starts = {f'noise of {noise:g} m, {noise:g} rad':
              {method: with_noise(trials, noise, method) for method in (START, L2, L1)}
              for noise in NOISES}
    starts['the seed (Algorithm 3)'] = {
        START: [trials.seed], L2: [trials.l2], L1: [trials.solution]}
    rows = []
    for start, maps in starts.items():
        row = [start, _median_cost(maps[START])]
        for method in (L2, L1):
            row += [_median_cost(maps[method]), metres(median_error(maps[method])),
                    _in_shape(maps[method], trials.bent)]
        rows.append(row)
    rows.append(['the seed, then as printed', _median_cost([trials.seed]), '', '', '',
                 cost(trials.printed[-1]), '', ''])
    return _table(header, rows)


def figure_6(trials: dict[str, LoopTrials]) -> list[str]:
    """Return what comes of loops that lie, and which were refused; by name of the graph."""
    header = ['off its own clean map']
    for name in trials:
        header += [f'{name}: median', f'{name}: lowest to highest', f'{name}: keeps the shape']
    rows = []
    for method in (SEED, JOINT, *map(huber_name, HUBER_WIDTHS), ROBUST):
        row = [method]
        for of_graph in trials.values():
            maps = maps_by(of_graph, method)
            errors = [m.error for m in maps]
            row += [metres(median_error(maps)), f'{min(errors):.2f} to {metres(max(errors))}',
                    _in_shape(maps, of_graph.bent)]
        rows.append(row)
    return [*_table(header, rows), '', *_refused(trials)]


def _refused(trials: dict[str, LoopTrials]) -> list[str]:
    header = [ROBUST, 'true loops', 'false loops', 'draws', 'loses its shape at',
              'false loops refused', 'true factors refused']
    return _table(header, [[
        name, f'{len(of.loops):,}', f'{len(of.trials[0].false)}', f'{len(of.trials)}',
        metres(of.bent),
        f'{sum(len(t.refused) for t in of.trials)} of {sum(len(t.false) for t in of.trials)}',
        f'{sum(len(t.lost) for t in of.trials)}'] for name, of in trials.items()])


def maps_by(trials: LoopTrials, method: str) -> list[Map]:
    """Return the maps of one method, a draw each."""
    return [trial.maps[method] for trial in trials.trials]


def with_noise(trials: StartTrials, noise: float, method: str) -> list[Map]:
    """Return the maps of one method from the starts of one noise, a draw each."""
    return [trial.maps[method] for trial in trials.trials if trial.noise == noise]


def median_error(maps: Sequence[Map]) -> float:
    """Return the median over draws of how far a map is off [m]."""
    return float(np.median([m.error for m in maps]))


def _median_cost(maps: Sequence[Map]) -> str:
    return cost(float(np.median([m.cost for m in maps])))


def _in_shape(maps: Sequence[Map], bent: float) -> str:
    return f'{sum(m.error < bent for m in maps)} of {len(maps)}'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
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
