# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What drivers and simulators really send, through the whole back end: the map goes on."""

from dataclasses import replace

import numpy as np
import pytest
from problems import (
    EVERY,
    PERIOD,
    covariance6,
    hear,
    loop,
    messages,
    odometry,
    retold,
    seconds,
)

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.running.backend import Backend, BackendOptions, RobustOptions
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file


def backend_after(graph, options, every=50, copies=1, spoil=lambda k, covariance: covariance):
    """Return the back end that heard a graph pose by pose and was updated, then settled."""
    backend = Backend(options)
    for message in messages(graph):
        if isinstance(message, LoopClosure):
            hear(backend, copies * [message])
            continue
        k = round(message.stamp / seconds(PERIOD))
        if k % every == 0:
            backend.update(0.1)
        backend.add_odometry(replace(message, covariance=spoil(k, message.covariance)))
    backend.settle()
    return backend


@pytest.mark.parametrize('robust', [True, False])
def test_intel_with_absurd_variances_and_every_loop_five_times(datasets, robust):
    graph = read_graph_file(datasets / 'intel.g2o').graph
    options = replace(EVERY, robust=RobustOptions(robust))
    rng = np.random.default_rng(0)
    absurd = dict(zip(rng.permutation(np.arange(1, 943))[:80].tolist(),
                      40 * [covariance6(v * np.eye(3)) for v in (1e12, 1e-20)], strict=True))
    clean = backend_after(graph, options)
    spoiled = backend_after(graph, options, 30, 5, lambda k, sound: absurd.get(k, sound))
    assert len(spoiled.poses) == 943
    off = np.hypot(*(spoiled.poses - clean.poses)[:, :2].T)
    assert off.max() < 0.15
    assert (spoiled.loop_states().state == ACCEPTED).sum() == 893
    # 895 loops, two of which stand in the file twice.
    assert spoiled.counts()[1]['repeated'] == 5 * 895 - 893
    assert spoiled._keeper._builder.notes.warned['odometry_variance'] == 80 * 3


VARIANCES = [1e-300, 1e-30, 1e-20, 1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e12, 1e30, 1e300]


