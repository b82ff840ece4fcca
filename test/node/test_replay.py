# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`replay` as a process: it plays a bag into `backend`, waits for whom it is told, and ends."""

import re
import signal
import subprocess
import time
from collections import Counter
from contextlib import contextmanager

import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import DEADLINE, LATCHED, Peer, call, executable, odometry, stamp_of
from rclpy.qos import QoSProfile
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
from rosbags.interfaces import QosTime as Seconds
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

import l1slam_ros as l1
from bags import STRING, TYPES, recording_of, write_world


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of 20 s; not to be written to."""
    path = tmp_path_factory.mktemp('world') / 'bag'
    write_world(path, 200, 300)
    return path


def replay(*arguments):
    return subprocess.run([executable('replay'), *map(str, arguments)], capture_output=True,
                          text=True, timeout=DEADLINE)


@contextmanager
def waiting_replay(*arguments, whom='a node', topics='/loop_closures, /odom'):
    """Yield a replay that nobody subscribes to, once it has said whom it waits for."""
    process = subprocess.Popen([executable('replay'), *map(str, arguments)],
                               stderr=subprocess.PIPE, text=True)
    try:
        assert f'waiting for {whom} to subscribe to {topics}' in process.stderr.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


def complaints(played):
    """Return what a replay said, but for that it waited: a busy machine is slow to subscribe."""
    return [line for line in played.stderr.splitlines() if 'waiting for a node' not in line]


def test_replay_plays_a_bag_into_backend_and_a_map_comes_out(start, ros, bag, tmp_path):
    process = start(RMW_IMPLEMENTATION=rclpy.get_rmw_implementation_identifier())
    assert 'ready' in process.stderr.readline(), 'and nothing of a middleware that is there'
    b = Peer(ros)
    b.until_heard()
    # Of a node that does nothing for a while messages get lost, which is said.
    b.drive(0, 1)
    b.until(b.newest, 'the first has come')
    process.send_signal(signal.SIGSTOP)
    for k in range(10_000, 12_999):
        b.publishers['/odom'].publish(odometry((k + 1) * 10**5, 0.0))
    process.send_signal(signal.SIGCONT)
    b.until(lambda: b.count('odom.received') + b.count('odom.lost') == 3000, 'all are told of')
    values = b.status()[2]
    assert b.count('odom.received') >= 1000 <= b.count('odom.lost')
    assert float(values['odom.rate']) > 0 and values['loop_closures.received'] == '0'
    for topic in list(b.publishers):
        b.peer.destroy_publisher(b.publishers.pop(topic))

    def map_of(count):
        path = b.map_of(count)
        assert call(b, 'reset').success
        b.map_of(0)
        return path

    map_of(1)
    played = replay(bag, '--rate', '40')
    assert (played.returncode, complaints(played)) == (0, [])
    path = map_of(200)
    assert path.header.frame_id == 'map'
    assert [stamp_of(p.header) for p in path.poses] == [
        1000 * 10**9 + k * 10**8 for k in range(200)]
    # A part of it, and of a damaged one what is there.
    played = replay(bag, '--rate', '10', '--start', '2', '--duration', '3', '--topics', '/odom')
    assert played.returncode == 0
    assert map_of(30).poses[0].header.stamp.sec == 1002
    file = tmp_path / 'bag.mcap'
    file.write_bytes((bag / 'bag.mcap').read_bytes()[:(bag / 'bag.mcap').stat().st_size // 2])
    with pytest.warns(UserWarning, match='damaged'):
        expected = l1.read_graph(file)[0].n_poses
    assert 50 < expected < 150
    played = replay(file, '--rate', '40')
    assert played.returncode == 3
    (complaint,) = complaints(played)
    assert re.fullmatch(rf'replay: {file} is damaged: it breaks off after [0-9,]+ bytes; '
                        '[0-9,]+ messages before that were used', complaint)
    map_of(expected)
    process.send_signal(signal.SIGINT)
    assert process.wait(DEADLINE) == 0
    b.close()


def test_replay_waits_for_the_nodes_it_is_told_of_and_loses_no_message(bag, ros):
    """Neither the first nor the last; another node subscribes to each topic long before."""
    sent = Counter(topic for topic, *_ in recording_of(bag))
    nodes, heard = [ros.create_node('other'), ros.create_node('late')], [Counter(), Counter()]

    def listen(node, counts):
        for kind, topic in (Odometry, '/odom'), (PoseWithCovarianceStamped, '/loop_closures'):
            node.create_subscription(
                kind, topic, lambda _, topic=topic: counts.update([topic]), QoSProfile(depth=1000))

    listen(nodes[0], heard[0])
    with waiting_replay(bag, '--rate', '40', '--nodes', 'late', whom='late') as process:
        rclpy.spin_once(nodes[0], timeout_sec=0.1)
        assert not heard[0] and process.poll() is None
        listen(nodes[1], heard[1])
        deadline = time.monotonic() + DEADLINE
        while process.poll() is None or heard[1] != sent:
            assert time.monotonic() < deadline, f'{heard} of {sent}'
            for node in nodes:
                rclpy.spin_once(node, timeout_sec=0.0)
        assert process.returncode == 0 and process.stderr.read() == ''
    for node in nodes:
        node.destroy_node()


def test_what_was_kept_for_who_comes_late_is_kept_by_replay_too_with_a_clock(ros, tmp_path):
    """Who asks for what was kept, as for a grid, hears no publisher that keeps nothing."""
    never = Seconds(2**31 - 1, 999_999_999)
    kept = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
               never, never, QosLiveliness.AUTOMATIC, never, False)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {name: writer.add_connection(
            name, STRING, typestore=TYPES, offered_qos_profiles=profiles)
            for name, profiles in (('/grid', [kept]), ('/said', []))}
        for k, name in enumerate(('/grid', '/grid', '/said', '/said', '/said')):
            message = TYPES.types[STRING](f'{k}')
            writer.write(topics[name], (k + 1) * 10**9, TYPES.serialize_cdr(message, STRING))
    b = Peer(ros)
    clock, said = b.listen(Clock, '/clock', 1000), b.listen(String, '/said', 100)
    with waiting_replay(tmp_path / 'bag', '--clock', '--loop', '--nodes', 'nobody', '--wait', '3',
                        '--rate', '20', whom='nobody', topics='/grid, /said') as process:
        b.until(lambda: len(said) >= 5, 'it plays all the same, and again')
        grid = b.listen(String, '/grid', LATCHED)
        b.until(lambda: grid and grid[0].data == '1', 'the last grid, though it is late')
        stamps = [message.clock.sec + 1e-9 * message.clock.nanosec for message in clock]
        assert min(stamps) == 1.0 and 4.9 < max(stamps) <= 5.0
        # Nothing waits for this subscription: on a busy machine it may be late for the first.
        assert ''.join(message.data for message in said[:5]) in '2342342'
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE) == 0
    b.close()


def test_a_signal_ends_a_replay_that_waits(bag):
    with waiting_replay(bag) as process:
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE) == 0
        assert process.stderr.read() == ''


def test_replay_is_paced_and_plays_to_nobody_after_as_long_as_it_is_told(bag):
    began = time.monotonic()
    played = replay(bag, '--rate', '10', '--duration', '10', '--wait', '0.5')
    assert played.returncode == 0 and time.monotonic() - began >= 1.5
    assert [line.split(': ')[-1] for line in played.stderr.splitlines()] == [
        'a node did not subscribe for 0.5 s; playing all the same']
    played = replay(bag, '--rate', '100', '--topics', '/odom', '--remap', '/odom:=/other',
                    '--wait', '0')
    assert (played.returncode, played.stderr) == (0, '')


@pytest.mark.parametrize('arguments, words', [
    (('/no/such\nbag',), '/no/such\\nbag: no such file'),
    ((__file__,), 'does not have the name of a bag'),
    (('BAG', '--topics', '/scan'), 'no topic /scan; it has /loop_closures, /odom'),
    (('BAG', '--start', '1e9'), '--start is 1e+09, expected at most the 19.9 s of the bag'),
    (('BAG', '--remap', '/odom:=a//b'),
     'replay: /odom cannot be played onto a//b: InvalidTopicName'),
    (('BAG', '--rate', 'abc'), 'argument --rate: abc, expected a number above 0'),
    (('BAG', '--wait', '-1'), 'argument --wait: -1, expected a number of 0 or more'),
    (('BAG', '--remap', 'odom'), "'odom', expected old:=new"),
    (('BAG', '--ros-args', '-r', 'x'), "replay: RCLError: failed to initialize rcl: Couldn't")])
def test_replay_says_what_it_cannot_do(bag, arguments, words):
    played = replay(*(bag if word == 'BAG' else word for word in arguments))
    assert played.returncode == 2 and words in played.stderr.splitlines()[-1]
    assert 'Traceback' not in played.stderr
