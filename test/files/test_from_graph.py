# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A graph as a bag: every number comes back, read by another library."""

import numpy as np
import pytest
from command import run
from numpy.testing import assert_array_equal
from records import information_of, read
from rosbags.highlevel import AnyReader
from worlds import write_g2o

import l1slam_ros as l1

ROWS = np.array([0, 1, 5])  # x, y, heading


@pytest.fixture
def record_of(tmp_path_factory, rng):
    """Return a function that makes a graph with random measurements between the pairs."""
    def make(pairs, stamps=None):
        A = rng.normal(size=(len(pairs), 3, 3))
        return read(write_g2o(
            tmp_path_factory.mktemp('source') / 'a.g2o', pairs, rng.normal(size=(len(pairs), 3)),
            A @ A.transpose(0, 2, 1) + 0.1 * np.eye(3), stamps,
            10 * np.arange(1 + np.max(pairs))))
    return make


def read_with_rosbags(path):
    with AnyReader([path]) as reader:
        return [(c.topic, time, reader.deserialize(data, c.msgtype))
                for c, time, data in reader.messages()]


def stamp_of(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def poses_of(messages):
    """Return poses in the plane, (m, 3), and covariances, (m, 6, 6), of messages with both."""
    poses = []
    for message in messages:
        pose = message.pose.pose
        at, turn = pose.position, pose.orientation
        assert (at.z, turn.x, turn.y) == (0, 0, 0)
        poses.append((at.x, at.y, 2 * np.arctan2(turn.z, turn.w)))
    return np.array(poses), np.array([m.pose.covariance.reshape(6, 6) for m in messages])


def assert_covariances(found, expected):
    found = np.array(found)
    np.testing.assert_allclose(found[:, ROWS[:, None], ROWS], expected, rtol=1e-9, atol=1e-14)
    found[:, ROWS[:, None], ROWS] = 0
    assert not found.any()


@pytest.mark.parametrize('stamps', [
    None, np.array([1, 10**9 - 1, 10**9, 10**9 + 1, 1305031102175300121])])
def test_a_graph_comes_back(tmp_path, record_of, stamps):
    pairs = [(0, 3), (2, 3), (0, 1), (1, 2), (0, 1), (3, 4), (1, 4), (0, 3), (0, 4)]
    record = record_of(pairs, stamps)
    record.write(tmp_path / 'bag')
    messages = read_with_rosbags(tmp_path / 'bag')
    stamps = (10**12 + 10**8 * np.arange(5) if stamps is None else stamps).tolist()
    factors, manifold = record.graph.between, record.graph.manifold
    stated = np.linalg.inv(information_of(record.graph))
    odometry = [m for topic, _, m in messages if topic == '/odom']
    assert [stamp_of(m.header) for m in odometry] == stamps
    poses, covariances = poses_of(odometry)
    steps = np.flatnonzero(factors.is_odometry)
    steps = steps[np.argsort(factors.i[steps])]
    error = manifold.residual(factors.measurement[steps], poses[:-1], poses[1:])
    assert np.abs(error).max() < 1e-15
    assert not covariances[0].any()
    assert_covariances(covariances[1:], stated[steps])
    loops = [m for topic, _, m in messages if topic == '/loop_closures']
    rows = np.flatnonzero(~factors.is_odometry)
    rows = rows[np.argsort(factors.j[rows], kind='stable')]
    assert [m.header.frame_id for m in loops] == [
        f'base_link@{stamps[i] // 10**9}.{stamps[i] % 10**9:09}' for i in factors.i[rows]]
    assert [stamp_of(m.header) for m in loops] == [stamps[j] for j in factors.j[rows]]
    measured, covariances = poses_of(loops)
    assert np.abs(manifold.between(factors.measurement[rows], measured)).max() < 1e-14
    assert_covariances(covariances, stated[rows])
    assert [(topic, stamps.index(time)) for topic, time, _ in messages] == [
        ('/odom', 0), ('/odom', 1), ('/loop_closures', 1), ('/odom', 2), ('/odom', 3),
        ('/loop_closures', 3), ('/loop_closures', 3), ('/odom', 4), ('/loop_closures', 4),
        ('/loop_closures', 4)]
    assert all(time == stamp_of(m.header) for _, time, m in messages)
    frames = [(m.header.frame_id, m.child_frame_id) for t, _, m in messages if t == '/odom']
    assert set(frames) == {('odom', 'base_link')}


def test_loops_that_are_trusted_or_struck_out_have_their_own_topics(tmp_path, record_of):
    # Of those between 1 and 3 one was vouched for when both had been struck out.
    pairs = [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3), (1, 3)]
    record = record_of(pairs)
    record.graph.say(np.array([0, 4]), trusted=True)
    record.graph.say(np.array([2, 5]), trusted=False)
    record.write(tmp_path / 'bag')
    topics = [topic for topic, _, _ in read_with_rosbags(tmp_path / 'bag')]
    assert topics == ['/odom', '/odom', '/odom', '/loop_closures', '/false_loop_closures', '/odom',
                      '/loop_closures', '/false_loop_closures', '/trusted_loop_closures']
    back = read(tmp_path / 'bag').graph.between
    order = [0, 1, 3, 2, 5, 4]
    assert back.pairs.tolist() == [list(pairs[row]) for row in order]
    np.testing.assert_allclose(back.measurement, record.graph.between.measurement[order],
                               atol=1e-9)
    assert np.flatnonzero(back.struck).tolist() == [3, 4]
    assert np.flatnonzero(back.trusted).tolist() == [5]