@pytest.mark.parametrize('component', [[0], [2], [0, 1, 2]])
@pytest.mark.parametrize('source', ['increment', 'twist', 'loop'])
@pytest.mark.parametrize('period', [0.0, 0.4])
def test_no_variance_makes_an_update_fail(source, component, period, rng):
    """Any at all, a message in ten; keyframes of one message and of several."""
    world = simulate_world(300, 420, WorldOptions(), rng)
    factors, chain = world.graph.between, odometry_poses(world.graph)
    options = BackendOptions(KeyframeOptions(0.0, 0.0, period),
                             OdometryOptions('model' if source == 'loop' else source))
    backend = Backend(options)
    sound = np.diag([0.02, 0.02, 0.002])

    def stated(k, mine):
        covariance = sound.copy()
        if mine and k % 10 == 5:
            covariance[component, component] = VARIANCES[k // 10 % len(VARIANCES)]
        return covariance6(covariance)

    loops = np.flatnonzero(~factors.is_odometry)
    with np.errstate(all='raise', under='ignore'):
        for k, pose in enumerate(chain):
            backend.add_odometry(odometry(k * PERIOD, pose, stated(k, source == 'increment'),
                                          stated(k, source == 'twist') / PERIOD**2))
            for n in np.flatnonzero(factors.j[loops] == k).tolist():
                backend.add_loop(loop(factors.i[loops[n]] * PERIOD, k * PERIOD,
                                      factors.measurement[loops[n]],
                                      stated(n, source == 'loop')))
        backend._keeper._builder.add_due_loops()
    for _ in range(3):
        backend.update(0.1)
    backend.settle()
    assert np.isfinite(backend.poses).all()
    assert len(backend.poses) == backend.snapshot().graph.n_poses
    off = np.hypot(*(se2.between(backend.poses[:1], backend.poses))[:, :2].T)
    assert off.max() < 2 * np.hypot(*chain[:, :2].T).max() + 10
    assert backend._keeper._builder.notes.warned


def exact_world(n, edges, rng, false_loops):
    """Return a graph whose odometry has noise and whose loops have none, and its truth."""
    world = simulate_world(n, edges, WorldOptions(), rng)
    factors = world.graph.between
    exact = se2.between(world.truth[factors.i], world.truth[factors.j])
    graph = retold(world.graph, np.where(factors.is_odometry[:, None], factors.measurement, exact))
    if false_loops:
        graph = insert_loops(graph, FALSE_LOOPS['random'](graph, world.truth, false_loops, rng))
    return graph, world.truth


@pytest.mark.parametrize('lies', [0, 2001])
def test_loops_without_noise_are_believed(lies, rng):
    """A simulator's: the noise that is learnt of them does not run to nothing."""
    graph, truth = exact_world(1000, 3000, rng, lies)
    solution, _ = robust_solve(graph)
    factors = graph.between
    exact = np.abs(se2.residual(factors.measurement, truth[factors.i], truth[factors.j])
                   ).max(axis=1) < 1e-9
    loops = ~factors.is_odometry
    assert (loops & exact).sum() == 2001
    assert (solution.accepted == exact)[loops].mean() > 0.99
    assert not (solution.accepted & ~exact)[loops].any()
    assert solution.variance.min() >= 1e-4


@pytest.mark.parametrize('lies', [1001])
def test_loops_without_noise_while_the_map_grows(lies, rng):
    graph, truth = exact_world(600, 1600, rng, lies)
    backend = backend_after(graph, EVERY, 5)
    off = np.hypot(*(se2.between(backend.poses[:1], backend.poses)
                     - se2.between(truth[:1], truth))[:, :2].T)
    assert off.max() < 0.5
    states = backend.loop_states()
    assert (states.state == ACCEPTED).sum() == 1001
    # False ones came in the order of their ends: told by what they measure.
    rows = states.rows[states.state[:len(states.rows)] == ACCEPTED]
    used = backend.snapshot().graph.between
    exact = se2.between(truth[used.i[rows]], truth[used.j[rows]])
    assert np.abs(se2.local(exact, used.measurement[rows])).max() < 1e-6


def turned_back(loop):
    """Return a loop as seen from its later end."""
    Ad, pose = se3.adjoint(loop.pose3[None])[0], se3.inverse(loop.pose3[None])[0]
    return replace(loop, reference_stamp=loop.stamp, stamp=loop.reference_stamp, pose3=pose,
                   covariance=Ad @ loop.covariance @ Ad.T)


def test_a_loop_that_leads_back_is_turned_round(rng):
    """The measurement inverted, the covariance seen from its other end: the same factor."""
    forward = []
    for message in messages(simulate_world(60, 90, WorldOptions(), rng).graph):
        if isinstance(message, LoopClosure):
            root = 0.1 * rng.standard_normal((6, 6))
            message = replace(message, covariance=root @ root.T)
        forward.append(message)
    back = [turned_back(one) if isinstance(one, LoopClosure) else one for one in forward]
    assert sum(isinstance(one, LoopClosure) for one in back) == 31
    found = []
    for heard in (forward, back):
        hear(backend := Backend(EVERY), heard)
        backend.settle()
        found.append(backend.snapshot())
    one, other = (now.graph.between for now in found)
    np.testing.assert_array_equal(other.pairs, one.pairs)
    np.testing.assert_allclose(other.measurement, one.measurement, atol=1e-9)
    np.testing.assert_allclose(other.sqrt_information, one.sqrt_information, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found[1].poses, found[0].poses, atol=1e-6)


def test_a_strike_may_name_its_times_either_way_round():
    backend = Backend(EVERY)
    for k in range(12):
        backend.add_odometry(odometry(k * PERIOD, [k, 0, 0]))
    backend.add_loop(loop(PERIOD, 9 * PERIOD, [8.0, 0, 0]))
    backend.add_loop(replace(loop(9 * PERIOD, PERIOD, [0.0, 0, 0]), struck=True))
    backend.settle()
    assert backend.snapshot().graph.between.struck.sum() == 1


def test_a_loop_that_leads_back_and_leaves_a_component_unsaid_is_refused():
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, np.inf])
    message = replace(loop(9 * PERIOD, PERIOD, [0.0, 0, 0]), covariance=covariance)
    with pytest.raises(MessageError, match=' ns does not measure all components; expected its e'):
        Backend(EVERY).add_loop(message)
