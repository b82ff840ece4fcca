# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command of `l1slam` that draws: plot; and the picture of a solve."""

import argparse
from pathlib import Path

import numpy as np

from l1slam_ros.cli.commands import Ending, inputs, read
from l1slam_ros.cli.reference import Truth, known_false, read_truth, true_path
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.batch_map import Outcome
from l1slam_ros.io import formats
from l1slam_ros.io.graphs.graph_file import GraphRecord, left_out_words
from l1slam_ros.io.graphs.left_out import SUSPECT, left_out_by
from l1slam_ros.io.graphs.side_files import beside
from l1slam_ros.io.ours import refuse_others
from l1slam_ros.io.plot import Curve, MapDrawing, check_picture, plot_maps, plot_solution


def plot(arguments: argparse.Namespace) -> Ending:
    """Draw the stored poses of graphs beside each other."""
    check_picture(arguments.output)
    refuse_others([arguments.output], inputs(arguments), arguments.force)
    drawings, damages = [], []
    for path in arguments.input:
        record = read(arguments, path)
        with formats.named(path):
            poses = formats.stored_poses(record)
        known = beside(path, 'truth')
        truth = read_truth(str(known), record, path) if known.exists() else None
        drawings.append(_drawing(path, record, poses, truth, 'poses', left_out_words(record)))
        damages.append(record.damage)
    plot_maps(arguments.output, drawings)
    return Ending('; '.join(filter(None, damages)))


def plot_outcome(arguments: argparse.Namespace, record: GraphRecord, outcome: Outcome,
                 truth: Truth | None, cost_name: str) -> None:
    """Draw the map of a solve, and beside it its costs, where these are of the stated noise."""
    costs, final = outcome.solution.history, outcome.solution.cost
    drawing = _drawing(arguments.input, record, outcome.solution.poses, truth, 'optimised',
                       left_out_by(outcome.judgement, record.graph.between),
                       f'{cost_name} {final:.6g}')
    if not np.isclose(costs[-1], final):  # by the noise that was estimated
        plot_maps(arguments.plot, [drawing])
        return
    named = {'initial': outcome.initial_cost, 'seed': outcome.seed_cost, 'final': final}
    plot_solution(
        arguments.plot, drawing, Curve(cost_name, np.arange(len(costs), dtype=float), costs),
        ', '.join(f'{name} {cost:.6g}' for name, cost in named.items() if cost is not None))


def _drawing(path: Path, record: GraphRecord, poses: Array, truth: Truth | None,
             name: str, left_out: np.ndarray, note: str = '') -> MapDrawing:
    """
    Return the map of poses (n, p), with its odometry, and the path of the truth if known.

    name : what the poses are. The odometry sets out from the first of them. Loops that the map
    leaves out, by the words (m,) of `left_out`, are drawn as refused or as suspect; of the others,
    the ones that the file of false loops beside the input `path` names, as false.
    """
    graph = record.graph
    factors = graph.between
    positions = graph.manifold.positions
    try:
        chain = odometry_poses(graph)
        first = np.broadcast_to(poses[0], chain.shape)
        odometry = positions(graph.manifold.compose(first, chain))
    except GraphError:  # a graph without a whole chain can still be drawn
        odometry = None
    false = known_false(path, record)
    is_loop = ~factors.is_odometry
    kept, suspect = left_out == '', left_out == SUSPECT
    pairs = factors.pairs
    return MapDrawing(
        path.name, positions(poses), odometry,
        true_path(record, poses, truth) if truth else None, pairs[is_loop & kept & ~false],
        suspect=pairs[is_loop & suspect], rejected=pairs[is_loop & ~kept & ~suspect],
        false=pairs[false & kept], name=name, note=note)
