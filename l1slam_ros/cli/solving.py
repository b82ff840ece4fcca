# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command of `l1slam` that solves."""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.cli.commands import Ending, inputs, read, read_scan_map, warn
from l1slam_ros.cli.reference import Truth, known_false, position_error, read_truth
from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.memory import free, in_gigabytes, measure_by
from l1slam_ros.core.names import SAME
from l1slam_ros.core.robust.batch_map import Outcome, SolveOptions
from l1slam_ros.core.robust.batch_map import solve as solve_graph
from l1slam_ros.core.robust.judgement import NO_WHEELS, doubt_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import SENTENCES
from l1slam_ros.core.solvers.solve import Method
from l1slam_ros.io import formats
from l1slam_ros.io.files import counted
from l1slam_ros.io.free_memory import free_memory, keep_freed_memory
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.left_out import left_out_by
from l1slam_ros.io.ours import refuse_others
from l1slam_ros.io.progress import Progress
from l1slam_ros.io.sentences import (
    DOUBTFUL,
    WITHOUT,
    doubt_reasons,
    doubt_sentence,
    doubted,
    doubted_rows,
    judgement_sentences,
    known_false_sentence,
    offset_sentence,
)

if TYPE_CHECKING:
    from l1slam_ros.io.scans.to_graph import ScanMap


# [s] What a solve takes from which it is said beforehand.
_LONG = 10.0


def solve(arguments: argparse.Namespace) -> Ending:
    """Optimise a graph; print, write and draw what came out."""
    _check_outputs(arguments)
    asked = asked_of(arguments)
    keep_freed_memory()
    record, made = _read(arguments)
    return solved(arguments, asked, record, made)


def solved(arguments: argparse.Namespace, asked: SolveOptions, record: GraphRecord,
           made: 'ScanMap | None',
           settled: Callable[[Outcome], tuple[Outcome, list[str]]] = lambda outcome: (outcome, []),
           ) -> Ending:
    """
    Optimise a graph that was read; print, write and draw what came out.

    made : what the scans gave besides the graph; settled : changes the outcome before it is
    written, and returns sentences on that
    """
    truth = read_truth(
        arguments.reference, record, arguments.input, made.path if made else None) if (
        arguments.reference) else None
    warnings = [*record.skipped, *(truth.skipped if truth else ())]
    warn(warnings, arguments.quiet)
    if arguments.plot:
        known_false(arguments.input, record)  # damaged, it is refused before the work
    measure_by(free_memory)
    outcome, sentences = settled(_outcome(arguments, record, asked))
    if made and not made.has_wheels:
        outcome = _without_wheels(record.graph, outcome)
    remarks = [*_remarks(outcome), *sentences,
               *offset_sentence(record.graph.manifold, outcome.offset)]
    warn(remarks, arguments.quiet)
    judgement = outcome.judgement
    ending = Ending(record.damage, doubt_sentence(
        judgement.doubts if judgement else (), record.ids, record.stamps))
    report = _report(record, outcome)
    report['warnings'] = [*warnings, *remarks, *filter(None, ending)]
    if truth:
        report['ate'] = position_error(record, outcome.solution.poses, truth)
        report['ate_poses'] = len(truth.rows)
    _write(arguments, record, outcome, truth, _cost_name(asked))
    if arguments.grid and made:
        _write_grid(arguments.grid, made, outcome)
    if arguments.report:
        from l1slam_ros.cli.report.page import write_report

        write_report(arguments, record, outcome, asked, _cost_name(asked),
                     [*warnings, *remarks, *filter(None, [record.damage])])
    if arguments.json:
        # What is not finite has no place in JSON.
        print(json.dumps({name: None if isinstance(value, float) and not math.isfinite(value)
                          else value for name, value in report.items()}))
    elif not arguments.quiet:
        _print_report(report, record, _cost_name(asked), outcome)
    return ending


