# SPDX-License-Identifier: Apache-2.0
"""Figures 4 and 6 of the report in numbers, and the sentences that these numbers make."""

from collections.abc import Iterator, Sequence

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.markdown import bullets, cost, listed, metres, table
from l1slam_ros.paper.trials import (
    HUBER_OF_G2O,
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

_SHAPE = ('A map *keeps its shape* when that is less than a fiftieth of its diagonal: '
          'more looks bent to the eye.')


def figure_4(trials: StartTrials) -> list[str]:
    """Return what comes of noisy starts, and what it says."""
    header = ['noise on each pose', 'start: L1 cost', 'L2 from it: L1 cost',
              'L2: off our map', 'L2: keeps the shape', 'L1 from it, no seed: L1 cost',
              'L1, no seed: off our map', 'L1, no seed: keeps the shape', '**seed, then L1**']
    rows = []
    for noise in NOISES:
        of = {method: _with_noise(trials, noise, method) for method in (START, L2, L1)}
        row = [f'{noise:g} m, {noise:g} rad', cost(_median_cost(of[START]))]
        for method in (L2, L1):
            row += [cost(_median_cost(of[method])), metres(_median_error(of[method])),
                    _count(of[method], trials.bent)]
        rows.append([*row, f'**{cost(trials.solution.cost)}**'])
    return [*table(header, rows), '', *bullets(_on_starts(trials))]


def _on_starts(trials: StartTrials) -> Iterator[str]:
    final = trials.solution.cost
    yield ('The seed (Algorithm 3) reads no start, so under any noise it has the L1 cost '
           f'{cost(trials.seed.cost)}, and L1 from it {cost(final)}: our map of Table I.')
    yield (f'From the seed, as the paper did it ({paper.NOISY_OUTER} linearisations of '
           f'{paper.NOISY_INNER} iterations), Algorithm 4 as printed ends at '
           f'{cost(trials.printed[-1])}.')
    for method, name in ((L2, 'L2'), (L1, 'L1 without the seed')):
        yield f'{name} from the noisy start {_on_noises(trials, method)}.'
    yield _on_picture_4(trials)


def _on_noises(trials: StartTrials, method: str) -> str:
    counts = [(noise, _held(_with_noise(trials, noise, method), trials.bent))
              for noise in NOISES]
    good = [f'{noise:g}' for noise, held in counts if held.all()]
    bad = [f'in {_of(held)} with {noise:g}' for noise, held in counts if not held.all()]
    every = [f'in every draw with noise of {listed(good)} m and rad'] if good else []
    return f'keeps the shape {listed([*every, *bad])}'


def _on_picture_4(trials: StartTrials) -> str:
    """Tell whether the paper's claim holds, and how much of it is the seed's doing."""
    l2_fails = not all(_held(_with_noise(trials, noise, L2), trials.bent).all()
                       for noise in NOISES)
    claim = ('**Borne out**: the seed and L1 find the map where Gauss-Newton (L2) from a very '
             'noisy start does not.' if l2_fails else
             '**Not borne out**: Gauss-Newton (L2) finds the map from every start that was tried.')
    keeps = 'keeps' if trials.l2.error < trials.bent else 'loses'
    return (f'{claim} How much of this the seed does: L2 from the same seed {keeps} the shape, '
            f'{metres(trials.l2.error)} off our map at the L1 cost {cost(trials.l2.cost)}.')


def figure_6(trials: dict[str, LoopTrials]) -> list[str]:
    """Return what comes of loops that lie, and what it says; trials : by name of the graph."""
    header = ['off its own clean map']
    for name in trials:
        header += [f'{name}: median', f'{name}: lowest to highest', f'{name}: keeps the shape']
    rows = []
    for method in (SEED, JOINT, *map(huber_name, HUBER_WIDTHS), ROBUST):
        row = [method]
        for of_graph in trials.values():
            maps = maps_by(of_graph, method)
            errors = [m.error for m in maps]
            row += [metres(_median_error(maps)), f'{min(errors):.2f} to {metres(max(errors))}',
                    _count(maps, of_graph.bent)]
        rows.append(row)
    sentences = (sentence for item in trials.items() for sentence in _on_loops(*item))
    return [*table(header, rows), '', *bullets(sentences)]


def intro_4() -> str:
    """Return what Figure 4 is about, for whoever has not read the paper."""
    return ('Every stored pose is moved at random, in position and heading, by the standard '
            'deviations in the first column; the numbers are medians of several draws. How much '
            'noise the paper added we do not know. *Off our map* is the RMSE of the positions '
            f'from those of seed, then L1, after rigid alignment. {_SHAPE}')


def intro_6(trials: dict[str, LoopTrials]) -> str:
    """Return what Figure 6 is about, for whoever has not read the paper."""
    graphs = [f'{len(of.trials[0].false)} in {name} ({len(of.loops):,} true loops; it loses its '
              f'shape at {metres(of.bent)})' for name, of in trials.items()]
    draws = len(next(iter(trials.values())).trials)
    iterations = LeastSquaresOptions().iterations
    return ('The paper draws its seed (Algorithm 3) alone, beside Huber. False loops say that two '
            'poses far from each other are the very same, and are as sure of it as a true loop: '
            f'{listed(graphs)}. The pairs are drawn at random, {draws} times; the pictures show '
            'the first draw. Huber begins at the stored poses, the other methods read none; its '
            'width is where its cost turns from squares to lengths, in sigmas '
            f'({HUBER_OF_G2O:g} by default in g2o), and it takes {iterations} iterations at most. '
            'Numbers are the RMSE of the positions, after rigid alignment, from the map that the '
            f'*same method* makes of the graph without false loops. {_SHAPE}')


def _on_loops(name: str, trials: LoopTrials) -> Iterator[str]:
    """Compare the methods on one graph; what the paper shows there is its seed beside Huber."""
    seed, held = maps_by(trials, SEED), _held(maps_by(trials, SEED), trials.bent)
    yield (f'{name}: that the seed alone survives is **{_verdict(held)}**: it keeps the shape in '
           f'{_of(held)} draws, {metres(_median_error(seed))} off at the median and '
           f'{metres(max(m.error for m in seed))} at worst.')
    best = maps_by(trials, best_huber(trials))
    better = _median_error(seed) < _median_error(best)
    yield (f'{name}: that it does better than Huber is **{"" if better else "not "}borne out** '
           f'against the width that turns out best, {best_huber(trials).split()[-1]}: '
           f'{metres(_median_error(best))}, in shape in {_count(best, trials.bent)}; '
           f'{_against_hubers(trials, _median_error(seed))}.')
    joint = maps_by(trials, JOINT)
    yield (f'{name}: L1 over the whole graph, from that seed, is {metres(_median_error(joint))} '
           f'off, in shape in {_count(joint, trials.bent)}. The norm alone refuses no loop.')
    yield _on_robust(name, trials)


def _verdict(held: Array) -> str:
    if held.all():
        return 'borne out'
    return 'borne out in part' if held.any() else 'not borne out'


def _against_hubers(trials: LoopTrials, seed: float) -> str:
    beaten = [f'{width:g}' for width in HUBER_WIDTHS
              if _median_error(maps_by(trials, huber_name(width))) > seed]
    return f'the seed beats widths {listed(beaten)}' if beaten else 'the seed beats no width'


def _on_robust(name: str, trials: LoopTrials) -> str:
    maps = maps_by(trials, ROBUST)
    false = sum(len(trial.false) for trial in trials.trials)
    kept = sum(len(trial.kept) for trial in trials.trials)
    lost = sum(len(trial.lost) for trial in trials.trials)
    return (f'{name}: {ROBUST}, which the paper does not have, keeps the shape in '
            f'{_count(maps, trials.bent)}, {metres(max(m.error for m in maps))} off at worst; of '
            f'{false} false loops in all draws it refused {false - kept}, of the true factors '
            f'{lost}.')


def maps_by(trials: LoopTrials, method: str) -> list[Map]:
    """Return the maps of one method, a draw each."""
    return [trial.maps[method] for trial in trials.trials]


def best_huber(trials: LoopTrials) -> str:
    """Return the name of the Huber of least median error, chosen knowing the result."""
    return min(map(huber_name, HUBER_WIDTHS),
               key=lambda name: _median_error(maps_by(trials, name)))


def drawn_noise(trials: StartTrials) -> float:
    """Return the least noise that bends the first L2 map of it, the most one if none does."""
    return next((noise for noise in NOISES
                 if not _held(_with_noise(trials, noise, L2), trials.bent)[0]), NOISES[-1])


def _with_noise(trials: StartTrials, noise: float, method: str) -> list[Map]:
    return [trial.maps[method] for trial in trials.trials if trial.noise == noise]


def _held(maps: Sequence[Map], bent: float) -> Array:
    return np.array([m.error < bent for m in maps])


def _count(maps: Sequence[Map], bent: float) -> str:
    return _of(_held(maps, bent))


def _of(held: Array) -> str:
    return f'{held.sum()} of {len(held)}'


def _median_error(maps: Sequence[Map]) -> float:
    return float(np.median([m.error for m in maps]))


def _median_cost(maps: Sequence[Map]) -> float:
    return float(np.median([m.cost for m in maps]))
