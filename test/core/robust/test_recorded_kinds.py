# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Lies as place recognition makes them, misstated noise, sessions, and what is doubtful."""

from dataclasses import replace

import numpy as np
import pytest
from lies import careful_world, is_false, position_error, spoilt
from problems import chain_of, graph_of, measure, retold
from torn import shifted_runs

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.parts import odometry_gaps
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.batch import judge, robust_solve
from l1slam_ros.core.robust.batch_map import SolveOptions
from l1slam_ros.core.robust.batch_map import solve as solve_graph
from l1slam_ros.core.robust.judgement import ONE_JOINS, OTHER_MAP, PARTS, UNCONFIRMED, Doubt
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file


@pytest.fixture(scope='module')
def world():
    return careful_world(400, 800)


@pytest.mark.parametrize('runs', [1, 3])
def test_a_corridor_taken_for_another_does_not_pass_for_a_slip(world, runs):
    graph = shifted_runs(world, [(20, 220), (70, 300), (120, 260)][:runs], 30)
    found, poses = robust_solve(graph)
    assert not found.accepted[len(world.graph.between):].any() and not len(found.slips)
    assert position_error(poses, world.truth) < 0.3


@pytest.mark.parametrize('odometry, loops', [(1e-4, 1), (1e4, 1), (1, 1e-4), (1, 1e4),
                                             (1e-6, 1e-6), (0.01, 0.01), (1e6, 1e6)])
def test_misstated_information_changes_no_decision(world, odometry, loops):
    bad = spoilt(world, 'random', 401)
    factors = bad.graph.between
    times = np.where(factors.is_odometry, odometry, loops) ** -0.5
    found, _ = robust_solve(retold(bad.graph, times=times))
    false = is_false(bad, factors)
    assert not found.accepted[false].any()
    assert np.count_nonzero(~found.accepted[~false]) <= 8
    # In hundreds: how noisy the odometry is shows only where loops check it.
    within = 0.15 if odometry == loops else 1.0
    np.testing.assert_allclose(np.log10(found.variance / [odometry, loops]), 0, atol=within)


def test_noise_is_learnt_where_all_loops_hang_together_as_one_place():
    """On a sphere each loop is beside the next one, and they join the whole way."""
    sphere = simulate_world(200, 400, WorldOptions(), np.random.default_rng(0), 'sphere').graph
    assert robust_solve(retold(sphere, times=100.0))[0].accepted.all()


@pytest.mark.parametrize('times', [1.0, 3.0, 10.0])
def test_noise_said_to_be_larger_than_it_is_lets_no_lie_in(world, times):
    """A corridor that looks alike everywhere is wrong by metres, not by the width of the map."""
    factors, rng = world.graph.between, np.random.default_rng(0)
    loops = np.flatnonzero(~factors.is_odometry & (np.maximum(factors.i, factors.j) < 390))
    lies, along = rng.choice(loops, 80, replace=False), np.zeros((80, 3))
    along[:, 0] = rng.choice([-1, 1], 80) * rng.uniform(1.0, 5.0, 80)
    graph, root = world.graph.copy(), factors.sqrt_information[loops[0]]
    measure(graph, world.truth, factors.i[lies] + 2, factors.j[lies] + 3, along, root.T @ root)
    found, _ = robust_solve(retold(graph, times=times))
    assert not found.accepted[len(factors):].any() and found.accepted[:len(factors)].all()


def test_a_graph_that_says_all_twice_is_believed(world):
    factors = world.graph.between
    graph = world.graph.copy()
    graph.append_between(factors.i, factors.j, factors.measurement, factors.sqrt_information)
    assert robust_solve(graph)[0].accepted.all()


