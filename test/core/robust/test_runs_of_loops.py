# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Runs of loops that noisier odometry explains are believed, on logs whose wheels lose a sign."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.robust import batch
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.worlds.false_loops import grouped_false_loops, insert_loops
from l1slam_ros.io.graphs.graph_file import read_graph_file


@pytest.mark.parametrize(('name', 'most'), [('fr079_wheel', 0.8), ('fr079_match', 0.5)])
@pytest.mark.parametrize('alone', [False, True])
@pytest.mark.parametrize('norm', ['l1', 'l2'])
def test_true_loops_of_a_log_come_in_and_its_map_is_right(datasets, name, most, alone, norm):
    graph = read_graph_file(datasets / 'lidar' / f'{name}.g2o').graph
    known = np.loadtxt(datasets / 'lidar' / 'fr079.truth.txt')
    truth = np.full((graph.n_poses, 3), np.nan)
    truth[known[:, 0].astype(int)] = known[:, 1:4]
    factors = graph.between
    off = se2.local(se2.between(truth[factors.i], truth[factors.j]), factors.measurement)
    true = ~factors.is_odometry & (np.hypot(off[:, 0], off[:, 1]) < 0.5) & (abs(off[:, 2]) < 0.2)
    if alone:
        rows = factors.is_odometry | true
        graph, true = graph.subset(rows), true[rows]
    outcome = solve(graph, None, SolveOptions(norm=norm))
    there = np.isfinite(truth[:, 0])
    assert absolute_trajectory_error(
        outcome.solution.poses[there, :2], truth[there, :2]) < most
    assert np.count_nonzero(true & ~outcome.judgement.accepted) <= 0.05 * true.sum()


@pytest.mark.parametrize('times', [0.98, 0.99, 1.02])
def test_a_drift_that_is_found_a_little_otherwise_makes_no_other_map_unsaid(
        datasets, times, monkeypatch):
    """
    By the noise that the runs taught, three lone lies fitted a map of some of these drifts.

    With 1.02 times the drift a step is cut for a slip that is none, .94 m: its odds are a doubt.
    """
    likely = batch.likely_drifts
    monkeypatch.setattr(batch, 'likely_drifts', lambda graph: times * likely(graph))
    graph = read_graph_file(datasets / 'lidar' / 'fr079_wheel.g2o').graph
    known = np.loadtxt(datasets / 'lidar' / 'fr079.truth.txt')
    outcome = solve(graph, None, SolveOptions(norm='l2'))
    error = absolute_trajectory_error(
        outcome.solution.poses[known[:, 0].astype(int), :2], known[:, 1:3])
    assert outcome.judgement.drift == pytest.approx(0.017 * times, rel=0.02)
    assert error < 0.8 or (error < 1.0 and outcome.judgement.doubts)


@pytest.mark.parametrize('seed', [5, (0, 3, 90)])
def test_a_run_of_lies_does_not_make_the_odometry_of_a_large_map_noisier(datasets, seed):
    """Of nine times as many grouped lies one was let in by odometry 2 and 9 times as noisy."""
    graph = read_graph_file(datasets / 'manhattan3500.g2o').graph
    poses = solve(graph, None, SolveOptions(robust=False, norm='l2')).solution.poses
    true = np.count_nonzero(~graph.between.is_odometry)
    rng = np.random.default_rng(seed)
    lied = insert_loops(graph, grouped_false_loops(graph, poses, 9 * true, rng))
    outcome = solve(lied, None, SolveOptions(norm='l2'))
    assert np.count_nonzero(outcome.judgement.accepted & ~lied.between.is_odometry) == true
    assert_allclose(outcome.solution.poses, poses, atol=1e-3)
