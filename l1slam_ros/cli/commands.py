# SPDX-License-Identifier: Apache-2.0
"""The commands of `l1slam` that solve nothing, and what all have in common."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.io import formats
from l1slam_ros.io.bags.topics import Topics
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.side_files import false_loops_path, pair_lines, truth_path


class Ending(NamedTuple):
    """
    What is still to be said when a command has done its work: sentences, empty if there is none.

    damage : what could not be read; doubt : why the map is not to be relied on.
    """

    damage: str = ''
    doubt: str = ''


def convert(arguments: argparse.Namespace) -> Ending:
    """Write what was read in another format."""
    formats.check_output(arguments.output)
    record = read(arguments, arguments.input)
    warn(record.skipped)
    with formats.named(arguments.input):
        formats.write_output(arguments.output, formats.with_poses(record))
    return Ending(record.damage)


def simulate(arguments: argparse.Namespace) -> Ending:
    """Make a world and write its graph, its truth and which of its loops are false."""
    from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
    from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops
    from l1slam_ros.io.bags.from_graph import write_graph_bag
    from l1slam_ros.io.trajectory import write_truth

    check_counts(arguments)
    rng = np.random.default_rng(arguments.seed)
    world = simulate_world(arguments.poses, arguments.edges, WorldOptions(), rng)
    if arguments.false_loops:
        make = FALSE_LOOPS[arguments.kind]
        world = with_false_loops(
            world, make(world.graph, world.truth, arguments.false_loops, rng))
    ids = np.arange(world.graph.n_poses)
    record = GraphRecord(world.graph, world.odometry, ids)
    write_truth(truth_path(arguments.output), ids, world.truth)
    if arguments.output.suffix == '':
        write_spoiled(arguments.output, world.false_loops,
                      lambda: write_graph_bag(arguments.output, record, world.truth))
    else:
        write_spoiled(arguments.output, world.false_loops,
                      lambda: formats.write_output(arguments.output, record))
    return Ending()


def info(arguments: argparse.Namespace) -> Ending:
    """Print what is in a graph or a bag, and what looks wrong with it."""
    from l1slam_ros.cli import findings

    if formats.is_bag(arguments.input):
        _print_rows(findings.bag_numbers(arguments.input))
    record = read(arguments, arguments.input)
    _print_rows(findings.numbers(record))
    sentences = [*record.skipped, *findings.complaints(record)]
    for sentence in sentences:
        print(f'- {sentence}')
    if not sentences and not record.damage:
        print('nothing looks wrong')
    return Ending(record.damage)


def _print_rows(rows: list[tuple[str, str]]) -> None:
    print('\n'.join(f'{name:<12}{value}' for name, value in rows))


def plot(arguments: argparse.Namespace) -> Ending:
    """Draw the stored poses of graphs beside each other."""
    from l1slam_ros.cli.drawing import drawing
    from l1slam_ros.cli.reference import read_truth, true_path
    from l1slam_ros.io.plot import check_picture, plot_maps

    check_picture(arguments.output)
    drawings, damages = [], []
    for path in arguments.input:
        record = read(arguments, path)
        warn(record.skipped)
        with formats.named(path):
            poses = formats.stored_poses(record)
        known, truth = truth_path(path), None
        if known.exists():
            truth = true_path(record, poses, read_truth(str(known), record, path))
        drawings.append(drawing(path, record, poses, truth, 'poses'))
        damages.append(record.damage)
    plot_maps(arguments.output, drawings)
    return Ending('; '.join(filter(None, damages)))


def read(arguments: argparse.Namespace, path: Path) -> GraphRecord:
    """Return the graph of an input, as the options for bags say."""
    options = None
    if arguments.params_file:
        from l1slam_ros.io.node_options import read_params_file

        options = read_params_file(arguments.params_file)
    topics = Topics(arguments.odom_topic, arguments.loop_topic, arguments.trusted_topic,
                    arguments.absolute_topic)
    return formats.read_input(path, options, topics)


def warn(sentences: tuple[str, ...], quiet: bool = False) -> None:
    """Print warnings to standard error."""
    for sentence in () if quiet else sentences:
        print(f'l1slam: {sentence}', file=sys.stderr)


def check_counts(arguments: argparse.Namespace) -> None:
    """Refuse, before any work is done, an output that holds no graph, and counts below 0."""
    formats.check_graph_output(arguments.output)
    for name in ('seed', 'false_loops'):
        value = getattr(arguments, name)
        if value < 0:
            raise OptionError(f'--{name.replace("_", "-")} is {value}, expected 0 or more')


def write_spoiled(output: Path, pairs: Indices, write_graph: Callable[[], None]) -> None:
    """Write a graph and its file of false loops, pairs (k, 2) of ids, both or neither."""
    from l1slam_ros.io.files import put_lines, replacing

    with replacing(false_loops_path(output)) as temporary:
        put_lines(temporary, pair_lines(pairs))
        write_graph()