def test_a_dozen_loops_do_not_teach_that_noise_is_a_thousand_times_what_is_stated(datasets):
    graph = read_graph_file(datasets / 'real' / 'kitti_00.g2o').graph
    factors = graph.between
    first = factors.is_odometry | (np.maximum(factors.i, factors.j) < graph.n_poses // 2)
    found, _ = robust_solve(graph.subset(first))
    assert found.accepted.all() and np.count_nonzero(first & ~factors.is_odometry) == 12
    assert np.abs(np.log10(found.variance)).max() < 1


@pytest.mark.parametrize('joined', [True, False])
def test_two_sessions_are_joined_by_loops_or_stay_two_parts(world, joined):
    bad = spoilt(world, 'random', 170)
    factors = bad.graph.between
    seam = 199
    n = 400
    low, high = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    across = (low <= seam) & (high > seam)
    keep = ~across if not joined else ~(across & (high - low == 1))
    graph = bad.graph.subset(keep)
    assert odometry_gaps(graph).tolist() == [seam]
    outcome = solve_graph(graph, None, SolveOptions(norm='l2'))
    assert outcome.parts == (1 if joined else 2)
    assert not outcome.judgement.accepted[is_false(bad, graph.between)].any()
    assert [doubt.kind for doubt in outcome.judgement.doubts] == [PARTS] * (not joined)
    halves = (slice(0, n),) if joined else (slice(0, 200), slice(200, n))
    for half in halves:
        assert position_error(outcome.solution.poses[half], world.truth[half]) < 0.5


@pytest.mark.parametrize('joined', [True, False])
def test_a_step_that_says_next_to_nothing_joins_no_parts(world, joined):
    factors, seam = world.graph.between, 199
    low, high = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    step = factors.is_odometry & (low == seam)
    keep = step | (low > seam) | (high <= seam) | joined
    vague = retold(world.graph, times=np.where(step, 1000.0, 1.0)).subset(keep)
    outcome = solve_graph(vague, None, SolveOptions())
    assert outcome.parts == (1 if joined else 2)
    assert solve_graph(vague, None, SolveOptions(robust=False)).parts == 1


def ring(seed, n=600, loops=20, radius=95):
    """Return a lap that loops of one place close, and how many steps it has."""
    angle = 2 * np.pi * np.arange(n + loops) / n
    truth = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), angle))
    chain, back = chain_of(n + loops), np.arange(loops)
    pairs = np.concatenate((chain, np.column_stack((back, back + n))))
    noise = np.random.default_rng(seed).standard_normal((len(pairs), 3)) * [0.05, 0.05, 0.005]
    return graph_of(truth, pairs, noise, np.diag([400.0, 400.0, 4e4])), len(chain)


@pytest.mark.parametrize('seed, loops, doubted', [(2, 20, False), (2, 7, True), (3, 7, False)])
def test_one_place_that_carries_all_is_doubtful_where_odometry_hardly_bears_it_out(
        seed, loops, doubted):
    """Seven loops along 1.2 m may be one mistake, twenty are a run; a few loops may be one."""
    graph, steps = ring(seed, loops=loops, radius=20)
    found, _ = robust_solve(graph)
    assert found.accepted.all()
    assert [doubt.kind for doubt in found.doubts] == [UNCONFIRMED] * doubted
    few, _ = robust_solve(graph.subset(np.arange(steps + 3)))
    assert UNCONFIRMED not in [doubt.kind for doubt in few.doubts]


@pytest.mark.parametrize('turn, count', [(0.0, 20), (np.pi / 2, 20), (np.pi / 2, 4)])
def test_a_slip_of_which_one_place_alone_tells_is_cut(turn, count):
    """The second lap's loops are refused first; those of the first half do not span the step."""
    lap, steps = ring(0)
    lap = lap.subset(np.arange(steps + count))
    near = np.arange(0, 240, 6)
    true = odometry_poses(lap)
    factors = lap.between
    Z = factors.measurement.copy()
    Z[factors.is_odometry & (factors.i == 400), 2] += turn
    graph = retold(lap, Z)
    noise = np.random.default_rng(3).standard_normal((len(near), 3)) * [0.1, 0.1, 0.01]
    graph.append_between(
        near, near + 6, se2.retract(se2.between(true[near], true[near + 6]), noise),
        np.repeat(factors.sqrt_information[:1], len(near), axis=0))
    found, _ = robust_solve(graph)
    assert not found.doubts
    assert graph.between.i[found.slips].tolist() == [400] * bool(turn)
    np.testing.assert_array_equal(np.flatnonzero(~found.accepted), found.slips)


