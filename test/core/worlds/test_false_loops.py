# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""False loops: far, new, each kind as it is meant, and put in at their time."""

import numpy as np
import pytest
from problems import add_absolute

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.worlds.false_loops import (
    FALSE_LOOPS,
    Loops,
    grouped_false_loops,
    identity_false_loops,
    insert_loops,
    random_false_loops,
)
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

NOISE = WorldOptions(odometry_sigma_translation=0.02, loop_sigma_translation=0.07)


@pytest.fixture
def world(rng):
    return simulate_world(1000, 2500, NOISE, rng)


def chain_graph(n):
    """A drive of n poses straight on, without loops."""
    graph = FactorGraph(se2, n)
    k = np.arange(n - 1)
    graph.add_between(k, k + 1, np.tile([1.0, 0.0, 0.0], (n - 1, 1)),
                      np.tile(np.diag([4.0, 4.0, 9.0]), (n - 1, 1, 1)))
    return graph, np.stack((np.arange(n), 0 * np.arange(n), 0 * np.arange(n)), axis=1) * 1.0


@pytest.mark.parametrize('kind', FALSE_LOOPS)
def test_they_are_far_new_and_in_order_of_time(kind, world, rng):
    loops = FALSE_LOOPS[kind](world.graph, world.truth, 300, rng)
    assert len(loops.i) == len(loops.j) == len(loops.measurement) == len(loops.information) == 300
    assert (loops.j - loops.i >= 100).all()
    assert loops.i.min() >= 0 and loops.j.max() < 1000
    positions = world.truth[:, :2]
    diagonal = np.linalg.norm(np.ptp(positions, axis=0))
    distance = np.linalg.norm(positions[loops.i] - positions[loops.j], axis=1)
    assert (distance >= diagonal / 10).all()
    factors = world.graph.between
    existing = set(zip(factors.i.tolist(), factors.j.tolist(), strict=True))
    pairs = list(zip(loops.j.tolist(), loops.i.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert not existing & {(i, j) for j, i in pairs}


def test_none_is_near_where_the_robot_was_near(rng):
    """Two rounds of one circle: poses a round apart are far in time, not in space."""
    n = 200
    angle = np.arange(n) * 2 * np.pi / 100
    poses = np.stack((10 * np.cos(angle), 10 * np.sin(angle), angle), axis=1)
    graph, _ = chain_graph(n)
    loops = random_false_loops(graph, poses, 500, rng)
    apart = np.abs((loops.j - loops.i + 50) % 100 - 50)
    assert apart.min() >= 5


def test_random_ones_claim_to_be_near(world, rng):
    offset = random_false_loops(world.graph, world.truth, 2000, rng).measurement
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose(offset.std(axis=0), [0.3, 0.3, np.radians(10)], rtol=0.1)


def test_identity_ones_measure_nothing(world, rng):
    loops = identity_false_loops(world.graph, world.truth, 50, rng)
    np.testing.assert_array_equal(loops.measurement, 0)


def test_grouped_ones_agree_through_the_odometry(world, rng):
    loops = grouped_false_loops(world.graph, world.truth, 200, rng)
    factors = world.graph.between
    odometry = factors.measurement[factors.is_odometry]
    found = {(i, j): z for i, j, z in zip(loops.i.tolist(), loops.j.tolist(), loops.measurement,
                                          strict=True)}
    heads = [pair for pair in found if (pair[0] - 1, pair[1] - 1) not in found]
    sizes = []
    for i, j in heads:
        k = 0
        assert np.linalg.norm(found[i, j][:2]) < 2
        while (i + k + 1, j + k + 1) in found:
            # i -> i + 1 -> j + 1 and i -> j -> j + 1 are the same way.
            one = se2.compose(odometry[i + k], found[i + k + 1, j + k + 1])
            other = se2.compose(found[i + k, j + k], odometry[j + k])
            np.testing.assert_allclose(se2.between(one, other), 0, atol=1e-9)
            k += 1
        sizes.append(k + 1)
    assert sum(sizes) == 200
    # Two runs may touch by chance; the last one may be short.
    assert sum(10 <= size <= 20 for size in sizes) >= len(sizes) - 2


@pytest.mark.parametrize('count', [0, 1, 9, 10, 25])
def test_grouped_ones_come_in_any_number(count, world, rng):
    assert len(grouped_false_loops(world.graph, world.truth, count, rng).i) == count


def test_without_loops_they_are_as_sure_as_odometry(rng):
    graph, poses = chain_graph(100)
    information = random_false_loops(graph, poses, 3, rng).information
    np.testing.assert_allclose(information, [np.diag([4.0, 4.0, 9.0])] * 3, rtol=1e-12)


def test_they_take_the_median_information(rng):
    graph, poses = chain_graph(100)
    correlated = np.array([[3.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]])
    graph.add_between(np.array([0, 0, 0]), np.array([5, 6, 7]), np.zeros((3, 3)),
                      np.stack((100 * correlated, correlated, 0.01 * correlated)))
    information = random_false_loops(graph, poses, 1, rng).information
    np.testing.assert_allclose(information[0], correlated, rtol=1e-12)


@pytest.mark.parametrize('kind', FALSE_LOOPS)
def test_too_many_are_refused(kind, rng):
    graph, poses = chain_graph(12)
    with pytest.raises(GraphError, match='67 false loops asked for, found .* among 12'):
        FALSE_LOOPS[kind](graph, poses, 67, rng)


@pytest.mark.parametrize('kind', FALSE_LOOPS)
def test_a_graph_without_factors_is_refused(kind, rng):
    graph = FactorGraph(se2, 100)
    poses = np.stack([np.arange(100.0)] * 3, axis=1)
    with pytest.raises(GraphError, match='factor'):
        FALSE_LOOPS[kind](graph, poses, 20, rng)


def test_inserting_keeps_what_was_there(rng):
    """Also an order that is not that of time, parallel factors and an absolute one."""
    graph = FactorGraph(se2, 9)
    i, j = np.array([0, 1, 7, 1, 2]), np.array([1, 2, 8, 2, 0])
    z = rng.normal(size=(5, 3))
    information = np.stack([np.eye(3) * k for k in range(1, 6)])
    graph.add_between(i, j, z, information)
    add_absolute(graph, np.array([4]), np.array([[1.0, 2.0, 3.0]]), 7 * np.eye(3)[None])
    loops = Loops(np.array([0, 0]), np.array([1, 8]), np.ones((2, 3)),
                  np.stack((50 * np.eye(3), 60 * np.eye(3))))
    longer = insert_loops(graph, loops)
    factors = longer.between
    assert factors.i.tolist() == [0, 0, 1, 7, 1, 2, WORLD, 0]
    assert factors.j.tolist() == [1, 1, 2, 8, 2, 0, 4, 8]
    np.testing.assert_array_equal(factors.measurement[[0, 2, 3, 4, 5]], z)
    roots = np.sqrt([1, 50, 2, 3, 4, 5, 7, 60])
    np.testing.assert_allclose(factors.sqrt_information, roots[:, None, None] * np.eye(3))
    assert longer.n_poses == 9 and len(graph.between) == 6


def test_more_loops_than_pairs_are_refused_before_memory_is_taken(rng):
    graph, poses = chain_graph(100)
    for make in FALSE_LOOPS.values():
        with pytest.raises(GraphError, match='found 4950 pairs among 100 keyframes'):
            make(graph, poses, 10**15, rng)
