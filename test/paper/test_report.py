# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The tables of the report hold the numbers that were measured, whatever they are."""

from dataclasses import replace

import numpy as np
from problems import graph_of

from l1slam_ros.core.solvers.nonlinear import Solution
from l1slam_ros.core.solvers.optimality import Status
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper import report
from l1slam_ros.paper.experiments import Costs, Effort, Seconds


def table(lines):
    """Return the rows of a Markdown table, each by the names of the columns."""
    header, _, *rows = [[cell.strip() for cell in line.strip('|').split('|')]
                        for line in lines if line.startswith('|')]
    return [dict(zip(header, row, strict=True)) for row in rows]


def study(*results):
    return report.Study({str(k): result for k, result in enumerate(results)}, Effort())


def result(graph, initial, seed, printed, final, l2, truth=None, plain=2e-3):
    """What a graph of three poses would have given, had these been its numbers."""
    poses = np.zeros((3, 3))
    solution = Solution(poses, final, Status.CONVERGED, 1, 0, np.array([seed, final]), np.zeros(0))
    costs = Costs(initial, seed, l2, np.array([seed, printed]), False, solution, 'interior-point')
    seconds = Seconds({'plain': [plain] * 3, 'fused': [plain / 8] * 3}, 10 * plain)
    return report.GraphResult(graph, graph_of(poses, [(0, 1), (1, 2)]), poses, poses, costs,
                              seconds, truth)


def test_table_1_sets_the_costs_beside_those_of_the_paper():
    large = result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, truth=125.0)
    cut = replace(large, costs=replace(large.costs, cut_short=True))
    intel, world, ended = table(report.table_1(study(
        result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0), large, cut), None))
    assert intel == {'L1 cost': 'Intel', 'poses, edges': '3, 2', 'start: paper': '1513.17',
                     'start: ours': '1513.17', 'seed: ours': '970', 'final: paper': '982.051',
                     'final: as printed': '1000', 'final: ours': '**960**',
                     'solver': 'interior-point', 'of the L2 map': '980', 'of the true poses': ''}
    assert world['L1 cost'] == 'Manhattan50k (*)' and world['of the true poses'] == '125'
    assert world['start: paper'] == '7.14591e8'
    assert world['final: as printed'] == '120' and ended['final: as printed'] == '120 (+)'


def test_table_2_sets_times_beside_those_of_the_paper():
    intel, large = table(report.table_2(study(
        result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0),
        result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, plain=0.28)), None))
    assert intel == {
        'ms per iteration': 'Intel', 'angle: paper': '0.3', 'angle: plain': '2',
        'angle: fused': '0.25', 'translation: paper': '0.6', 'translation: plain': '2',
        'translation: fused': '0.25', 'global: paper': '1', 'global: plain': '2',
        'global: fused': '0.25', 'L2: paper (g2o)': '6.7', 'L2: ours': '20'}
    assert [large['L2: paper (g2o)'], large['L2: ours']] == ['did not finish', '2800']
