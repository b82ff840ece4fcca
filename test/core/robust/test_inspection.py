# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What looks wrong with a graph is found, and only that; the noise by graphs of known noise."""

import time

import numpy as np
import pytest
from problems import add_absolute, retold

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.linear_system import linearise, whitened_residual
from l1slam_ros.core.graph.parts import connected_parts, odometry_gaps
from l1slam_ros.core.robust.inspection import (
    _system,
    cost_at,
    long_steps,
    noise_scales,
    parallel_factors,
    step_lengths,
)
from l1slam_ros.core.robust.places import first_told
from l1slam_ros.core.worlds.false_loops import insert_loops, random_false_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file


def graph_of(n, pairs, measurement=(1.0, 0.0, 0.0), information=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
    """Return a graph of n poses with one factor for each pair."""
    i, j = np.array(pairs).T
    m = len(pairs)
    graph = FactorGraph(se2)
    graph.add_poses(n)
    graph.add_between(i, j, np.broadcast_to(measurement, (m, 3)),
                      np.broadcast_to(information, (m, 3, 3)))
    return graph


def repeated_factors(graph):
    rows = np.arange(len(graph.between))
    return np.flatnonzero(first_told(graph, rows) != rows)


@pytest.fixture
def world(rng):
    return simulate_world(2500, 5000, WorldOptions(), rng)


def rescaled(graph, odometry, loops):
    """Return the graph with information that says its sigmas are so many times as large."""
    return retold(graph, times=np.where(graph.between.is_odometry, odometry, loops))


def test_repeated_and_parallel_factors():
    z = np.array([[1, 0, 0], [2, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0], [1, 0, 1.0]])
    pairs = [(0, 1), (0, 1), (0, 1), (1, 0), (1, 2), (2, 3), (2, 3)]
    graph = graph_of(4, pairs, z)
    # 2 repeats 0; 3 is the way back, which says something else; 6 has another angle than 5.
    assert repeated_factors(graph).tolist() == [2]
    assert parallel_factors(graph).tolist() == [0, 1, 2, 3, 5, 6]


def test_a_third_time_is_a_repetition_too():
    assert repeated_factors(graph_of(3, [(1, 2), (0, 1), (1, 2), (1, 2)])).tolist() == [2, 3]


def test_nothing_is_found_in_a_good_world(world):
    graph = world.graph
    assert not len(repeated_factors(graph)) and not len(parallel_factors(graph))
    assert not len(odometry_gaps(graph)) and len(connected_parts(graph)) == 1
    assert not len(long_steps(graph).factors)
    np.testing.assert_allclose(step_lengths(graph), 1, atol=0.3)


def test_parts_and_gaps():
    graph = graph_of(9, [(0, 1), (4, 3), (3, 6), (1, 2), (6, 4)])
    assert [part.tolist() for part in connected_parts(graph)] == [[0, 1, 2], [3, 4, 6], [5], [7],
                                                                  [8]]
    assert odometry_gaps(graph).tolist() == [2, 4, 5, 6, 7]


def test_long_steps():
    z = np.tile([0.3, 0.4, 0.0], (30, 1))
    z[[7, 19]] = [[6, 8, 0], [0, -5.1, 0]]
    pairs = [(k, k + 1) for k in range(30)]
    # The last is a loop, however long.
    found = long_steps(graph_of(31, [*pairs, (0, 9)], np.vstack((z, [100, 0, 0]))))
    assert found.factors.tolist() == [7, 19]
    np.testing.assert_allclose(found.lengths, [10, 5.1])
    assert found.ordinary == pytest.approx(0.5)


def test_a_robot_that_stands_has_no_long_steps():
    z = np.zeros((30, 3))
    z[4] = [1, 0, 0]
    assert not len(long_steps(graph_of(31, [(k, k + 1) for k in range(30)], z)).factors)


@pytest.mark.parametrize('odometry, loops', [
    (1, 1), (0.1, 1), (1, 0.1), (0.1, 10), (20, 0.05)])
def test_the_noise_of_each_group_is_found(world, rng, odometry, loops):
    """Of a world whose information is right, told that its sigmas are so many times as large."""
    found = noise_scales(rescaled(world.graph, odometry, loops), rng)
    assert found.odometry * odometry == pytest.approx(1, rel=0.06)
    assert found.loops * loops == pytest.approx(1, rel=0.06)
    assert (found.last - found.first, found.first % 1000) == (1999, 0)


def test_false_loops_look_like_noise(world, rng):
    loops = random_false_loops(world.graph, world.truth, 30, rng)
    found = noise_scales(insert_loops(world.graph, loops), rng)
    assert max(found.odometry, found.loops) > 3


@pytest.mark.parametrize('shape', ['streets', 'torus'])
def test_an_offset_that_loops_share_is_found(rng, shape):
    """Whichever way round they are listed; false loops that agree on nothing make none."""
    world = simulate_world(400, 1000, WorldOptions(), rng, shape)
    graph, manifold = world.graph, world.graph.manifold
    is_loop = ~graph.between.is_odometry
    backward = is_loop & (rng.random(len(is_loop)) < 0.5)
    shared = np.zeros(manifold.TANGENT_SIZE)
    shared[[0, -1]] = 0.2, 0.03
    lies = random_false_loops(graph, world.truth, 200, rng)
    for good in graph, turned(graph, backward), insert_loops(graph, lies):
        assert noise_scales(good, rng).offset is None
    off = np.where(is_loop[:, None], -shared, 0.0)
    shifted = retold(graph, manifold.retract(graph.between.measurement, off))
    for bad in shifted, turned(shifted, backward):
        np.testing.assert_allclose(noise_scales(bad, rng).offset, shared, atol=0.04)


def test_a_chain_and_a_loop_tell_nothing_of_noise(rng):
    graph = graph_of(40, [*((k, k + 1) for k in range(39)), (0, 39)])
    found = noise_scales(graph, rng)
    assert np.isnan(found.odometry) and np.isnan(found.loops)


def test_exact_measurements_have_no_noise(rng):
    """On a straight line: all that is left is rounding, and no warning is raised of zeros."""
    pairs = [(k, k + 1) for k in range(59)] + [(k, k + 5) for k in range(55)]
    z = np.array([[j - i, 0, 0] for i, j in pairs], float)
    found = noise_scales(graph_of(60, pairs, z), rng)
    assert found.odometry < 1e-3 and found.loops < 1e-3


def test_noise_is_judged_in_the_largest_part(rng):
    """Two worlds that nothing joins, and a window over both: the larger one is looked at."""
    small, large = (simulate_world(n, 3 * n, WorldOptions(), rng).graph for n in (60, 300))
    both = FactorGraph(se2)
    both.add_poses(360)
    for graph, start in (small, 0), (large, 60):
        factors = graph.between
        both.append_between(factors.i + start, factors.j + start, factors.measurement,
                            factors.sqrt_information)
    found = noise_scales(both, rng)
    assert (found.first, found.last) == (60, 359)
    assert found.loops == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize('name, odometry, loops', [
    ('intel', 0.65, 0.29), ('manhattan3500', 0.14, 0.165), ('city10000', 0.124, 0.126)])
def test_the_papers_graphs_state_too_little_information(datasets, rng, name, odometry, loops):
    """Chi2 per degree of freedom at their L2 optimum is .20, .023 and .016: the same finding."""
    found = noise_scales(read_graph_file(datasets / f'{name}.g2o').graph, rng)
    assert found.odometry == pytest.approx(odometry, rel=0.1)
    assert found.loops == pytest.approx(loops, rel=0.1)


def test_a_large_graph_is_looked_at_in_seconds(rng):
    """50,000 poses and 700,000 factors: a chain, and loops to one of the next twenty poses."""
    n, m = 50_000, 650_000
    i = rng.integers(n - 20, size=m)
    pairs = np.concatenate((np.stack((np.arange(n - 1), np.arange(1, n)), axis=1),
                            np.stack((i, i + rng.integers(2, 20, m)), axis=1)))
    z = np.zeros((len(pairs), 3))
    z[:, 0] = pairs[:, 1] - pairs[:, 0]
    graph = graph_of(n, pairs, z + 0.01 * rng.standard_normal(z.shape), 1e4 * np.eye(3))
    began = time.process_time()
    for look in repeated_factors, parallel_factors, connected_parts, odometry_gaps, long_steps:
        look(graph)
    found = noise_scales(graph, rng)
    assert time.process_time() - began < 10
    assert found.loops == pytest.approx(1, rel=0.05)


def test_what_nothing_is_compiled_for_is_what_the_compiled_loops_say(world):
    graph, poses = world.graph, world.odometry
    found, expected = _system(graph, poses), linearise(graph, poses)
    np.testing.assert_allclose(found.blocks, expected.blocks, atol=1e-9)
    np.testing.assert_allclose(found.b, expected.b, atol=1e-9)
    add_absolute(graph, np.array([7]), world.truth[7:8], np.eye(3)[None])
    cost = np.abs(whitened_residual(graph, poses)).sum()
    assert cost_at(graph, poses) == pytest.approx(cost, rel=1e-12)
