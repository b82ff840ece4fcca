# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How often a map was right, beside the confidence in it: the makers' own worlds.

    python benchmarks/robust/verdict.py --datasets DIR [--seeds N] [--drawn N] [--fresh SET...]
        [--only GRAPH...]

Graphs, made and recorded, get lies, slips, drift and misstated noise. A map is wrong where it is
further from the truth than 1.5 times the map of the true loops alone, and 5 cm; where no truth is
known, more than .25 m and .5% of the map's diagonal from that map. The weights are fitted on the
graphs of `FIT` and on worlds that `drawn` draws. The tables count those of `HELD`, of which
nothing was used, and sets of fresh worlds, of other seeds and one kind more. Each table names the
runs that were misjudged, and compares `confidence` as it is with what became of the maps.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# As a program of its own it finds its neighbours.
sys.path.insert(0, str(Path(__file__).parents[1]))

from measuring import report_progress
from robust import drawn
from robust.changes import changed
from robust.places import Place, error_by_time, place, place_of

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

FIT = ('world', 'sparse', 'intel', 'ring', 'tails')
HELD = ('kitti_00', 'corridor', 'wide', 'fr079', 'manhattan3500', 'bicocca25b')
# What is changed, by `changes.CHANGES`, with its amounts; the lies, and their share.
CONDITIONS: tuple[drawn.Condition, ...] = (
    ('', (), '', 0.0), *(('', (), 'random', share) for share in (0.3, 0.5, 0.7, 0.9)),
    *(('', (), 'identity', share) for share in (0.5, 0.9)),
    *(('', (), 'grouped', share) for share in (0.3, 0.5, 0.7)),
    *(('slip', (what, count), 'random', 0.3)
      for what in ('translation', 'rotation') for count in (1, 2)),
    ('odometry', (3.0,), 'random', 0.3), ('odometry', (10.0,), 'random', 0.3),
    *(('information', (part, times), 'random', 0.3)
      for part in ('odometry', 'loops') for times in (1e-2, 1e2)),
    ('thinned', (0.1,), 'random', 0.5), ('thinned', (0.3,), 'random', 0.5),
    ('aliased', (3, 'own'), '', 0.0), ('aliased', (3, 'same'), '', 0.0),
    ('half aliased', (12,), '', 0.0), ('drift', (0.01,), 'random', 0.3),
    ('drift', (0.05,), 'random', 0.3))
