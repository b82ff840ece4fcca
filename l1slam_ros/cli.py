# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: the core from the command line, without ROS. Parsing, one call each, and printing."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros import offline
from l1slam_ros.core.errors import L1SlamError, OptionError
from l1slam_ros.core.false_loops import FALSE_LOOPS
from l1slam_ros.core.graph import component_labels
from l1slam_ros.core.l2 import LeastSquaresOptions
from l1slam_ros.core.optimality import SENTENCES
from l1slam_ros.core.optimiser import OptimiserOptions
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.node_options import read_params_file
from l1slam_ros.progress import Progress

BAD_INPUT = 2
# In this order: what `auto` picks first is what there is.
SOLVERS = ('auto', 'primal-dual')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code: 0, or 2 for bad input."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except (L1SlamError, OSError) as error:
        print(f'l1slam: {error}', file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='l1slam', description='Pose-graph SLAM by the L1 norm, offline.')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_solve(commands.add_parser('solve', help='optimise a graph or a bag'))
    convert = commands.add_parser('convert', help='graph file <-> bag')
    convert.add_argument('input', type=Path)
    convert.add_argument('output', type=Path, help='.g2o, .graph, .tum, or a bag directory')
    convert.set_defaults(run=_convert)
    _add_simulate(commands.add_parser('simulate', help='make a Manhattan world'))
    info = commands.add_parser('info', help='say what is in a graph or a bag')
    info.add_argument('input', type=Path)
    info.set_defaults(run=_info)
    plot = commands.add_parser('plot', help='draw maps beside each other')
    plot.add_argument('input', type=Path, nargs='+')
    plot.add_argument('--output', type=Path, required=True, metavar='PNG')
    plot.set_defaults(run=_plot)
    return parser


