# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The commands of `l1slam` that make graphs: simulate and corrupt."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.cli.commands import Ending, inputs, read
from l1slam_ros.cli.reference import known_false
from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.names import WORLDS
from l1slam_ros.core.robust.batch_map import SolveOptions
from l1slam_ros.core.robust.batch_map import solve as solve_graph
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.worlds.simulate import World, WorldOptions, simulate_world, with_false_loops
from l1slam_ros.io import formats
from l1slam_ros.io.files import put_lines, replacing
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.side_files import beside, pair_lines
from l1slam_ros.io.ours import marked
from l1slam_ros.io.progress import Progress
from l1slam_ros.io.trajectory import truth_lines

if TYPE_CHECKING:
    from l1slam_ros.core.scans.points import Scan


def simulate(arguments: argparse.Namespace) -> Ending:
    """Make a world and write its graph, its truth and which of its loops are false."""
    _check(arguments, (), ('truth', 'false'))
    _check_scans(arguments)
    output = arguments.output
    rng = np.random.default_rng(arguments.seed)
    world = simulate_world(arguments.poses, arguments.edges, WorldOptions(), rng, arguments.world)
    if arguments.false_loops:
        make = FALSE_LOOPS[arguments.kind]
        world = with_false_loops(world, make(world.graph, world.truth, arguments.false_loops, rng))
    ids = np.arange(world.graph.n_poses)
    record = GraphRecord(world.graph, world.odometry, ids)
    # Drawn after all that the world itself is drawn of: it is the same world without.
    seen = _scans(world, record, rng) if arguments.scans else []
    with replacing(beside(output, 'truth')) as temporary:
        put_lines(temporary, marked(truth_lines(ids, world.truth)))
        _write(output, world.false_loops, lambda: formats.write_output(
            output, record, world.truth, arguments.force, seen))
    return Ending()


def _scans(world: World, record: GraphRecord, rng: np.random.Generator) -> 'list[Scan]':
    # It takes the compiled core along, which nothing else here needs.
    from l1slam_ros.core.worlds.houses import scans_of_streets

    return scans_of_streets(world.truth, record.times, WorldOptions(), rng)


def _check_scans(arguments: argparse.Namespace) -> None:
    """Refuse scans where no laser can be simulated, or no file has a place for them."""
    if arguments.scans and arguments.world != WORLDS[0]:
        raise OptionError(f'--scans in the world {arguments.world}, expected {WORLDS[0]}')
    if arguments.scans and arguments.output.suffix:
        raise FileError(arguments.output, 'holds no scans; expected no suffix, for a bag')


def corrupt(arguments: argparse.Namespace) -> Ending:
    """
    Add false loops to a graph.

    What is far apart is judged on the L2 map, solved from the graph alone: a stored start may be
    raw odometry, whose drift makes places look far apart that are the same, and a 'false' loop
    between them would be true. False loops that are known already are left out of that map.
    """
    _check(arguments, inputs(arguments), ('false',))
    record = read(arguments, arguments.input)
    former = known_false(arguments.input, record)
    believed = record.graph.subset(~former)
    options = LeastSquaresOptions()
    with (formats.named(arguments.input),
          Progress(options.iterations, 'step', label='solving') as progress):
        solution = solve_graph(
            believed, record.poses, SolveOptions(norm='l2', robust=False, least_squares=options),
            progress.report, ids=record.ids).solution
    loops = FALSE_LOOPS[arguments.kind](record.graph, solution.poses, arguments.false_loops,
                                        np.random.default_rng(arguments.seed))
    pairs: Indices = np.concatenate((record.graph.between.pairs[former],
                                     np.stack((loops.i, loops.j), axis=1)))
    # All its loops are to be doubted again; comments stand between others now.
    spoiled = formats.with_poses(replace(record, graph=insert_loops(record.graph, loops),
                                         left_out=None, comments=(), drift=0.0, log=None))
    # A bag has no vertex ids: read back, it counts its keyframes from 0.
    ids = record.ids[pairs] if arguments.output.suffix else pairs
    with formats.named(arguments.input):
        _write(arguments.output, ids, lambda: formats.write_output(
            arguments.output, spoiled, force=arguments.force))
    return Ending(record.damage)


def _check(arguments: argparse.Namespace, read: Sequence[Path], also: tuple[str, ...]) -> None:
    """Refuse, before any work is done, an output that holds no graph, and counts below 0."""
    formats.check_graph_output(arguments.output, read, arguments.force, also)
    for name in ('seed', 'false_loops'):
        value = getattr(arguments, name)
        if value < 0:
            raise OptionError(f'--{name.replace("_", "-")} is {value}, expected 0 or more')


def _write(output: Path, pairs: Indices, write_graph: Callable[[], None]) -> None:
    """Write a graph and its file of false loops, pairs (k, 2) of ids, both or neither."""
    with replacing(beside(output, 'false')) as temporary:
        put_lines(temporary, marked(pair_lines(pairs)))
        write_graph()
