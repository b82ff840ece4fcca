# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The suites of several robots, small: a team through its file, and a graph cut into robots."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord

FOLDER = Path(__file__).parents[1] / 'benchmarks' / 'fleet'


def suite(name):
    spec = importlib.util.spec_from_file_location(f'fleet_{name}', FOLDER / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('world', ['streets', 'building'])
def test_a_team_has_the_loops_that_were_asked_for(world):
    teams = suite('teams')
    record, is_false, truth = teams.team(world, 'random', 0, (100, 110), (8, 6), 500)
    graph = record.graph
    i, j = graph.between.pairs[~graph.between.is_odometry].T
    assert len(i) == 210 and (graph.robot[i] != graph.robot[j]).sum() == 110
    assert is_false.sum() == 14 and len(truth) == 500
    assert len(graph.firsts) == teams.ROBOTS - 1
    # So many odometry factors, that the robots stand apart but for their loops.
    assert graph.between.is_odometry.sum() == 500 - teams.ROBOTS


def test_a_graph_cut_into_robots_has_the_same_verdicts():
    cut = suite('cut')
    world = simulate_world(200, 340, WorldOptions(), np.random.default_rng(0))
    whole = cut.with_lies(GraphRecord(world.graph, world.odometry, np.arange(200)), 0.3)
    outcome = cut.solve(whole.graph, None, cut.SolveOptions())
    refused = int((~cut.accepted(outcome, whole.graph)).sum())
    assert refused == 42
    line = cut.row('streets', whole, outcome, 5, 5.0)
    assert f'| {refused} | {refused} | 0 (0.00%) |' in line and line.endswith(' 0 (0.00%) |')
