# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bags as robots and tools write them: every kind, other topics, odd orders, no note of ours."""

import numpy as np
import pytest
from command import run
from records import Converted, beside
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from worlds import simulated_bag

import l1slam_ros as l1
from bags import KINDS, TYPES, mcap_file, recording_of, rosbag2_directory
from l1slam_ros.cli.main import main

ODOMETRY = 'nav_msgs/msg/Odometry'
SECOND = 10**9
# Kinds in which our note is found.
NOTED = ('db3', 'directory of db3', 'directory of mcap, file compressed', 'split mcap',
         'db3 with a journal')


@pytest.fixture
def graph_of(capsys, tmp_path):
    """Return a function from a bag to it `Converted`; every : by EVERY, else by its note."""
    return lambda path, every=False: Converted(capsys, tmp_path, path, every)


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """Return a bag of this package, its messages, and the graph in it as content of files."""
    folder = tmp_path_factory.mktemp('world')
    bag = simulated_bag(folder / 'bag', 120, 180)
    assert main(['convert', str(bag), str(folder / 'out.g2o')]) == 0
    return bag, recording_of(bag), ((folder / 'out.g2o').read_bytes(),
                                    beside(folder / 'out.g2o', 'stamps').read_bytes())


def assert_same_graph(found, expected):
    assert found.content == expected
    assert found.skipped == ()


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_is_the_same_recording(tmp_path, capsys, graph_of, world, kind):
    _, recording, expected = world
    path = KINDS[kind](tmp_path, recording)
    assert_same_graph(graph_of(path, every=True), expected)
    if kind in NOTED:
        assert_same_graph(graph_of(path), expected)
    said, _ = run(capsys, 'info', path)
    for topic, msgtype in {message[:2] for message in recording}:
        count = sum(message[0] == topic for message in recording)
        assert f'topic       {topic}: {count} of {msgtype}\n' in said
    first, last = recording[0][2], recording[-1][2]
    assert f'duration    {(last - first) / 1e9:.1f} s from {first / 1e9:.9f}\n' in said


def test_a_note_that_says_nothing_is_none(tmp_path, graph_of, world):
    for k, note in enumerate(('a word', '{turned_loops: a -1 99999999999999999999}')):
        path = rosbag2_directory(tmp_path / f'{k}', world[1], StoragePlugin.MCAP, note=note)
        assert_same_graph(graph_of(path, every=True), world[2])


def test_a_topic_of_another_type_is_told(tmp_path, world):
    names = {'/odom': '/loop_closures', '/loop_closures': '/odom'}
    swapped = [(names[topic], *rest) for topic, *rest in world[1]]
    with pytest.raises(l1.L1SlamError, match=(
            '0 keyframes from /odom.* on /loop_closures; 181 messages refused: '
            'nav_msgs/msg/Odometry on /loop_closures; expected '
            'geometry_msgs/msg/PoseWithCovarianceStamped$')):
        l1.read_graph(mcap_file(tmp_path / 'a.mcap', swapped))


def test_a_type_defined_otherwise_is_told(tmp_path):
    other = get_typestore(Stores.EMPTY)
    other.register(get_types_from_msg('float64 x', ODOMETRY))
    writer = Writer(tmp_path / 'a', version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        topic = writer.add_connection('/odom', ODOMETRY, typestore=other)
        for k in range(5):
            message = other.types[ODOMETRY](x=float(k))
            writer.write(topic, k, other.serialize_cdr(message, ODOMETRY))
    with pytest.raises(l1.L1SlamError, match='0 keyframes from /odom; expected 2 or more; '
                                        '5 messages refused: a message on /odom; expected the '
                                        'fields of nav_msgs/msg/Odometry$'):
        l1.read_graph(tmp_path / 'a')


def test_loops_may_be_recorded_before_the_odometry_they_name(tmp_path, graph_of, world, rng):
    loops = [m for m in world[1] if m[0] == '/loop_closures']
    start = world[1][0][2]
    early = [(*m[:2], start - len(loops) + k, m[3]) for k, m in enumerate(loops)]
    odometry = [m for m in world[1] if m[0] == '/odom']
    record = graph_of(mcap_file(tmp_path / 'a.mcap', early + odometry), every=True)
    assert record.skipped == ()
    assert len(record.edges) == world[2][0].count(b'EDGE')
    # They come in order of time even from a file without order; of one time, in any.
    shuffled = [world[1][k] for k in rng.permutation(len(world[1]))]
    path = mcap_file(tmp_path / 'a.mcap', shuffled, use_chunking=False)
    found = graph_of(path, every=True)
    assert found.skipped == () and [sorted(one.splitlines()) for one in found.content] == [
        sorted(one.splitlines()) for one in world[2]]


def test_faults_of_the_odometry_are_told(tmp_path, graph_of, world):
    """A variance of 1e12, and a last message on its own."""
    recording = [m for m in world[1] if m[0] == '/odom']
    for k, seconds, variance in (50, 0, 1e12), (-1, 5000, 0.0):
        topic, kind, time, data = recording[k]
        message = TYPES.deserialize_cdr(data, kind)
        message.header.stamp.sec += seconds
        message.pose.covariance = message.pose.covariance + variance * (np.arange(36) == 7)
        recording[k] = topic, kind, time, bytes(TYPES.serialize_cdr(message, kind))
    record = graph_of(mcap_file(tmp_path / 'a.mcap', recording), every=True)
    assert record.graph.n_poses == len(recording) - 1
    variance, last = record.skipped
    assert variance.startswith('variance 1e+12 of odometry at ')
    assert last.startswith('the last message is not used: odometry stamp ')


def changed(message, change):
    topic, msgtype, time, data = message
    decoded = TYPES.deserialize_cdr(data, msgtype)
    change(decoded)
    return topic, msgtype, time, bytes(TYPES.serialize_cdr(decoded, msgtype))


def test_what_cannot_be_used_is_counted_by_its_cause(tmp_path, graph_of, world):
    recording = list(world[1])

    def broken(k, change):
        recording[k] = changed(recording[k], change)

    odometry = [k for k, m in enumerate(recording) if m[0] == '/odom']
    loops = [k for k, m in enumerate(recording) if m[0] == '/loop_closures']
    broken(odometry[50], lambda m: setattr(m.pose.pose.position, 'x', np.nan))
    broken(odometry[60], lambda m: setattr(m.header.stamp, 'sec', 0))
    broken(loops[3], lambda m: setattr(m.header, 'frame_id', 'map'))
    broken(loops[4], lambda m: setattr(m.header.stamp, 'sec', 2_000_000))
    record = graph_of(mcap_file(tmp_path / 'a.mcap', recording), every=True)
    for said, start in zip(sorted(record.skipped), [
            '1 loop not used: the odometry ends before its times',
            "1 message refused: frame 'map' of a loop; expected base_link@",
            '1 message refused: pose (nan, ', '1 message refused: stamp 0 s 0 ns; expected'],
            strict=True):
        assert said.startswith(start)
    assert all('expected' in sentence for sentence in record.skipped if 'refused' in sentence)
    assert record.graph.n_poses == 118