_EDGES = (0.0, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Row:
    """
    One run.

    graph : its name, of a drawn world behind that of its set; asked : its seed and what was made
    wrong in it; confidence : of the map; wrong : whether the map was; doubts : their kinds.
    """

    graph: str
    asked: str
    confidence: float
    wrong: bool
    doubts: frozenset[str]

    @property
    def doubted(self) -> bool:
        """Whether the map is doubtful."""
        return bool(self.doubts)


def _ring(seed: int, tails: bool = False) -> Place:
    """Return a lap, not quite round, closed at the place where it began."""
    rng = np.random.default_rng(100 + seed)
    n, loops = int(rng.integers(300, 900)), int(rng.integers(10, 40))
    angle = 2 * np.pi * np.arange(n + loops) / n
    radius = n / 6.3 * (1 + rng.uniform(0, 0.3) * np.sin(rng.integers(2, 6) * angle))
    way = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    along = np.gradient(way, axis=0)
    truth = np.column_stack((way, np.unwrap(np.arctan2(along[:, 1], along[:, 0]))))
    back = np.arange(loops)
    return drawn.of_truth(truth, back, back + n, (0.05, 0.05, 0.003), (0.1, 0.1, 0.02), rng, tails)


def _corridor(seed: int, tails: bool = False) -> Place:
    """Return a way along corridors and back, with loops of the way back."""
    rng = np.random.default_rng(200 + seed)
    length, legs = int(rng.integers(40, 90)), int(rng.integers(2, 5))
    heading = np.repeat(np.cumsum(np.pi / 2 * rng.choice([-1, 1], legs)), length)
    there = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    back = there[::-1] + rng.normal(0, 0.2, there.shape)
    truth = np.column_stack((np.concatenate((there, back)), np.unwrap(
        np.concatenate((heading, heading[::-1] + np.pi)))))
    first = rng.choice(len(there) - 10, max(12, len(there) // 6), replace=False)
    return drawn.of_truth(truth, first, len(truth) - 1 - first, (0.05, 0.05, 0.005),
                          (0.3, 0.1, 0.02), rng, tails)


def _world(poses: int, loops: int, options: WorldOptions, seed: int) -> Place:
    world = simulate_world(poses, poses - 1 + loops, options, np.random.default_rng(seed))
    return place_of('made', world.graph, None, error_by_time(world.truth[:, :2]))


MADE: dict[str, Callable[[int], Place]] = {
    'world': lambda seed: _world(500, 109, WorldOptions(), seed),
    'sparse': lambda seed: _world(400, 30, WorldOptions(odometry_sigma_rotation=0.004),
                                  1000 + seed),
    'wide': lambda seed: _world(900, 250, WorldOptions(
        block=12, odometry_sigma_rotation=0.02, loop_sigma_translation=0.2,
        loop_sigma_rotation=0.03), 2000 + seed),
    'ring': _ring, 'corridor': _corridor,
    'tails': lambda seed: (_ring if seed % 2 else _corridor)(50 + seed, True)}


# Kinds of drawn worlds. The first number of a seed is that of its set: weights are fitted on the
# first, the others are fresh. Rules were made with a look at the second to the twelfth.
_DRAWN: dict[str, Callable[[np.random.Generator], Place]] = {
    'streets': drawn.streets, 'laps': drawn.laps, 'spokes': drawn.spokes, 'lawn': drawn.lawn,
    'rings': lambda rng: _ring(int(rng.integers(10**6)), rng.random() < 0.3),
    'corridors': lambda rng: _corridor(int(rng.integers(10**6)), rng.random() < 0.3)}
FITTED = 1
_LOOKED_AT = 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14
_NEVER_SEEN = 15


def runs_drawn(base: int, count: int) -> Iterator[Row]:
    """Yield what became of worlds that are drawn; base : the number of their set."""
    for name, found, asked, rng, seed in worlds_drawn(base, count):
        report_progress(f'{name} seed {seed} of {base}: {asked}')
        with suppress(GraphError):  # no room for so many lies
            yield run(f'{_set(base)}{name}', found, asked, rng, seed)


def worlds_drawn(base: int, count: int) -> Iterator[
        tuple[str, Place, drawn.Condition, np.random.Generator, int]]:
    """Yield worlds, each with its kind, what is made wrong in it, by which generator, its seed."""
    for number, (name, world) in enumerate(_DRAWN.items()):
        for seed in range(count) if base != FITTED or name != 'lawn' else ():
            rng = np.random.default_rng((base, number, seed))
            found, asked = world(rng), drawn.condition(rng, name == 'rings')
            yield name, found, asked, np.random.default_rng((seed, 0, number)), seed


def _set(base: int) -> str:
    return '' if base == FITTED else f'FRESH {base}: '


def run_one(name: str, found: Place, condition: int, seed: int) -> Row:
    """Return what became of the map of a graph in one of `CONDITIONS`."""
    return run(name, found, CONDITIONS[condition], generator(name, condition, seed), seed)


def generator(name: str, condition: int, seed: int) -> np.random.Generator:
    """Return what draws the lies of a graph in one of `CONDITIONS`."""
    return np.random.default_rng((seed, condition, (FIT + HELD).index(name)))


def run(name: str, found: Place, condition: drawn.Condition, rng: np.random.Generator,
        seed: int) -> Row:
    """Return what became of the map of a graph in which something is made wrong."""
    graph, best = made_wrong(found, condition, rng)
    row, _ = judged(name, found, graph, best, f'seed {seed} {condition}')
    return row


def made_wrong(found: Place, condition: drawn.Condition,
               rng: np.random.Generator) -> tuple[FactorGraph, Array]:
    """Return a graph in which something is made wrong, and positions (n, 2) by its true loops."""
    change, amounts, lies, share = condition
    what = changed(found, change, amounts, rng)
    graph, clean = what.graph, what.clean
    if lies:
        count = np.count_nonzero(~graph.between.is_odometry) * share / (1 - share)
        graph = insert_loops(graph, FALSE_LOOPS[lies](graph, found.best, round(count), rng))
    if what.lies is not None:
        graph = insert_loops(graph, what.lies)
    if found.is_false.any():
        clean = found.graph.subset(~found.is_false)
    return graph, solve(clean, None, SolveOptions(robust=False)).solution.poses[:, :2]


def judged(name: str, found: Place, graph: FactorGraph, best: Array,
           asked: str) -> tuple[Row, Judgement]:
    """Return what became of the map of a graph, see `made_wrong`, and its judgement."""
    outcome = solve(graph, None, SolveOptions(robust=True))
    judgement, poses = outcome.judgement, outcome.solution.poses[:, :2]
    assert judgement is not None
    return Row(name, asked, judgement.confidence, _is_wrong(found, poses, best),
               frozenset(doubt.kind for doubt in judgement.doubts)), judgement


def _is_wrong(found: Place, positions: Array, best: Array) -> bool:
    if found.truth_error is not None:
        return found.truth_error(positions) > 1.5 * found.truth_error(best) + 0.05
    diagonal = np.linalg.norm(np.ptp(best, axis=0))
    return bool(absolute_trajectory_error(positions, best) > max(0.25, 0.005 * diagonal))


def _tell(name: str, rows: list[Row]) -> None:
    """Print how often some runs were said to be right and were, and which were misjudged."""
    wrong, doubted = (np.array([getattr(row, what) for row in rows])
                      for what in ('wrong', 'doubted'))
    count = len(rows)
    print(f'\n{name}: {count} runs; right {(~wrong & ~doubted).sum()}, right and doubted '
          f'{(~wrong & doubted).sum()}, wrong and said {(wrong & doubted).sum()}, wrong and '
          f'silent {(wrong & ~doubted).sum()}\nof the wrong {_share(doubted[wrong])} are said, of '
          f'the right {_share(~doubted[~wrong])} are not doubted, of all '
          f'{_share(wrong & ~doubted)} are wrong and silent\n')
    for row in rows:
        if row.wrong != row.doubted:
            print('  wrong and silent:' if row.wrong else '  right and doubted:', row.graph,
                  row.asked, ', '.join(sorted(row.doubts)))
    print('\n| confidence | runs | said | right |\n|---|---|---|---|')
    off = 1 - np.array([row.confidence for row in rows])
    for low, high in zip(_EDGES, _EDGES[1:], strict=False):
        among = (off >= low) & (off < high)
        if among.any():
            print(f'| {1 - high:.2f} to {1 - low:.2f} | {among.sum()} | '
                  f'{1 - off[among].mean():.3f} | {1 - wrong[among].mean():.3f} |')


def _share(some: Array) -> str:
    return f'{some.mean():.1%}' if len(some) else 'none'


def main() -> int:
    """Run, fit and count."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--seeds', type=int, default=3, help='of graphs that are made')
    parser.add_argument('--drawn', type=int, default=30, help='worlds of each kind')
    parser.add_argument('--fresh', type=int, nargs='*', default=(*_LOOKED_AT, _NEVER_SEEN),
                        help='the numbers of sets of fresh worlds, from 2 on')
    parser.add_argument('--only', nargs='+', choices=FIT + HELD, default=FIT + HELD)
    given = parser.parse_args()
    rows = [row for base in (FITTED, *given.fresh)
            for row in runs_drawn(base, given.drawn)]
    for name in given.only:
        for seed in range(given.seeds if name in MADE else 1):
            found = MADE[name](seed) if name in MADE else place(given.datasets, name)
            for condition, (change, amounts, _, share) in enumerate(CONDITIONS):
                # Two steps less leave a lap in two parts.
                if change == 'slip' and amounts[1] == 2 and name in ('ring', 'tails'):
                    continue
                # Takes minutes.
                if share == 0.9 and name == 'bicocca25b':
                    continue
                report_progress(f'{name} seed {seed}: {CONDITIONS[condition]}')
                rows.append(run_one(name, found, condition, seed))
    halves: dict[str, list[Row]] = {'FIT': [], 'HELD': []}
    for row in rows:
        fresh, _, name = row.graph.rpartition(': ')
        halves.setdefault(fresh or ('HELD' if name in HELD else 'FIT'), []).append(row)
    for half, among in halves.items():
        if among:
            _tell(half, among)
    return 0


if __name__ == '__main__':
    sys.exit(main())