@pytest.mark.parametrize('size', [3, 6])
def test_factors_from_later_keyframes_to_earlier_ones_come_back(tmp_path, rng, size):
    pairs = np.array([(1, 0), (2, 1), (2, 3), (4, 3), (2, 0), (-1, 3), (1, 4), (3, 0), (1, 0),
                      (4, 2), (-1, 0), (-1, 2), (0, 2)])
    trusted = np.arange(len(pairs)) == 4
    A = rng.normal(size=(len(pairs), size, size))
    Z = 0.8 * rng.normal(size=(len(pairs), 3 if size == 3 else 7))
    Z[:, 3:] = np.array([0, 0, 0, 1])[:Z.shape[1] - 3] + 0.4 * Z[:, 3:]
    Z[:, 3:] /= np.linalg.norm(Z[:, 3:], axis=1, keepdims=True) if size == 6 else 1
    information = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(size)
    if size == 3:  # of a position, of a heading, and of a loop that says nothing of one way
        Z[10, 2] = 0.0
        information[10:] = np.diag([4.0, 9, 0]), np.diag([0, 0, 25.0]), np.diag([0, 4.0, 9])
    record = read(write_g2o(tmp_path / 'a.g2o', pairs, Z, information),
                  rotation_information='angle')
    record.graph.say(np.array([4]), trusted=True)
    record.write(tmp_path / 'bag')
    found = read(tmp_path / 'bag').graph
    back, of = found.between, record.graph.between
    rows = [int(np.argmin(np.abs(back.measurement - z).sum(axis=1))) for z in of.measurement]
    assert sorted(rows) == list(range(len(pairs)))
    assert_array_equal(back.pairs[rows], of.pairs)
    assert_array_equal(back.trusted[rows], trusted)
    np.testing.assert_allclose(back.measurement[rows], of.measurement, atol=1e-12)
    np.testing.assert_allclose(information_of(found)[rows], information_of(record.graph),
                               rtol=1e-9, atol=1e-9)


def test_a_loop_that_stands_twice_number_for_number_is_meant(tmp_path, capsys, record_of):
    record, path = record_of([(0, 1), (1, 2), (0, 2)]), tmp_path / 'bag'
    factors = record.graph.between
    record.graph.add_between(factors.i[2:], factors.j[2:], factors.measurement[2:],
                             information_of(record.graph)[2:])
    record.write(path)
    note, = (line for line in run(capsys, 'info', path)[0].splitlines() if line[:4] == 'note')
    assert note.endswith(' covariance increment, keyframes every, messages verbatim')
    assert len(read(path).graph.between) == 4


CHAIN = [(0, 1), (1, 2)]


@pytest.mark.parametrize(('pairs', 'trusted', 'stamps', 'message'), [
    ([(0, 1), (2, 3), (1, 3)], None, None, 'no edge between the consecutive vertices 10 and 20'),
    *((CHAIN, trusted, None, 'the absolute pose of vertex 10 is trusted or struck out')
      for trusted in (True, False)),
    *((CHAIN, None, stamps, f'vertex {vertex} has the stamp') for stamps, vertex in (
        ([5, 5, 6], 10), ([5, 7, 6], 20), ([0, 1, 2], 0), ([1, 2, 2**31 * 10**9], 20)))])
def test_what_messages_cannot_express_exactly(tmp_path, record_of, pairs, trusted, stamps,
                                              message):
    record = record_of(pairs, stamps)
    if trusted is not None:
        record.graph.add_between(np.array([-1]), np.array([1]), np.zeros((1, 3)), np.eye(3)[None])
        record.graph.say(np.array([2]), trusted)
    with pytest.raises(l1.L1SlamError, match=message):
        record.write(tmp_path / 'bag')
    assert list(tmp_path.iterdir()) == []


def test_no_keyframe_is_no_bag_and_one_is(tmp_path, record_of):
    manifold = record_of(CHAIN).graph.manifold
    with pytest.raises(l1.L1SlamError, match='has no vertices'):
        l1.write_graph(tmp_path / 'bag', l1.FactorGraph(manifold), np.zeros((0, 3)))
    assert list(tmp_path.iterdir()) == []
    l1.write_graph(tmp_path / 'bag', l1.FactorGraph(manifold, 1), np.zeros((1, 3)))
    assert [topic for topic, _, _ in read_with_rosbags(tmp_path / 'bag')] == ['/odom']