def _add_solve(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('input', type=Path, help='.g2o, .graph, .mcap, .db3 or a rosbag2 directory')
    add('--start', choices=offline.STARTS, default=offline.STARTS[0])
    add('--norm', choices=offline.NORMS, default=offline.NORMS[0])
    add('--solver', choices=SOLVERS, default=SOLVERS[0])
    add('--outer', type=int, metavar='N', help='most linearisations')
    add('--inner', type=int, metavar='N', help='most primal-dual iterations of each')
    add('--output', type=Path, help='.g2o, .graph, .tum, or a bag directory')
    add('--reference', type=Path, metavar='TRUTH', help='TUM, g2o or `id x y theta` text')
    add('--plot', type=Path, metavar='PNG', help='draw the map')
    add('--params-file', type=Path, metavar='YAML', help="the node's parameter file")
    add('--json', action='store_true', help='one object on standard output')
    add('--quiet', action='store_true', help='no progress, no summary')
    parser.set_defaults(run=_solve)


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('output', type=Path, help='.g2o, .graph, or a bag directory')
    add('--poses', type=int, required=True, metavar='N')
    add('--edges', type=int, required=True, metavar='M', help='true ones, odometry included')
    add('--seed', type=int, default=0, metavar='S')
    add('--false-loops', type=int, default=0, metavar='K', help='on top of the edges')
    add('--kind', choices=list(FALSE_LOOPS), default='random', help='of the false loops')
    parser.set_defaults(run=_simulate)


def _solve(arguments: argparse.Namespace) -> None:
    _check_outputs(arguments)
    record, solver, least_squares = _solve_input(arguments)
    steps = solver.outer_iterations if arguments.norm == 'l1' else least_squares.iterations
    with Progress(steps, 'step', arguments.quiet) as progress:
        outcome = offline.solve(record, arguments.start, arguments.norm, solver, least_squares,
                                progress.report)
    poses = outcome.solution.poses
    report = _solve_report(record, arguments.norm, outcome)
    if arguments.reference:
        report['ate'] = offline.position_error(record, poses, arguments.reference)
    if arguments.plot:
        _plot_solution(arguments, record, outcome)
    if arguments.output:
        offline.write_output(arguments.output, record, poses)
    if arguments.json:
        print(json.dumps(report))
    elif not arguments.quiet:
        _print_report(report, arguments.norm, SENTENCES[outcome.solution.status])


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse names of outputs before the work is done, not after."""
    if arguments.output:
        offline.check_output(arguments.output)
    if arguments.plot:
        from l1slam_ros.io.plot import check_picture

        check_picture(arguments.plot)


def _solve_input(
    arguments: argparse.Namespace,
) -> tuple[GraphRecord, OptimiserOptions, LeastSquaresOptions]:
    growth, solver, least_squares = None, OptimiserOptions(), LeastSquaresOptions()
    if arguments.params_file:
        growth = read_params_file(arguments.params_file)
        solver = growth.solver
    if arguments.outer is not None:
        solver = replace(solver, outer_iterations=arguments.outer)
        least_squares = replace(least_squares, iterations=arguments.outer)
    if arguments.inner is not None:
        solver = replace(solver, inner=replace(solver.inner, iterations=arguments.inner))
    record = offline.read_input(arguments.input, growth)
    _warn(record, arguments.quiet)
    return record, solver, least_squares


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
        'solver': 'primal-dual' if norm == 'l1' else 'gauss-newton',
        'outer_iterations': solution.outer_iterations,
        'inner_iterations': solution.inner_iterations,
        'rejected': [],
    }


def _print_report(report: dict[str, object], norm: str, status: str) -> None:
    seed = f'seed {report["seed_cost"]:.6g}, ' if report['seed_cost'] is not None else ''
    print(f'{report["poses"]} poses, {report["factors"]} factors, {report["loops"]} loops')
    print(f'{norm} cost: initial {report["initial_cost"]:.6g}, {seed}'
          f'final {report["final_cost"]:.6g}')
    print(f'{report["status"]} ({status}): {report["outer_iterations"]} outer, '
          f'{report["inner_iterations"]} inner iterations, {report["seconds"]:.2f} s, '
          f'{report["solver"]}')
    if 'ate' in report:
        print(f'position error {report["ate"]:.4f} m (RMSE after rigid alignment)')


def _plot_solution(arguments: argparse.Namespace, record: GraphRecord,
                   outcome: offline.Outcome) -> None:
    from l1slam_ros.drawing import drawing
    from l1slam_ros.io.plot import plot_maps

    poses = outcome.solution.poses
    note = f'{arguments.norm} cost {outcome.solution.cost:.6g}'
    plot_maps(arguments.plot, [drawing(arguments.input.stem, record, poses, arguments.reference,
                                       note)])


def _convert(arguments: argparse.Namespace) -> None:
    record = offline.read_input(arguments.input)
    _warn(record, quiet=False)
    offline.write_output(arguments.output, record, offline.stored_poses(record))


def _simulate(arguments: argparse.Namespace) -> None:
    from l1slam_ros.core.simulate import WorldOptions, simulate_world, with_false_loops
    from l1slam_ros.io.graph_bag import write_graph_bag
    from l1slam_ros.io.trajectory import write_false_loops, write_truth

    if arguments.seed < 0 or arguments.false_loops < 0:
        raise OptionError('--seed and --false-loops: expected 0 or more')
    rng = np.random.default_rng(arguments.seed)
    world = simulate_world(arguments.poses, arguments.edges, WorldOptions(), rng)
    if arguments.false_loops:
        make = FALSE_LOOPS[arguments.kind]
        world = with_false_loops(
            world, make(world.graph, world.truth, arguments.false_loops, rng))
    ids = np.arange(world.graph.n_poses)
    record = GraphRecord(world.graph, world.odometry, ids)
    if arguments.output.suffix == '':
        write_graph_bag(arguments.output, record, world.truth)
    else:
        offline.write_output(arguments.output, record, world.odometry)
    write_truth(Path(f'{arguments.output}.truth.txt'), ids, world.truth)
    write_false_loops(Path(f'{arguments.output}.false.txt'), world.false_loops.tolist())


def _info(arguments: argparse.Namespace) -> None:
    record = offline.read_input(arguments.input)
    graph = record.graph
    factors, labels = graph.between, component_labels(graph)
    print(f'{arguments.input}: {graph.manifold.NAME} graph')
    print(f'poses       {graph.n_poses} (ids {record.ids[0]} to {record.ids[-1]})')
    print(f'odometry    {int(factors.is_odometry.sum())}')
    print(f'loops       {int((~factors.is_odometry).sum())}')
    if len(graph.prior):
        print(f'priors      {len(graph.prior)}')
    print(f'components  {labels.max() + 1}')
    if record.poses is not None:
        cost = offline.cost_function(record, 'l1', LeastSquaresOptions())(record.poses)
        print(f'l1 cost     {cost:.6g} at the stored poses')
    _warn(record, quiet=False)


def _plot(arguments: argparse.Namespace) -> None:
    from l1slam_ros.drawing import drawing
    from l1slam_ros.io.plot import plot_maps

    drawings = []
    for path in arguments.input:
        record = offline.read_input(path)
        truth = Path(f'{path}.truth.txt')
        drawings.append(drawing(path.stem, record, offline.stored_poses(record),
                                truth if truth.exists() else None, ''))
    plot_maps(arguments.output, drawings)


def _warn(record: GraphRecord, quiet: bool) -> None:
    for sentence in () if quiet else record.skipped:
        print(f'l1slam: {sentence}', file=sys.stderr)
