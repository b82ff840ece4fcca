# SPDX-License-Identifier: Apache-2.0
"""
The figures of the report: each runs its experiment, draws into a folder and returns its lines.

In: the graphs that there are. Out: .png files, and Markdown that shows them, their numbers in a
table.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.formats import named
from l1slam_ros.io.plot import Curve, MapDrawing, plot_curves, plot_maps
from l1slam_ros.io.progress import Progress
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import measure_convergence
from l1slam_ros.paper.report import WORLD_SEED, Study, cost, metres, table
from l1slam_ros.paper.runs import (
    HUBER_OF_G2O,
    HUBERS,
    JOINT,
    L1,
    L2,
    NOISES,
    ROBUST,
    SEED,
    START,
    LoopRuns,
    Map,
    StartRuns,
    loops_of,
    run_false_loops,
    run_noisy_starts,
)
from l1slam_ros.paper.updates import Updates, measure_growth, spread

# Within this of the lowest cost of a diagram, a method has arrived.
_ARRIVED = 0.001
_SHAPE = 'A map *keeps its shape* that is less than a fiftieth of its diagonal off.'
_CURVES = ('The paper shows 100,000 iterations of the angle and translation problems, 10,000 '
           'linearisations of the global one. *Weighted*: with the primal weight; *fused*: the '
           'compiled, restarted form.')
_STARTS = ('Every stored pose moved at random by these standard deviations, medians of several '
           f'draws. *Off*: RMSE of the positions from our map, aligned. {_SHAPE}')
_UPDATES = ('A simulated world in the proportions of City10k (seed {seed}), {poses:,} keyframes, '
            'an update after each, at {rate:.0f} keyframes per second. Ours is L1 and doubts '
            'every loop; *ISAM2* is gtsam: L2, every loop believed, linearised again above 0.1; '
            '*batch L2* solves all that has come anew, from the map as it is, at some sizes. '
            'Milliseconds of the processor; what our other threads take is *behind*.')
_NO_PEER = 'Without ISAM2: gtsam is not installed (`pip install gtsam`).'
# Of so many updates one after the other the median and the 95th percentile are drawn.
_WINDOWS = 40
_LIES = ('False loops at random between far poses, as sure as true ones; the pictures show the '
         'first draw. *Off*: RMSE of the positions from the map that the same method makes '
         f'without them, aligned. {_SHAPE}')


def figure_2(study: Study, folder: Path) -> list[str]:
    """Draw cost against iterations, one picture for each problem."""
    name = paper.MANHATTAN_10K.name
    if name not in study.graphs:
        return [f'Not run: it is of {name}, which `--worlds 10k` makes.']
    world = study.graphs[name]
    curves = measure_convergence(world.graph, world.start, world.seed, study.effort.iterations)
    steps = {'as printed': world.costs.printed,
             f'ours, {world.costs.solver}': world.costs.solution.history}
    curves['global'] = {method: np.stack((np.arange(len(costs)), costs), axis=1)
                        for method, costs in steps.items()}
    lines = [_CURVES, '']
    for problem, methods in curves.items():
        picture = f'figure_2_{problem}.png'
        plot_curves(folder / picture, [Curve(method, history[:, 0], history[:, 1])
                                       for method, history in methods.items()],
                    f'{problem} problem, L1 cost')
        lines.append(f'![cost against iterations of the {problem} problem]({picture})')
    return [*lines, '', *table_of_curves(curves)]


def table_of_curves(curves: dict[str, dict[str, Array]]) -> list[str]:
    """Return where each method begins, ends and arrives; by problem and method."""
    rows = []
    for problem, methods in curves.items():
        lowest = min(history[:, 1].min() for history in methods.values())
        rows += [[problem, method, f'{history[-1, 0]:,.0f}', cost(history[0, 1]),
                  cost(history[-1, 1]), f'{history[-1, 1] / lowest - 1:.2%}',
                  _arrival(history, (1 + _ARRIVED) * lowest)]
                 for method, history in methods.items()]
    return table(['problem', 'method', 'iterations', 'cost at first', 'at last',
                  'above the lowest', f'within {_ARRIVED:.1%} of it from'], rows, words=2)


def _arrival(history: Array, bound: float) -> str:
    """Return the iteration from which on a cost stays within a bound."""
    outside = np.flatnonzero(history[:, 1] > bound)
    first = outside[-1] + 1 if len(outside) else 0
    return f'{history[first, 0]:,.0f}' if first < len(history) else 'not reached'


def figure_3(study: Study, folder: Path) -> list[str]:
    """Draw the maps that our default solver ended with."""
    plot_maps(folder / 'figure_3.png', [MapDrawing(
        name, found.graph.manifold.positions(found.costs.solution.poses),
        loops=loops_of(found.graph), note=f'L1 cost {found.costs.solution.cost:.6g}')
        for name, found in study.graphs.items()])
    return ['The maps that our default solver ended with.', '', '![maps](figure_3.png)']


def figure_4(study: Study, folder: Path) -> list[str]:
    """Draw the first start that L2 does not recover from, and what came of it."""
    if paper.NOISY.name not in study.graphs:
        return [f'Not run: it is of {paper.NOISY.name}.']
    found, effort = study.graphs[paper.NOISY.name], study.effort
    as_in_paper = replace(effort, outer=paper.NOISY_OUTER, inner=paper.NOISY_INNER)
    with Progress(len(NOISES) * effort.draws, 'start') as progress:
        runs = run_noisy_starts(found.graph, found.start, effort, as_in_paper,
                                np.random.default_rng(WORLD_SEED), progress.advance)
    noise = drawn_noise(runs)
    maps = runs.noisy[noise][0]
    panels = {(f'Start: noise of {noise:g} m, {noise:g} rad', 'start'): maps[START],
              ('L2 from that start', 'optimised'): maps[L2],
              ('Seed (reads no start)', 'seed'): runs.from_seed[START],
              ('Seed, then L1', 'optimised'): runs.from_seed[L1]}
    plot_maps(folder / 'figure_4.png', [
        MapDrawing(title, shown.positions, loops=loops_of(found.graph), name=word,
                   note=f'L1 cost {shown.cost:.6g}') for (title, word), shown in panels.items()])
    return [_STARTS, '', '![a noisy start, and the maps made of it](figure_4.png)', '',
            *table_of_starts(runs)]


def drawn_noise(runs: StartRuns) -> float:
    """Return the least noise that bends the first L2 map of it, the most one if none does."""
    return next((noise for noise in NOISES if runs.noisy[noise][0][L2].error >= runs.bent),
                NOISES[-1])


def table_of_starts(runs: StartRuns) -> list[str]:
    """Return what comes of noisy starts, and of the seed in their place."""
    header = ['start', 'its L1 cost']
    for method in (L2, L1):
        header += [f'{method} from it: L1 cost', f'{method}: off our map',
                   f'{method}: keeps the shape']
    draws = {f'noise of {noise:g} m, {noise:g} rad': maps for noise, maps in runs.noisy.items()}
    rows = []
    for start, found in {**draws, 'the seed (Algorithm 3)': [runs.from_seed]}.items():
        row = [start, _median_cost(maps[START] for maps in found)]
        for method in (L2, L1):
            of_method = [maps[method] for maps in found]
            row += [_median_cost(of_method), metres(_median_error(of_method)),
                    _in_shape(of_method, runs.bent)]
        rows.append(row)
    rows.append(['the seed, then as printed', cost(runs.printed[0]), '', '', '',
                 cost(runs.printed[-1]), '', ''])
    return table(header, rows)


def figure_5(study: Study, folder: Path) -> list[str]:
    """Draw the time of an update over the keyframes that there are, with a table."""
    keyframes, rate = study.effort.keyframes, study.effort.rate
    if not keyframes:
        return ['Not run: no keyframes.']
    with Progress(keyframes, 'keyframe') as progress:
        updates, batch = measure_growth(keyframes, rate, np.random.default_rng(WORLD_SEED),
                                        progress.advance)
    sizes = np.array([now.graph.n_poses for now in updates.on_the_way])
    curves = [*_windows('ours', updates.ours), *_windows('ISAM2', updates.peer),
              Curve('batch L2', sizes, 1e3 * batch)]
    plot_curves(folder / 'figure_5.png', curves, 'time per update', ('keyframes', 'ms'))
    said = _UPDATES.format(seed=WORLD_SEED, poses=keyframes, rate=keyframes / updates.elapsed)
    return [said, *([] if updates.peer else ['', _NO_PEER]), '',
            '![time per update over keyframes](figure_5.png)', '',
            *table_of_updates(updates, batch)]


def _windows(name: str, seconds: Sequence[float]) -> list[Curve]:
    """Return the median and the 95th percentile of updates one after the other."""
    if not seconds:
        return []
    parts = np.array_split(1e3 * np.array(seconds), min(_WINDOWS, len(seconds)))
    ends = np.cumsum([len(part) for part in parts])
    return [Curve(f'{name}, {word}', ends, np.array([np.percentile(part, q) for part in parts]))
            for word, q in (('median', 50), ('95%', 95))]


def table_of_updates(updates: Updates, batch: Array) -> list[str]:
    """Return what updates cost, of each method; batch : (k,) [s]."""
    header = ['ms per update', 'median', '95%', '99%', 'most', '95% of the second quarter',
              'of the last', 'all [s]', 'behind [s]']
    rows = []
    for name, seconds, behind in (('ours', updates.ours, f'{updates.behind:.1f}'),
                                  ('ISAM2', updates.peer, ''), ('batch L2', batch.tolist(), '')):
        if len(seconds):
            of = spread(seconds)
            rows.append([name, *(f'{of[key]:.2f}' for key in (
                'median', 'p95', 'p99', 'max', 'second', 'last')), f'{of["total"]:.1f}', behind])
    return table(header, rows)


def figure_6(study: Study, folder: Path) -> list[str]:
    """Draw the maps of the first draw, one picture for each graph."""
    lines, found = [_LIES, ''], {}
    for graph, count in paper.FALSE_LOOPS.items():
        if graph.name not in study.graphs:
            continue
        of, effort = study.graphs[graph.name], study.effort
        with named(graph.file), Progress(1 + effort.draws, 'draw') as progress:
            runs = run_false_loops(of.graph, of.start, count, effort,
                                   np.random.default_rng(WORLD_SEED), progress.advance)
        found[graph.name] = runs
        picture = f'figure_6_{graph.name.lower()}.png'
        plot_maps(folder / picture, _false_loop_panels(graph.name, runs))
        lines += [f'![{graph.name} with false loops]({picture})', '']
    if not found:
        return [f'Not run: it is of {" and ".join(graph.name for graph in paper.FALSE_LOOPS)}.']
    return [*lines, *table_of_methods(found), '', *table_of_refused(found)]


def _false_loop_panels(name: str, runs: LoopRuns) -> list[MapDrawing]:
    """Return the clean map, and what each method made of the first draw."""
    first, loops = runs.runs[0], runs.loops
    false = np.concatenate((first.refused, first.kept))
    hubers = dict.fromkeys((best_huber(runs), HUBER_OF_G2O))
    drawings = [MapDrawing(f'{name} without false loops: L1', runs.clean[JOINT].positions,
                           loops=loops)]
    drawings += [MapDrawing(method, first.maps[method].positions, loops=loops, false=false,
                            note=f'{metres(first.maps[method].error)} off')
                 for method in (SEED, JOINT, *hubers)]
    shown, lost = first.maps[ROBUST], (loops[:, None] == first.lost).all(axis=2).any(axis=1)
    return [*drawings, MapDrawing(
        'l1slam solve', shown.positions, loops=loops[~lost], false=first.kept,
        rejected=np.concatenate((first.refused, first.lost)), note=f'{metres(shown.error)} off')]


def best_huber(runs: LoopRuns) -> str:
    """Return the name of the Huber of least median error, chosen knowing the result."""
    return min(HUBERS, key=lambda name: _median_error([run.maps[name] for run in runs.runs]))


def table_of_methods(false_loops: dict[str, LoopRuns]) -> list[str]:
    """Return what every method makes of loops that lie; by name of the graph."""
    header = ['off its own clean map']
    for name in false_loops:
        header += [f'{name}: median', f'{name}: lowest to highest', f'{name}: keeps the shape']
    rows = []
    for method in (SEED, JOINT, *HUBERS, ROBUST):
        row = [method]
        for runs in false_loops.values():
            maps = [run.maps[method] for run in runs.runs]
            errors = [shown.error for shown in maps]
            row += [metres(_median_error(maps)), f'{min(errors):.2f} to {metres(max(errors))}',
                    _in_shape(maps, runs.bent)]
        rows.append(row)
    return table(header, rows)


def table_of_refused(false_loops: dict[str, LoopRuns]) -> list[str]:
    """Return which loops were refused; by name of the graph."""
    header = [ROBUST, 'true loops', 'false loops', 'draws', 'loses its shape at',
              'false loops refused', 'true factors refused']
    rows = []
    for name, of in false_loops.items():
        refused = sum(len(run.refused) for run in of.runs)
        false = refused + sum(len(run.kept) for run in of.runs)
        rows.append([name, f'{len(of.loops):,}', f'{false // len(of.runs)}', f'{len(of.runs)}',
                     metres(of.bent), f'{refused} of {false}',
                     f'{sum(len(run.lost) for run in of.runs)}'])
    return table(header, rows)


def _median_error(maps: Sequence[Map]) -> float:
    return float(np.median([shown.error for shown in maps]))


def _median_cost(maps: Iterable[Map]) -> str:
    return cost(float(np.median([shown.cost for shown in maps])))


def _in_shape(maps: Sequence[Map], bent: float) -> str:
    return f'{sum(shown.error < bent for shown in maps)} of {len(maps)}'
