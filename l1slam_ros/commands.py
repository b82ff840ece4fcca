# SPDX-License-Identifier: Apache-2.0
"""The commands of `l1slam`; each returns a sentence on what could not be read, empty if none."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros import offline
from l1slam_ros.core.errors import FileError, GraphError, OptionError
from l1slam_ros.core.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.l2 import LeastSquaresOptions
from l1slam_ros.core.manifold import Indices
from l1slam_ros.core.optimality import SENTENCES
from l1slam_ros.core.optimiser import OptimiserOptions
from l1slam_ros.graph_from_bag import Topics
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.io.side_files import false_loops_path, pair_lines, truth_path
from l1slam_ros.node_options import read_params_file
from l1slam_ros.progress import Progress
from l1slam_ros.verdict import verdict


def solve(arguments: argparse.Namespace) -> str:
    """Optimise a graph; print, write and draw what came out."""
    _check_outputs(arguments)
    wish = _wish(arguments)
    record = _read(arguments, arguments.input)
    _warn(record, arguments.quiet)
    reference = arguments.reference and offline.matching_rows(record, arguments.reference)
    _make_ready(arguments.quiet)
    steps = (wish.options.outer_iterations if wish.norm == 'l1'
             else wish.least_squares.iterations)
    with _named(arguments.input), Progress(steps, 'step', arguments.quiet) as progress:
        outcome = offline.solve(record, wish, progress.report)
    poses = outcome.solution.poses
    report = _solve_report(record, arguments.norm, outcome)
    if reference:
        report['ate'] = offline.position_error(record, poses, *reference)
    if arguments.plot:
        _plot_solution(arguments, record, outcome)
    if arguments.output:
        offline.write_output(arguments.output, replace(record, poses=poses))
    if arguments.json:
        print(json.dumps(report))
    elif not arguments.quiet:
        _print_report(report, arguments.norm, SENTENCES[outcome.solution.status], outcome.reason)
        if outcome.judgement:
            print('\n'.join(verdict(record, outcome.judgement)))
    return record.damage


def _make_ready(quiet: bool = False) -> None:
    """Compile the solver's loops, which takes long only at the first use on a machine."""
    from l1slam_ros.core.warm_up import STEPS, warm_up

    with Progress(len(STEPS), 'part', quiet, 'compiling, once', delay=1.0) as progress:
        warm_up(lambda step: progress.advance())


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse names of outputs before the work is done, not after."""
    if arguments.output:
        offline.check_output(arguments.output)
    if arguments.plot:
        from l1slam_ros.io.plot import check_picture

        check_picture(arguments.plot)


def _wish(arguments: argparse.Namespace) -> offline.Wish:
    solver, least_squares = OptimiserOptions(), LeastSquaresOptions()
    if arguments.params_file:
        solver = read_params_file(arguments.params_file).solver
    if arguments.outer is not None:
        solver = replace(solver, outer_iterations=arguments.outer)
        least_squares = replace(least_squares, iterations=arguments.outer)
    if arguments.inner is not None:
        solver = replace(solver, inner=replace(solver.inner, iterations=arguments.inner))
    return offline.Wish(arguments.start, arguments.norm, arguments.solver, arguments.robust,
                        solver, least_squares)


def _solve_report(record: GraphRecord, norm: str, outcome: offline.Outcome) -> dict[str, object]:
    solution, factors = outcome.solution, record.graph.between
    return {
        'poses': record.graph.n_poses,
        'factors': len(factors) + len(record.graph.prior),
        'loops': int((~factors.is_odometry).sum()),
        'initial_cost': outcome.initial_cost,
        'seed_cost': outcome.seed_cost,
        'final_cost': solution.cost,
        'status': solution.status.value,
        'seconds': outcome.seconds,
        'solver': outcome.solver,
        'outer_iterations': solution.outer_iterations,
        'inner_iterations': solution.inner_iterations,
        'rejected': _refused(record, outcome).tolist(),
    }


def _refused(record: GraphRecord, outcome: offline.Outcome) -> Indices:
    """Return the vertices i, j of each edge that is not in the map, in file order, (k, 2)."""
    factors, judgement = record.graph.between, outcome.judgement
    if judgement is None:
        return np.zeros((0, 2), np.int64)
    pairs: Indices = record.ids[factors.pairs[~judgement.accepted]]
    return pairs


def _print_report(report: dict[str, object], norm: str, status: str, reason: str) -> None:
    seed = f'seed {report["seed_cost"]:.6g}, ' if report['seed_cost'] is not None else ''
    print(f'{report["poses"]} poses, {report["factors"]} factors, {report["loops"]} loops')
    print(f'{norm} cost: initial {report["initial_cost"]:.6g}, {seed}'
          f'final {report["final_cost"]:.6g}')
    print(f'{report["status"]} ({status}): {report["outer_iterations"]} outer, '
          f'{report["inner_iterations"]} inner iterations, {report["seconds"]:.2f} s\n'
          f'{report["solver"]}: {reason}')
    if 'ate' in report:
        print(f'position error {report["ate"]:.4f} m (RMSE after rigid alignment)')


def _plot_solution(arguments: argparse.Namespace, record: GraphRecord,
                   outcome: offline.Outcome) -> None:
    from l1slam_ros.drawing import cost_curve, drawing
    from l1slam_ros.io.plot import plot_solution

    note = f'{arguments.norm} cost {outcome.solution.cost:.6g}'
    accepted = outcome.judgement.accepted if outcome.judgement else None
    plot_solution(arguments.plot, drawing(arguments.input, record, outcome.solution.poses,
                                          arguments.reference, 'optimised', note, accepted),
                  cost_curve(arguments.norm, outcome))


def convert(arguments: argparse.Namespace) -> str:
    """Write what was read in another format."""
    offline.check_output(arguments.output)
    record = _read(arguments, arguments.input)
    _warn(record)
    with _named(arguments.input):
        offline.write_output(arguments.output, offline.with_poses(record))
    return record.damage


def simulate(arguments: argparse.Namespace) -> str:
    """Make a world and write its graph, its truth and which of its loops are false."""
    from l1slam_ros.core.simulate import WorldOptions, simulate_world, with_false_loops
    from l1slam_ros.io.graph_bag import write_graph_bag
    from l1slam_ros.io.trajectory import write_truth

    _check_counts(arguments)
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
        _write_spoiled(arguments.output, world.false_loops,
                       lambda: write_graph_bag(arguments.output, record, world.truth))
    else:
        _write_spoiled(arguments.output, world.false_loops,
                       lambda: offline.write_output(arguments.output, record))
    return ''


def corrupt(arguments: argparse.Namespace) -> str:
    """
    Add false loops to a graph.

    What is far apart is judged on the L2 map, solved from the graph alone: a stored start may be
    raw odometry, whose drift makes places look far apart that are the same, and a 'false' loop
    between them would be true. False loops that are known already are left out of that map.
    """
    from l1slam_ros.drawing import known_false

    _check_counts(arguments)
    record = _read(arguments, arguments.input)
    _warn(record)
    former = known_false(arguments.input, record)
    believed = replace(record, graph=record.graph.subset(~former))
    options = LeastSquaresOptions()
    _make_ready()
    with _named(arguments.input), Progress(options.iterations, 'step') as progress:
        solution = offline.solve(believed, offline.Wish(norm='l2', least_squares=options),
                                 progress.report).solution
    loops = FALSE_LOOPS[arguments.kind](record.graph, solution.poses, arguments.false_loops,
                                        np.random.default_rng(arguments.seed))
    factors = record.graph.between
    pairs = np.concatenate((factors.pairs[former],
                            np.stack((loops.i, loops.j), axis=1)))
    spoiled = offline.with_poses(replace(record, graph=insert_loops(record.graph, loops)))
    # A bag has no vertex ids: read back, it counts its keyframes from 0.
    named = record.ids[pairs] if arguments.output.suffix else pairs
    with _named(arguments.input):
        _write_spoiled(arguments.output, named,
                       lambda: offline.write_output(arguments.output, spoiled))
    return record.damage


def _check_counts(arguments: argparse.Namespace) -> None:
    offline.check_graph_output(arguments.output)
    for name in ('seed', 'false_loops'):
        value = getattr(arguments, name)
        if value < 0:
            raise OptionError(f'--{name.replace("_", "-")} is {value}, expected 0 or more')


def _write_spoiled(output: Path, pairs: Indices, write_graph: Callable[[], None]) -> None:
    """Write a graph and its file of false loops, pairs (k, 2) of ids, both or neither."""
    from l1slam_ros.io.files import put_lines, replacing

    with replacing(false_loops_path(output)) as temporary:
        put_lines(temporary, pair_lines(pairs))
        write_graph()


def info(arguments: argparse.Namespace) -> str:
    """Print what is in a graph or a bag, and what looks wrong with it."""
    from l1slam_ros import findings

    if offline.is_bag(arguments.input):
        _print_rows(findings.bag_numbers(arguments.input))
    record = _read(arguments, arguments.input)
    _make_ready()
    _print_rows(findings.numbers(record))
    sentences = [*record.skipped, *findings.complaints(record)]
    for sentence in sentences:
        print(f'- {sentence}')
    if not sentences and not record.damage:
        print('nothing looks wrong')
    return record.damage


def _print_rows(rows: list[tuple[str, str]]) -> None:
    print('\n'.join(f'{name:<12}{value}' for name, value in rows))


def plot(arguments: argparse.Namespace) -> str:
    """Draw the stored poses of graphs beside each other."""
    from l1slam_ros.drawing import drawing
    from l1slam_ros.io.plot import check_picture, plot_maps

    check_picture(arguments.output)
    drawings, damages = [], []
    for path in arguments.input:
        record = _read(arguments, path)
        _warn(record)
        truth = truth_path(path)
        with _named(path):
            poses = offline.stored_poses(record)
        drawings.append(drawing(path, record, poses, truth if truth.exists() else None, 'poses'))
        damages.append(record.damage)
    plot_maps(arguments.output, drawings)
    return '; '.join(filter(None, damages))


def reproduce(arguments: argparse.Namespace) -> str:
    """Run the paper's experiments; write the report and say where it is."""
    from l1slam_ros.core.reproduction import Effort
    from l1slam_ros.paper import WORLDS
    from l1slam_ros.reproduce import REPORT, reproduce

    _make_ready()
    reproduce(arguments.datasets, WORLDS[arguments.worlds], arguments.output, Effort())
    print(arguments.output / REPORT)
    return ''


def _read(arguments: argparse.Namespace, path: Path) -> GraphRecord:
    growth = read_params_file(arguments.params_file) if arguments.params_file else None
    topics = Topics(arguments.odom_topic, arguments.loop_topic, arguments.trusted_topic)
    return offline.read_input(path, growth, topics)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Let what is wrong with a graph name the file it came from."""
    try:
        yield
    except GraphError as error:
        raise FileError(path, str(error)) from error


def _warn(record: GraphRecord, quiet: bool = False) -> None:
    for sentence in () if quiet else record.skipped:
        print(f'l1slam: {sentence}', file=sys.stderr)
