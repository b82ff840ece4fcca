# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A graph as a bag: every number comes back, read by two independent libraries."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.testing import assert_array_equal
from problems import EVERY, add_absolute, random_information, random_poses, retold
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from bags import TYPES, mcap_file, recording_of
from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.io.bags.from_graph import GRAPH_NOTE, VERBATIM_NOTE, write_graph_bag
from l1slam_ros.io.bags.reader import read_note
from l1slam_ros.io.bags.to_graph import DEFAULT_TOPICS, graph_from_bag
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.messages.conversion import loop_closure, odometry_sample

ROWS = np.array(se2.COVARIANCE_ROWS)


def record_of(pairs, rng, n=None, stamps=None):
    """Return a graph with random measurements between the pairs of keyframes; vertex ids 10 k."""
    i, j = np.array(pairs).T
    n = n or int(max(i.max(), j.max())) + 1
    graph = FactorGraph(se2, n)
    A = rng.normal(size=(len(i), 3, 3))
    graph.add_between(i, j, rng.normal(size=(len(i), 3)),
                      A @ A.transpose(0, 2, 1) + 0.1 * np.eye(3))
    return GraphRecord(graph, None, 10 * np.arange(n), stamps)


def read_with_rosbags(path):
    with AnyReader([path]) as reader:
        return [(c.topic, time, reader.deserialize(data, c.msgtype))
                for c, time, data in reader.messages()]


def read_with_mcap(path):
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with path.open('rb') as file:
        return [(channel.topic, message.log_time,
                 typestore.deserialize_cdr(message.data, schema.name))
                for schema, channel, message in make_reader(file).iter_messages()]