def _read(arguments: argparse.Namespace) -> tuple[GraphRecord, 'ScanMap | None']:
    """Return the graph, and all that scans made where it is of scans."""
    if not (arguments.scans or formats.is_log(arguments.input)):
        return read(arguments, arguments.input, quiet=True), None
    made = read_scan_map(arguments, arguments.input, arguments.quiet, arguments.scans)
    return made.record, made


def _without_wheels(graph: FactorGraph, outcome: Outcome) -> Outcome:
    """Return the outcome with the doubt of a drive of which only the scans show the motion."""
    if outcome.judgement is None:
        return outcome
    doubts = *outcome.judgement.doubts, doubt_of(graph, np.zeros(0, np.int64), NO_WHEELS)
    return replace(outcome, judgement=replace(outcome.judgement, doubts=doubts))


def _remarks(outcome: Outcome) -> Iterator[str]:
    """Yield why no loop was judged, where none was."""
    if outcome.unjudged:
        yield f'no loop was doubted: {outcome.unjudged}'


def _write(arguments: argparse.Namespace, record: GraphRecord, outcome: Outcome,
           truth: Truth | None, cost_name: str) -> None:
    """Draw and write the map, where that was asked for."""
    if arguments.plot:
        from l1slam_ros.cli.drawing import plot_outcome

        plot_outcome(arguments, record, outcome, truth, cost_name)
    if arguments.output:
        formats.write_output(arguments.output, replace(
            record, poses=outcome.solution.poses,
            left_out=left_out_by(outcome.judgement, record.graph.between),
            drift=outcome.judgement.drift if outcome.judgement else 0.0), force=arguments.force)


def _write_grid(path: Path, made: 'ScanMap', outcome: Outcome) -> None:
    from l1slam_ros.core.scans.occupancy.grid import draw
    from l1slam_ros.io.scans.grid_file import write_grid

    write_grid(path, draw(made.points, outcome.solution.poses))


def _outcome(arguments: argparse.Namespace, record: GraphRecord, asked: SolveOptions) -> Outcome:
    l1, l2 = asked.options, asked.least_squares
    steps = l1.outer_iterations if asked.norm == 'l1' else l2.iterations
    quiet = arguments.quiet
    with (formats.named(arguments.input),
          Progress(None, 'round', quiet, 'judging loops') as judging,
          Progress(steps, 'step', quiet, 'solving') as solving):
        # Judged loops are weighed by the noise that was found: that cost is no cost of the map.
        return solve_graph(
            record.graph, record.poses, asked,
            solving.report if asked.robust is False else lambda *_: solving.advance(),
            lambda _, accepted: judging.advance(1, f'{counted(accepted, "loop")} believed'),
            record.ids, lambda method: _announce(method, quiet))


