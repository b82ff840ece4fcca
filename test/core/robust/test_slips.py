# SPDX-License-Identifier: Apache-2.0
"""Odometry factors that lie are left out, others stay; the rest of it is in `test_batch.py`."""

import numpy as np
import pytest
from lies import careful_world, spoilt
from test_pairwise_consistency import STEP, grown, slipped

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.slips import unusual_motion, without_slip


@pytest.fixture(scope='module')
def bad():
    return spoilt(careful_world(400, 800), 'random', 100)


def test_a_slip_is_cut_and_loops_come_in(bad):
    growth = grown(slipped(bad.graph, STEP))
    before, loops = growth.cut.copy(), np.count_nonzero(growth.accepted & growth.is_loop)
    found = without_slip(growth)
    (cut,) = np.flatnonzero(found.cut)
    assert abs(growth.low[cut] - STEP) <= 3
    assert np.count_nonzero(found.accepted & found.is_loop) > loops + 10
    np.testing.assert_array_equal(growth.cut, before)  # it was tried in a copy


def test_without_a_slip_nothing_is_left_out(bad):
    assert without_slip(grown(bad.graph)) is None


@pytest.mark.parametrize('stated', [1.0, 10.0])
def test_what_is_within_the_noise_as_stated_is_no_slip(stated):
    """40 sigmas are a slip; 4 are none, though loops that know better all speak against it."""
    world, turn = spoilt(careful_world(400, 800), 'random', 100), np.array([[0.0, 0.0, 0.2]])
    factors, graph = world.graph.between, FactorGraph(se2)
    row, measurement = factors.is_odometry & (factors.i == STEP), factors.measurement.copy()
    measurement[row] = se2.retract(measurement[row], turn)
    roots = factors.sqrt_information / stated
    graph.add_poses(world.graph.n_poses)
    graph.add_between(factors.i, factors.j, measurement, roots.transpose(0, 2, 1) @ roots)
    assert (without_slip(grown(graph)) is None) == (stated > 1)


def test_a_jump_is_unusual_and_what_all_do_is_not():
    graph = careful_world(200, 200).graph
    usual = unusual_motion(graph, graph.between.measurement)
    jump = unusual_motion(graph, np.array([[30.0, 0.0, 0.0]]))
    assert jump[0] > 10 * usual.max()
    assert 0 < np.median(usual) < 10


def test_one_step_alone_is_not_unusual():
    graph = FactorGraph(se2)
    graph.add_poses(2)
    graph.add_between(np.zeros(1, int), np.ones(1, int), np.array([[1.0, 0, 0]]), np.eye(3)[None])
    np.testing.assert_array_equal(unusual_motion(graph, graph.between.measurement), [0.0])
