# SPDX-License-Identifier: Apache-2.0
"""
The figures of the report: each draws its pictures into a folder and returns the section's lines.

In: what was measured. Out: .png files, and Markdown that shows them and says what is to be seen.
"""

from pathlib import Path

import numpy as np

from l1slam_ros.io.plot import Curve, MapDrawing, plot_curves, plot_maps
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper import report
from l1slam_ros.paper.report import Results, metres
from l1slam_ros.paper.trials import (
    HUBER_OF_G2O,
    HUBER_WIDTHS,
    JOINT,
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

_SHAPE = ('A map *keeps its shape* when that is less than a fiftieth of its diagonal: '
          'more looks bent to the eye.')
_STARTS = ('Every stored pose is moved at random, in position and heading, by these standard '
           'deviations; the numbers are medians of several draws. How much noise the paper added '
           'we do not know. The seed reads no start. *Off our map* is the RMSE of the positions '
           'from those of the seed, then L1, after rigid alignment. *As printed* are '
           f'{paper.NOISY_OUTER} linearisations of {paper.NOISY_INNER} iterations, as in the '
           f'paper. {_SHAPE}')
_LIES = ('The paper draws its seed (Algorithm 3) alone, beside Huber. False loops say that two '
         'poses far from each other are the very same, and are as sure of it as a true loop. The '
         'pairs are drawn at random; the pictures show the first draw. Huber begins at the stored '
         'poses, the other methods read none; its width is where its cost turns from squares to '
         f'lengths, in sigmas ({HUBER_OF_G2O:g} by default in g2o). *{ROBUST}* the paper does not '
         'have. Numbers are the RMSE of the positions, after rigid alignment, from the map that '
         f'the *same method* makes of the graph without false loops. {_SHAPE}')


def figure_2(results: Results, folder: Path) -> list[str]:
    """Draw cost against iterations, one picture for each problem."""
    if not results.convergence:
        return [f'Not run: it is of {paper.MANHATTAN_10K.name}, which `--worlds 10k` makes.']
    lines = [f'Of our world in the place of {paper.MANHATTAN_10K.name}. The paper shows 100,000 '
             'iterations of the angle and translation problems and 10,000 outer ones of 400 for '
             'the global one; how many are shown here is in the table. *Weighted* is with the '
             'primal weight that this package adds, *least squares* its start from reweighted '
             'ones, *fused* the compiled and restarted form. An iteration of the global problem '
             'is one linearisation.', '']
    for problem, methods in results.convergence.items():
        name = f'figure_2_{problem}.png'
        curves = [Curve(method, history[:, 0], history[:, 1])
                  for method, history in methods.items()]
        plot_curves(folder / name, curves, f'{problem} problem, L1 cost')
        lines.append(f'![cost against iterations of the {problem} problem]({name})')
    return [*lines, '', *report.figure_2(results)]


def figure_3(results: Results, folder: Path) -> list[str]:
    """Draw the maps that our default solver ended with."""
    plot_maps(folder / 'figure_3.png', [r.drawing for r in results.graphs])
    return ['The maps that our default solver ended with.', '', '![maps](figure_3.png)']


def figure_4(results: Results, folder: Path) -> list[str]:
    """Draw the first start that L2 does not recover from, and what came of it."""
    trials = results.starts
    if trials is None:
        return [f'Not run: it is of {paper.NOISY.name}.']
    noise = drawn_noise(trials)
    maps = next(trial.maps for trial in trials.trials if trial.noise == noise)
    panels = {(f'Start: noise of {noise:g} m, {noise:g} rad', 'start'): maps[START],
              ('L2 from that start', 'optimised'): maps[L2],
              ('Seed (reads no start)', 'seed'): trials.seed,
              ('Seed, then L1', 'optimised'): trials.solution}
    plot_maps(folder / 'figure_4.png', [
        MapDrawing(title, shown.positions, loops=trials.loops, name=word,
                   note=f'L1 cost {shown.cost:.6g}')
        for (title, word), shown in panels.items()])
    return [_STARTS, '',
            '![a noisy start, and the maps made of it](figure_4.png)', '',
            *report.figure_4(trials)]


def drawn_noise(trials: StartTrials) -> float:
    """Return the least noise that bends the first L2 map of it, the most one if none does."""
    return next((noise for noise in NOISES
                 if report.with_noise(trials, noise, L2)[0].error >= trials.bent), NOISES[-1])


def figure_6(results: Results, folder: Path) -> list[str]:
    """Draw the maps of the first draw, one picture for each graph."""
    if not results.false_loops:
        return [f'Not run: it is of {" and ".join(graph.name for graph in paper.FALSE_LOOPS)}.']
    lines = [_LIES, '']
    for name, trials in results.false_loops.items():
        picture = f'figure_6_{name.lower()}.png'
        plot_maps(folder / picture, _false_loop_panels(name, trials))
        lines += [f'![{name} with false loops]({picture})', '']
    return [*lines, *report.figure_6(results.false_loops)]


def _false_loop_panels(name: str, trials: LoopTrials) -> list[MapDrawing]:
    """Return the clean map, and what each method made of the first draw."""
    first, loops = trials.trials[0], trials.loops
    hubers = dict.fromkeys((best_huber(trials), huber_name(HUBER_OF_G2O)))
    clean = trials.clean[JOINT].positions
    drawings = [MapDrawing(f'{name} without false loops: L1', clean, loops=loops)]
    for method in (SEED, JOINT, *hubers):
        shown = first.maps[method]
        drawings.append(MapDrawing(method, shown.positions, loops=loops, false=first.false,
                                   note=_off(shown)))
    shown, refused = first.maps[ROBUST], np.concatenate((first.refused, first.lost))
    lost = (loops[:, None] == first.lost).all(axis=2).any(axis=1)
    return [*drawings, MapDrawing('l1slam solve', shown.positions, loops=loops[~lost],
                                  rejected=refused, false=first.kept, note=_off(shown))]


def best_huber(trials: LoopTrials) -> str:
    """Return the name of the Huber of least median error, chosen knowing the result."""
    return min(map(huber_name, HUBER_WIDTHS),
               key=lambda name: report.median_error(report.maps_by(trials, name)))


def _off(shown: Map) -> str:
    return f'{metres(shown.error)} off'