def _announce(method: Method, quiet: bool) -> None:
    """Say what a long solve will take."""
    if method.needs and method.needs.seconds > _LONG:
        warn([f'{method.solver}: predicted to take some {method.needs.seconds:.0f} s and '
              f'{in_gigabytes(method.needs.memory)}, of which {in_gigabytes(free())} are free'],
             quiet)


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse names of outputs before the work is done, not after."""
    read = inputs(arguments, arguments.reference)
    if arguments.output:
        formats.check_output(arguments.output, read, arguments.force)
    if arguments.plot:
        from l1slam_ros.io.plot import check_picture

        check_picture(arguments.plot)
        refuse_others([arguments.plot], read, arguments.force)
    if arguments.grid:
        from l1slam_ros.io.scans.grid_file import check_grid

        if not (arguments.scans or formats.is_log(arguments.input)):
            raise OptionError('--grid is of scans; expected --scans TOPIC, or a CARMEN log')
        check_grid(arguments.grid, read, arguments.force)
    if arguments.report:
        from l1slam_ros.cli.report.page import check_report

        check_report(arguments.report, read, arguments.force)


def asked_of(arguments: argparse.Namespace) -> SolveOptions:
    """Return how a graph is to be solved."""
    solver = OptimiserOptions()
    least_squares = LeastSquaresOptions()
    robust = arguments.robust
    if arguments.params_file:
        from l1slam_ros.io.node_options import read_params_file

        options = read_params_file(arguments.params_file)
        solver = options.solver
        if robust is None and not options.robust.enabled:
            robust = False
    if arguments.outer is not None:
        solver = replace(solver, outer_iterations=arguments.outer)
        least_squares = replace(least_squares, iterations=arguments.outer)
    if arguments.inner is not None:
        solver = replace(solver, inner=replace(solver.inner, iterations=arguments.inner))
    norm, loop_norm = arguments.norm or solver.norm, arguments.loop_norm or solver.loop_norm
    return SolveOptions(arguments.start, norm, loop_norm, arguments.solver, robust, solver,
                        least_squares)


def _cost_name(asked: SolveOptions) -> str:
    if asked.loop_norm in (SAME, asked.norm):
        return f'{asked.norm} cost'
    return f'{asked.norm} cost, of loops {asked.loop_norm}'


def _report(record: GraphRecord, outcome: Outcome) -> dict[str, object]:
    solution = outcome.solution
    factors = record.graph.between
    judgement = outcome.judgement
    suspect = judgement.suspect if judgement else np.zeros(len(factors), bool)
    refused = ~judgement.accepted & ~suspect if judgement else suspect
    slips = judgement.slips if judgement else np.zeros(0, np.int64)
    doubts = judgement.doubts if judgement else ()
    return {
        'poses': record.graph.n_poses,
        'factors': len(factors),
        'loops': int((~factors.is_odometry & ~factors.is_absolute).sum()),
        'initial_cost': outcome.initial_cost,
        'seed_cost': outcome.seed_cost,
        'final_cost': solution.cost,
        'status': DOUBTFUL if doubts else solution.status.value,
        'seconds': outcome.seconds,
        'solver': outcome.solver,
        'outer_iterations': solution.outer_iterations,
        'inner_iterations': solution.inner_iterations,
        'rejected': record.ids[factors.pairs[refused]].tolist(),
        'suspect': record.ids[factors.pairs[suspect]].tolist(),
        'slips': record.ids[factors.pairs[slips]].tolist(),
        'parts': outcome.parts,
        'drift': judgement.drift if judgement else 0.0,
        'confidence': judgement.confidence if judgement else None,
        'doubts': [
            {'kind': doubt.kind, 'text': text,
             'loops': record.ids[factors.pairs[doubted_rows(doubt, factors)]].tolist()}
            for doubt, text in zip(doubts, doubt_reasons(doubts, record.ids, record.stamps),
                                   strict=True)],
    }


def _print_report(report: dict[str, object], record: GraphRecord, cost_name: str,
                  outcome: Outcome) -> None:
    solution = outcome.solution
    seed = f'seed {outcome.seed_cost:.6g}, ' if outcome.seed_cost is not None else ''
    factors = record.graph.between
    struck = f', {factors.struck.sum():,} struck out' if factors.struck.any() else ''
    print(f'{counted(len(solution.poses), "pose")}, {counted(len(factors), "factor")}, '
          f'{doubted(factors)}{struck}')
    left_out = (left_out_by(outcome.judgement, factors) != '') & ~factors.struck
    print(f'{cost_name}: initial {outcome.initial_cost:.6g}, {seed}final {solution.cost:.6g}'
          f'{WITHOUT if left_out.any() else ""}')
    inner = f', {counted(solution.inner_iterations, "inner one")}' if (
        solution.inner_iterations) else ''
    print(f'{solution.status.value.replace("_", " ")} ({SENTENCES[solution.status]}): '
          f'{counted(solution.outer_iterations, "iteration")}{inner}, {outcome.seconds:.2f} s')
    print(f'solver: {outcome.solver}, because {outcome.reason}')
    if 'ate' in report:
        print(f'position error {report["ate"]:.4f} m over {report["ate_poses"]:,} of '
              f'{counted(len(solution.poses), "pose")} (RMSE after rigid alignment)')
    for sentence in judgement_sentences(record, outcome.judgement) if outcome.judgement else ():
        print(sentence)
    for sentence in known_false_sentence(record, outcome.judgement):
        print(sentence)