def stamp_of(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def covariances_of(factors, rows):
    roots = factors.sqrt_information[rows]
    return np.linalg.inv(roots.transpose(0, 2, 1) @ roots)


def assert_says(messages, record, stamps, tolerance):
    """Check odometry and loops against the factors: differences of poses, inverse information."""
    factors, index = record.graph.between, {int(s): k for k, s in enumerate(stamps)}
    odometry = [odometry_sample(m) for topic, _, m in messages if topic == '/odom']
    assert [s.stamp for s in odometry] == list(index)
    poses = se2.from_pose3(np.array([s.pose3 for s in odometry]))
    steps = np.flatnonzero(factors.is_odometry)
    steps = steps[np.argsort(factors.i[steps])]
    error = se2.residual(factors.measurement[steps], poses[:-1], poses[1:])
    assert np.abs(error).max() < tolerance
    assert not odometry[0].covariance.any()
    assert_covariances([s.covariance for s in odometry[1:]], covariances_of(factors, steps))

    loops = [loop_closure(m, 'base_link', False) for t, _, m in messages if t == '/loop_closures']
    rows = np.flatnonzero(~factors.is_odometry)
    rows = rows[np.argsort(factors.j[rows], kind='stable')]
    assert [index[m.reference_stamp] for m in loops] == factors.i[rows].tolist()
    assert [index[m.stamp] for m in loops] == factors.j[rows].tolist()
    measured = se2.from_pose3(np.array([m.pose3 for m in loops]))
    assert np.abs(se2.between(factors.measurement[rows], measured)).max() < 1e-14
    assert_covariances([m.covariance for m in loops], covariances_of(factors, rows))


def assert_covariances(found, expected):
    found = np.array(found)
    np.testing.assert_allclose(found[:, ROWS[:, None], ROWS], expected, rtol=1e-9, atol=1e-14)
    found[:, ROWS[:, None], ROWS] = 0
    assert not found.any()


@pytest.mark.parametrize('read', [read_with_rosbags, read_with_mcap])
def test_a_graph_comes_back(tmp_path, rng, read):
    pairs = [(0, 3), (2, 3), (0, 1), (1, 2), (0, 1), (3, 4), (1, 4), (0, 3), (0, 4)]
    record = record_of(pairs, rng)
    path = tmp_path / 'bag'
    write_graph_bag(path, record)
    messages = read(path if read is read_with_rosbags else path / 'bag.mcap')
    assert_says(messages, record, 10**12 + 10**8 * np.arange(5), 1e-15)
    assert [(topic, (time - 10**12) // 10**8) for topic, time, _ in messages] == [
        ('/odom', 0), ('/odom', 1), ('/loop_closures', 1), ('/odom', 2), ('/odom', 3),
        ('/loop_closures', 3), ('/loop_closures', 3), ('/odom', 4), ('/loop_closures', 4),
        ('/loop_closures', 4)]
    assert all(time == stamp_of(m.header) for _, time, m in messages)
    frames = [(m.header.frame_id, m.child_frame_id) for t, _, m in messages if t == '/odom']
    assert set(frames) == {('odom', 'base_link')}


def test_loops_that_are_trusted_or_struck_out_have_their_own_topics(tmp_path, rng):
    # Of those between 1 and 3 one was vouched for when both had been struck out.
    pairs = [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3), (1, 3)]
    record = record_of(pairs, rng)
    trusting = retold(record.graph, trusted=np.array([True, *3 * [False], True, False]))
    trusting.say(np.array([2, 5]), trusted=False)
    write_graph_bag(tmp_path / 'bag', replace(record, graph=trusting))
    topics = [topic for topic, _, _ in read_with_rosbags(tmp_path / 'bag')]
    assert topics == ['/odom', '/odom', '/odom', '/loop_closures', '/false_loop_closures', '/odom',
                      '/loop_closures', '/false_loop_closures', '/trusted_loop_closures']
    read = graph_from_bag(tmp_path / 'bag', None, DEFAULT_TOPICS).graph.between
    order = [0, 1, 3, 2, 5, 4]
    assert read.pairs.tolist() == [list(pairs[row]) for row in order]
    np.testing.assert_allclose(read.measurement, trusting.between.measurement[order], atol=1e-9)
    assert np.flatnonzero(read.struck).tolist() == [3, 4]
    assert np.flatnonzero(read.trusted).tolist() == [5]


@pytest.mark.parametrize('manifold', [se2, se3])
def test_factors_from_later_keyframes_to_earlier_ones_come_back(tmp_path, rng, manifold):
    pairs = np.array([(1, 0), (2, 1), (2, 3), (4, 3), (2, 0), (WORLD, 3), (1, 4), (3, 0), (1, 0),
                      (4, 2)])
    d, trusted = manifold.TANGENT_SIZE, np.arange(len(pairs)) == 4
    A = rng.normal(size=(len(pairs), d, d))
    graph = FactorGraph(manifold, 5)
    Z = manifold.retract(manifold.identity(len(pairs)), 0.8 * rng.normal(size=(len(pairs), d)))
    graph.add_between(*pairs.T, Z, A @ A.transpose(0, 2, 1) + 0.1 * np.eye(d), trusted)
    write_graph_bag(tmp_path / 'bag', GraphRecord(graph, None, np.arange(5)))
    back = graph_from_bag(tmp_path / 'bag', None, DEFAULT_TOPICS).graph.between
    of = graph.between
    rows = [int(np.argmin(np.abs(back.measurement - z).sum(axis=1))) for z in of.measurement]
    assert sorted(rows) == list(range(len(pairs)))
    assert_array_equal(back.pairs[rows], of.pairs)
    assert_array_equal(back.trusted[rows], trusted)
    np.testing.assert_allclose(back.measurement[rows], of.measurement, atol=1e-12)
    np.testing.assert_allclose(covariance_of(back.sqrt_information)[rows],
                               covariance_of(of.sqrt_information), rtol=1e-9, atol=1e-9)


def test_a_loop_that_stands_twice_number_for_number_is_meant(tmp_path, rng):
    record, path = record_of([(0, 1), (1, 2), (0, 2)], rng), tmp_path / 'bag'
    of = record.graph.between
    record.graph.append_between(of.i[2:], of.j[2:], of.measurement[2:], of.sqrt_information[2:])
    write_graph_bag(path, record)
    assert read_note(path) == GRAPH_NOTE | VERBATIM_NOTE
    assert len(graph_from_bag(path, None, DEFAULT_TOPICS).graph.between) == 4


def test_the_stamps_of_the_graph_are_kept(tmp_path, rng):
    stamps = np.array([1, 10**9 - 1, 1305031102175300121])
    record = record_of([(0, 1), (1, 2), (0, 2)], rng, stamps=stamps)
    write_graph_bag(tmp_path / 'bag', record)
    messages = read_with_mcap(tmp_path / 'bag' / 'bag.mcap')
    assert_says(messages, record, stamps, 1e-15)
    assert messages[-1][2].header.frame_id == 'base_link@0.000000001'


def test_the_same_graph_gives_the_same_bytes(tmp_path, rng):
    record = record_of([(0, 1), (1, 2), (0, 2)], rng)
    for folder in ('first', 'second'):
        (tmp_path / folder).mkdir()
        write_graph_bag(tmp_path / folder / 'bag', record)
    names = sorted(p.relative_to(tmp_path / 'first')
                   for p in (tmp_path / 'first').rglob('*') if p.is_file())
    assert names == [Path('bag/bag.mcap'), Path('bag/metadata.yaml')]
    for name in names:
        first, second = (tmp_path / folder / name for folder in ('first', 'second'))
        assert first.read_bytes() == second.read_bytes()


CHAIN = [(0, 1), (1, 2)]


def with_word(record, trusted):
    record.graph.add_between(WORLD, 1, np.zeros((1, 3)), np.eye(3)[None])
    record.graph.say(np.array([2]), trusted)
    return record


@pytest.mark.parametrize(('pairs', 'change', 'truth', 'message'), [
    ([(0, 1), (2, 3), (1, 3)], None, None, 'no edge between the consecutive vertices 10 and 20'),
    *((CHAIN, partial(with_word, trusted=trusted), None, 'the absolute pose of vertex 10 is '
       'trusted or struck out') for trusted in (True, False)),
    (CHAIN, None, np.zeros((2, 3)), '2 true poses; expected 3, one for each vertex'),
    (CHAIN, lambda _: GraphRecord(FactorGraph(se2), None, np.array([], int)), None,
     'has no vertices'),
    *((CHAIN, lambda record, stamps=stamps: replace(record, stamps=np.array(stamps)), None,
       f'vertex {vertex} has the stamp') for stamps, vertex in (
        ([5, 5, 6], 10), ([5, 7, 6], 20), ([0, 1, 2], 0), ([1, 2, 2**31 * 10**9], 20)))])
def test_what_messages_cannot_express_exactly(tmp_path, rng, pairs, change, truth, message):
    record = record_of(pairs, rng)
    with pytest.raises(GraphError, match=message):
        write_graph_bag(tmp_path / 'bag', change(record) if change else record, truth)
    assert list(tmp_path.iterdir()) == []


def test_absolute_poses_come_back_as_they_went(tmp_path, rng):
    record = record_of([(0, 1), (1, 2)], rng)
    graph, measured = record.graph, random_poses(3, rng)
    measured[1, 2] = 0.0
    add_absolute(graph, np.array([1, 0, 2]), measured, np.stack(
        [random_information(1, rng)[0], np.diag([4.0, 9, 0]), np.diag([0, 0, 25.0])]))
    graph.add_between(0, 2, measured[:1], np.diag([0, 4.0, 9])[None])
    write_graph_bag(tmp_path / 'bag', record)
    found = graph_from_bag(tmp_path / 'bag', None, DEFAULT_TOPICS)
    assert found.skipped == ()
    mine, theirs = graph.between, found.graph.between
    for factors in mine, theirs:
        assert factors.is_absolute.sum() == 3
    order = np.lexsort((mine.i, mine.j)), np.lexsort((theirs.i, theirs.j))
    for name in ('i', 'j', 'measurement', 'sqrt_information'):
        np.testing.assert_allclose(getattr(mine, name)[order[0]], getattr(theirs, name)[order[1]],
                                   atol=1e-9)


def test_a_slash_before_the_map_frame_says_nothing(tmp_path, rng):
    """It was the habit of ROS 1."""
    record, k = record_of([(0, 1), (1, 2)], rng), np.arange(3)
    add_absolute(record.graph, k, random_poses(3, rng), random_information(3, rng))
    write_graph_bag(tmp_path / 'bag', record)
    recording = []
    for topic, kind, time, data in recording_of(tmp_path / 'bag'):
        message = TYPES.deserialize_cdr(data, kind)
        message.header.frame_id = message.header.frame_id.replace('map', '/map')
        recording.append((topic, kind, time, bytes(TYPES.serialize_cdr(message, kind))))
    found = graph_from_bag(mcap_file(tmp_path / 'a.mcap', recording), EVERY, DEFAULT_TOPICS)
    assert found.skipped == () and found.graph.between.is_absolute.sum() == 3


def test_a_single_keyframe(tmp_path):
    graph = FactorGraph(se2, 1)
    write_graph_bag(tmp_path / 'bag', GraphRecord(graph, None, np.array([0])))
    assert [topic for topic, _, _ in read_with_rosbags(tmp_path / 'bag')] == ['/odom']
