# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The figures of the report: each runs its experiment, draws into a folder and returns its lines.

In: the graphs that there are. Out: .png files with their numbers, and Markdown that shows them.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.alignment import aligned_positions
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.io.formats import named
from l1slam_ros.io.plot import Curve, MapDrawing, plot_curves, plot_maps
from l1slam_ros.io.progress import Progress
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import measure_convergence, printed_costs
from l1slam_ros.paper.report import WORLD_SEED, Study, cost
from l1slam_ros.paper.runs import LyingLoops, off, run_false_loops, run_noisy_start
from l1slam_ros.paper.updates import measure_growth

_CURVES = ('The paper shows 100,000 iterations of the angle and translation problems, 10,000 '
           'linearisations of the global one. *Weighted*: with the primal weight; *fused*: the '
           'compiled, restarted form.')
_START = ('Every stored pose moved at random, by the least of some standard deviations from which '
          'L2 does not recover. The seed, then Algorithm 4 as printed: L1 cost {cost}.')
_UPDATES = ('A simulated world in the proportions of City10k (seed {seed}), {poses:,} keyframes, '
            'an update after each, at {rate:.0f} keyframes per second. Ours is L1 and doubts '
            'every loop; *batch L2* solves all that has come anew, from the map as it is, at some '
            'sizes. Milliseconds of the processor; what our other threads took behind, '
            '{behind:.1f} s in all, not among them.')
# Of so many updates one after the other the median and the 95th percentile are drawn.
_WINDOWS = 40
_LIES = ('False loops at random between far poses, as sure as true ones. *Off*: RMSE of the '
         'positions from the map of L1 without them, aligned.')


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
    return lines


def figure_3(study: Study, folder: Path) -> list[str]:
    """Draw the maps that our default solver ended with."""
    maps = {name: (found.graph, found.costs.solution.poses)
            for name, found in study.graphs.items()}
    plot_maps(folder / 'figure_3.png', [_drawing(graph, poses, poses, name)
                                        for name, (graph, poses) in maps.items()])
    return ['The maps that our default solver ended with.', '', '![maps](figure_3.png)']


def figure_4(study: Study, folder: Path) -> list[str]:
    """Draw a start that L2 does not recover from, and what came of it."""
    if paper.NOISY.name not in study.graphs:
        return [f'Not run: it is of {paper.NOISY.name}.']
    found = study.graphs[paper.NOISY.name]
    run = run_noisy_start(found.graph, found.start, np.random.default_rng(WORLD_SEED))
    panels = ((run.start, f'Start: noise of {run.noise:g} m, {run.noise:g} rad', 'start'),
              (run.l2, 'L2 from that start', 'optimised'),
              (run.seed, 'Seed (reads no start)', 'seed'), (run.l1, 'Seed, then L1', 'optimised'))
    plot_maps(folder / 'figure_4.png', [_drawing(found.graph, poses, run.l1, title, name=name)
                                        for poses, title, name in panels])
    as_in_paper = replace(study.effort, outer=paper.NOISY_OUTER, inner=paper.NOISY_INNER)
    printed = printed_costs(found.graph, run.seed, as_in_paper)[-1]
    return [_START.format(cost=cost(printed)), '',
            '![a noisy start, and the maps made of it](figure_4.png)']


def figure_5(study: Study, folder: Path) -> list[str]:
    """Draw the time of an update over the keyframes that there are."""
    keyframes, rate = study.effort.keyframes, study.effort.rate
    if not keyframes:
        return ['Not run: no keyframes.']
    with Progress(keyframes, 'keyframe') as progress:
        updates, batch = measure_growth(keyframes, rate, np.random.default_rng(WORLD_SEED),
                                        progress.advance)
    sizes = np.array([now.graph.n_poses for now in updates.on_the_way])
    curves = [*_windows('ours', updates.ours), Curve('batch L2', sizes, 1e3 * batch)]
    plot_curves(folder / 'figure_5.png', curves, 'time per update', ('keyframes', 'ms'))
    said = _UPDATES.format(seed=WORLD_SEED, poses=keyframes, rate=keyframes / updates.elapsed,
                           behind=updates.behind)
    return [said, '', '![time per update over keyframes](figure_5.png)']


def _windows(name: str, seconds: Sequence[float]) -> list[Curve]:
    """Return the median and the 95th percentile of updates one after the other."""
    parts = np.array_split(1e3 * np.array(seconds), min(_WINDOWS, len(seconds)))
    ends = np.cumsum([len(part) for part in parts])
    return [Curve(f'{name}, {word}', ends, np.array([np.percentile(part, q) for part in parts]))
            for word, q in (('median', 50), ('95%', 95))]


def figure_6(study: Study, folder: Path) -> list[str]:
    """Draw what the methods make of false loops, one picture for each graph."""
    lines = [_LIES, '']
    graphs = {graph: count for graph, count in paper.FALSE_LOOPS.items()
              if graph.name in study.graphs}
    if not graphs:
        return [f'Not run: it is of {" and ".join(graph.name for graph in paper.FALSE_LOOPS)}.']
    for graph, count in graphs.items():
        of = study.graphs[graph.name]
        with named(graph.file):
            run = run_false_loops(of.graph, of.start, count, np.random.default_rng(WORLD_SEED))
        picture = f'figure_6_{graph.name.lower()}.png'
        plot_maps(folder / picture, _panels(graph.name, of.graph, run))
        lines += [f'![{graph.name} with false loops]({picture})', '']
    return lines[:-1]


def _panels(name: str, clean: FactorGraph, run: LyingLoops) -> list[MapDrawing]:
    """Return the map of a graph without false loops, and what each method makes of them."""
    factors = run.graph.between
    is_true = ~factors.is_odometry & ~run.false
    believed, pairs = run.accepted, factors.pairs

    def drawing(title: str, poses: Array, **loops: Indices) -> MapDrawing:
        return _drawing(run.graph, poses, run.clean, title,
                        note=f'{off(run.graph, poses, run.clean):.2f} m off', **loops)

    every = {'loops': pairs[is_true], 'false': pairs[run.false]}
    return [_drawing(clean, run.clean, run.clean, f'{name} without false loops: L1'),
            drawing('seed alone', run.seed, **every), drawing('seed, then L1', run.l1, **every),
            drawing('Huber, as wide as in g2o', run.huber, **every),
            drawing('l1slam solve', run.robust, loops=pairs[is_true & believed],
                    false=pairs[run.false & believed], rejected=pairs[~believed])]


def _drawing(graph: FactorGraph, poses: Array, reference: Array, title: str,
             **shown: Any) -> MapDrawing:
    """Return the map of poses, laid on a reference, (n, p); its cost and loops, if not `shown`."""
    factors = graph.between
    positions = graph.manifold.positions
    drawn = {'loops': factors.pairs[~factors.is_odometry],
             'note': f'L1 cost {l1_cost(whitened_residual(graph, poses)):.6g}', **shown}
    return MapDrawing(title, aligned_positions(positions(poses), positions(reference)), **drawn)