@pytest.mark.parametrize('believed', [False, True])
@pytest.mark.parametrize('ends, doubted', [
    ([(16, 204), (14, 205)], (2, 2)), ([(134, 204), (136, 204), (135, 205)], (3, 3)),
    # Nothing agrees with a single one; two are of two places.
    ([(16, 204)], (0, 1)), ([(16, 204), (61, 200)], (0, 0))])
def test_one_place_that_alone_joins_two_parts_is_doubtful(world, ends, doubted, believed):
    factors, seam = world.graph.between, 199
    low, high = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    keep = (low > seam) | (high <= seam)
    for i, j in ends:
        keep |= (low == i) & (high == j)
    graph = world.graph.subset(keep)
    found, poses = robust_solve(graph)
    assert np.count_nonzero(~found.accepted) == len(ends)
    if believed:
        known = replace(found, accepted=np.ones(len(graph.between), bool))
        found, _ = judge(graph, poses, known)
    count, (first, last) = doubted[believed], (min(ends)[0], max(j for _, j in ends))
    assert found.doubts == (Doubt(ONE_JOINS, count, first, last),) * (count > 0)


@pytest.mark.parametrize('contradicted', [True, False])
def test_half_a_map_that_says_it_is_elsewhere_is_doubtful_unless_loops_contradict(contradicted):
    """109 true loops against 54, of nine places, that agree with each other."""
    world = careful_world(500, 499 + 109)
    starts = [(i, 260 + 20 * run) for run, i in enumerate(range(5, 185, 20))]
    graph = shifted_runs(world, starts, 6)
    factors, half = graph.between, 220
    low, high = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    lies = is_false(replace(world, graph=graph, false_loops=np.array([
        (i + k, j + k) for i, j in starts for k in range(6)])), factors)
    across = ~factors.is_odometry & ~lies & (low < half) & (high >= half)
    found, _ = robust_solve(graph if contradicted else graph.subset(~across))
    assert not found.accepted[lies if contradicted else lies[~across]].any()
    assert (OTHER_MAP in [doubt.kind for doubt in found.doubts]) == (not contradicted)
    assert not contradicted or found.confidence > 0.9


@pytest.mark.parametrize('run, doubted', [(20, True), (0, False)])
def test_a_long_run_between_two_parts_against_several_places_is_doubtful(run, doubted):
    """Two laps that no odometry joins; places opposite each other look alike, one way is seen."""
    n = 120
    angle = 2 * np.pi * np.arange(2 * n) / n
    truth = np.column_stack((20 * np.cos(angle), 20 * np.sin(angle), angle))
    chain, seen = chain_of(2 * n), np.arange(10, 10 + run)
    alike = np.arange(12, 60, 8)
    pairs = np.concatenate((np.delete(chain, n - 1, axis=0),
                            np.column_stack((seen, seen + n)),
                            np.column_stack((alike, alike + n))))
    noise = np.random.default_rng(2).standard_normal((len(pairs), 3)) * [0.02, 0.02, 0.002]
    graph = graph_of(truth, pairs, noise, np.diag([2500.0, 2500.0, 250_000.0]))
    # The second keyframe of such a pair is said to be where the robot was half a lap later.
    graph.between.j[-len(alike):] = n + (alike + n // 2) % n
    found, _ = robust_solve(graph)
    refused = np.flatnonzero(~found.accepted) - (len(pairs) - len(alike) - run)
    assert set(refused) == set(range(run))
    assert [doubt.kind for doubt in found.doubts] == [OTHER_MAP] * doubted
