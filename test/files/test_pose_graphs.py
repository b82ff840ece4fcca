# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs of other front ends, in their own messages: from bags."""

import numpy as np
import pytest
from command import run
from pose_graphs import (
    COVARIANCE,
    GLOBAL,
    LANDMARK,
    LOOPCLOSE,
    ODOM,
    PRIOR,
    REJECTED,
    SECOND,
    SIGMA,
    VIRTUAL,
    driven,
    edge,
    growing,
    link,
    map_graph,
    pose_graph,
    write,
)
from records import information_of, read
from worlds import between


@pytest.fixture
def truth(rng):
    return rng.normal(size=(6, 3))


@pytest.mark.parametrize('ends', [(1, 6), (6, 1)])
def test_a_link_is_a_loop_between_the_times_of_its_keyframes(tmp_path, truth, ends):
    """Whichever way it points: the later keyframe seen from the earlier, its noise in its axes."""
    graphs = growing(truth, [link(*ends, GLOBAL, truth)])
    graphs.append(graphs[-1])  # it is repeated in every message from then on
    record = read(write(tmp_path / 'bag', [
        *driven(truth), *(('/graph', 10 + k, graph) for k, graph in enumerate(graphs))]),
        loop_topic='/graph')
    assert record.skipped == ()
    assert record.stamps.tolist() == [(10 + k) * SECOND for k in range(6)]
    factors = record.graph.between
    (row,) = np.flatnonzero(~factors.is_odometry)
    assert factors.pairs[row].tolist() == [0, 5] and not factors.trusted[row]
    expected = between(truth[0], truth[5])
    assert np.allclose(factors.measurement[row], expected)
    turned = COVARIANCE[np.ix_((0, 1, 5), (0, 1, 5))]
    if ends == (6, 1):  # by the adjoint of the inverse
        x, y, heading = between(expected, np.zeros(3))
        c, s = np.cos(heading), np.sin(heading)
        Ad = np.array([[c, -s, y], [s, c, -x], [0, 0, 1]])
        turned = Ad @ turned @ Ad.T
    assert np.allclose(np.linalg.inv(information_of(record.graph)[row]), turned)


def test_only_what_was_measured_between_two_keyframes_is_a_loop(tmp_path, truth):
    closing = [link(6, 1, VIRTUAL, truth), link(6, 6, PRIOR, truth), link(6, 2, LANDMARK, truth)]
    record = read(write(tmp_path / 'bag', [*driven(truth), *(
        ('/graph', 10 + k, graph) for k, graph in enumerate(growing(truth, closing)))]),
        loop_topic='/graph')
    assert record.graph.between.is_odometry.all() and record.skipped == ()


def test_a_front_end_that_begins_anew_has_its_numbers_again(tmp_path, truth):
    """A keyframe of unknown time is never given that of another with its number."""
    late = growing(truth, [])[-1]
    anew = [map_graph(100 + k, range(1, k + 2), []) for k in range(5)]
    closing = [link(6, 3, GLOBAL, truth), link(6, 1, GLOBAL, truth)]
    record = read(write(tmp_path / 'bag', [
        *driven(truth), ('/graph', 15, late), *driven(truth, 100.0),
        *(('/graph', 100 + k, graph) for k, graph in enumerate(anew)),
        ('/graph', 105, map_graph(105, range(1, 7), closing))]), loop_topic='/graph')
    loops = record.graph.between.pairs[~record.graph.between.is_odometry]
    assert (record.stamps[loops] // SECOND).tolist() == [[102, 105]]
    assert any(one.startswith('1 message refused: a loop of keyframe 1, whose stamp no')
               for one in record.skipped)


def test_a_pose_graph_tells_the_times_and_whose_they_are(tmp_path, truth):
    """The second message adds to the first; another robot's graph is not ours."""
    unset = np.full((6, 6), -1.0)
    graphs = [pose_graph(20, [(k, 10.0 + k) for k in range(1, 7)], [
        edge(1, 2, ODOM, truth), edge(1, 5, LOOPCLOSE, truth),
        edge(2, 6, LOOPCLOSE, truth, unset), edge(1, 4, REJECTED, truth),
        edge(3, 6, LOOPCLOSE, truth, robots=(0, 1))]),
        pose_graph(21, [], [edge(6, 3, LOOPCLOSE, truth)]),
        pose_graph(22, [(9, 30.0)], [edge(1, 6, LOOPCLOSE, truth, robots=(1, 1))], 1)]
    record = read(write(tmp_path / 'bag', [*driven(truth, 11.0), *(
        ('/graph', 20 + k, graph) for k, graph in enumerate(graphs))]), loop_topic='/graph')
    rows = ~record.graph.between.is_odometry
    pairs = record.graph.between.pairs[rows].tolist()
    assert sorted(pairs) == [[0, 4], [1, 5], [2, 5]]
    stated = information_of(record.graph)[rows][pairs.index([0, 4])]
    assert np.allclose(np.linalg.inv(stated), COVARIANCE[np.ix_((0, 1, 5), (0, 1, 5))])


@pytest.fixture
def bag(tmp_path, truth):
    """A bag with odometry, and the graphs of RTAB-Map and of pose_graph_tools."""
    graphs = growing(truth, [link(6, 1, GLOBAL, truth)])
    return write(tmp_path / 'bag', [
        *driven(truth), *(('/rtabmap/mapGraph', 10 + k, graph) for k, graph in enumerate(graphs)),
        ('/kimera/pose_graph', 20, pose_graph(
            20, [(k, 9.0 + k) for k in range(1, 7)],
            [edge(k, k + 1, ODOM, truth) for k in range(1, 6)] + [edge(1, 6, LOOPCLOSE, truth)]))])


@pytest.mark.parametrize('topic', ['/rtabmap/mapGraph', '/kimera/pose_graph'])
def test_from_a_bag_come_the_loops_or_the_whole_graph(bag, truth, topic):
    """The definitions are those in the bag: no package is installed that knows them."""
    graph = read(bag, loop_topic=topic).graph
    loops = graph.between.pairs[~graph.between.is_odometry]
    assert loops.tolist() == [[0, graph.n_poses - 1]]
    whole = read(bag, odom_topic=topic)
    factors = whole.graph.between
    assert whole.ids.tolist() == [1, 2, 3, 4, 5, 6] and not whole.skipped
    assert factors.is_odometry.tolist() == [True] * 5 + [False]
    assert np.allclose(whole.graph.manifold.residual(
        factors.measurement, truth[factors.i], truth[factors.j]), 0)
    sigma = 1 / np.diagonal(factors.sqrt_information, axis1=1, axis2=2)
    assert np.allclose(sigma, SIGMA[[0, 1, 5]])


@pytest.mark.parametrize('key', [2**63, 2**64 - 1])
def test_a_key_beyond_63_bits_is_one_line(capsys, tmp_path, truth, key):
    beyond = edge(6, 1, LOOPCLOSE, truth)
    beyond.key_to = key
    message = pose_graph(20, [(k, 9.0) for k in (*range(1, 7), key)], [
        *(edge(k, k + 1, ODOM, truth) for k in range(1, 6)), beyond])
    write(tmp_path / 'bag', [('/pose_graph', 1, message)])
    out, _ = run(capsys, 'info', tmp_path / 'bag', '--odom-topic', '/pose_graph', code=3)
    assert 'poses       6 in SE2, ids 1 to 6' in out
    assert f'an edge of keyframe {key}; expected numbers up to 2^63 - 1' in out
