# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes: `replay` plays a bag into `backend`, signals end it."""

import importlib.util
import re
import signal
import subprocess
import threading
import time
from collections import Counter
from contextlib import contextmanager

import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from node_bench import LATCHED, executable
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

import l1slam_ros as l1
from bags import recording_of, write_world

DEADLINE = 300.0  # [s] the solver can have to be compiled first


@pytest.fixture
def backend(start):
    process = start()
    # The node says when it is ready; before that a signal would meet a half-started process.
    assert 'ready' in process.stderr.readline()
    return process


@pytest.fixture
def bag(tmp_path):
    write_world(tmp_path / 'bag', 200, 300)
    return tmp_path / 'bag'


def replay(*arguments):
    return subprocess.run([executable('replay'), *map(str, arguments)], capture_output=True,
                          text=True, timeout=DEADLINE)


@contextmanager
def waiting_replay(*arguments, whom='a node'):
    """Yield a replay that nobody subscribes to, once it has said whom it waits for."""
    process = subprocess.Popen([executable('replay'), *map(str, arguments)],
                               stderr=subprocess.PIPE, text=True)
    try:
        said = process.stderr.readline()
        assert f'waiting for {whom} to subscribe to /loop_closures, /odom' in said
        yield process
    finally:
        process.kill()
        process.communicate()


def complaints(played):
    """Return what a replay said, but for that it waited: a busy machine is slow to subscribe."""
    return [line for line in played.stderr.splitlines() if 'waiting for a node' not in line]


@pytest.fixture
def paths(ros):
    """Return what comes on `path`, and a function that waits for a condition on it."""
    node = ros.create_node('listener')
    heard = []
    node.create_subscription(PathMessage, 'path', heard.append, LATCHED)

    def until(condition):
        deadline = time.monotonic() + DEADLINE
        while not (heard and condition(heard[-1])):
            assert time.monotonic() < deadline, (
                f'{len(heard)} paths; the last has {len(heard[-1].poses) if heard else 0} poses')
            ros.spin_once(node, timeout_sec=0.1)
        return heard[-1]

    yield until
    node.destroy_node()


def test_replay_plays_a_bag_into_backend_and_a_map_comes_out(backend, bag, paths):
    played = replay(bag, '--rate', '40')
    assert (played.returncode, complaints(played)) == (0, [])
    path = paths(lambda path: len(path.poses) == 200)
    assert path.header.frame_id == 'map'
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in path.poses]
    assert stamps == [1000 * 10**9 + k * 10**8 for k in range(200)]
    backend.send_signal(signal.SIGINT)
    assert backend.wait(DEADLINE) == 0


def test_a_part_of_a_bag_on_other_topics(backend, bag, paths):
    played = replay(bag, '--rate', '40', '--start', '5', '--duration', '10',
                    '--topics', '/odom', '--remap', '/odom:=/other', '--wait', '0')
    assert played.returncode == 0
    played = replay(bag, '--rate', '10', '--start', '2', '--duration', '3', '--topics', '/odom')
    assert played.returncode == 0
    path = paths(lambda path: len(path.poses) == 30)
    assert path.poses[0].header.stamp.sec == 1002


def test_services_are_answered_when_they_are_done(backend, ros):
    """Not when a timer of the node wakes its executor, once a second, the next time."""
    node, seconds = ros.create_node('caller'), []
    node.create_subscription(DiagnosticArray, '/diagnostics', seconds.append, 10)
    client = node.create_client(Trigger, '/backend/reset')
    assert client.wait_for_service(DEADLINE)
    rclpy.spin_until_future_complete(node, client.call_async(Trigger.Request()), None, DEADLINE)
    seconds.clear()
    for _ in range(10):
        answer = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, answer, None, DEADLINE)
        assert answer.result().success
    assert len(seconds) < 5
    node.destroy_node()


def test_replay_waits_for_subscribers_and_loses_neither_the_first_nor_the_last(bag, ros):
    with waiting_replay(bag, '--rate', '40') as process:
        node, heard = ros.create_node('late'), Counter()
        for kind, topic in (Odometry, '/odom'), (PoseWithCovarianceStamped, '/loop_closures'):
            node.create_subscription(
                kind, topic, lambda _, topic=topic: heard.update([topic]), QoSProfile(depth=1000))
        sent = Counter(topic for topic, *_ in recording_of(bag))
        deadline = time.monotonic() + DEADLINE
        while process.poll() is None or heard != sent:
            assert time.monotonic() < deadline, f'{heard} of {sent}'
            ros.spin_once(node, timeout_sec=0.1)
        assert process.returncode == 0 and process.stderr.read() == ''
    node.destroy_node()


def test_replay_waits_for_the_nodes_that_it_is_told_of(bag, ros):
    """Another node has a subscription to each topic long before."""
    with waiting_replay(bag, '--rate', '40', '--nodes', 'late', whom='late') as process:
        other, late = ros.create_node('other'), ros.create_node('late')
        heard = {node.get_name(): [] for node in (other, late)}

        def listen(node):
            for kind, topic in (Odometry, '/odom'), (PoseWithCovarianceStamped, '/loop_closures'):
                node.create_subscription(
                    kind, topic, heard[node.get_name()].append, QoSProfile(depth=1000))

        listen(other)
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            ros.spin_once(other, timeout_sec=0.1)
        assert not heard['other'] and process.poll() is None
        listen(late)
        sent = len(recording_of(bag))
        deadline = time.monotonic() + DEADLINE
        while process.poll() is None or len(heard['late']) != sent:
            assert time.monotonic() < deadline, f'{len(heard["late"])} of {sent}'
            ros.spin_once(late, timeout_sec=0.1)
        assert process.returncode == 0
    other.destroy_node()
    late.destroy_node()


@pytest.mark.parametrize('name', ['backend', 'scan_loops'])
@pytest.mark.parametrize('publishes', [True, False])
def test_a_node_that_cannot_publish_on_tf_warns_once_at_start(name, publishes):
    command = [executable(name), '--ros-args', '-p', f'publish_tf:={publishes}']
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    patience = threading.Timer(60.0, process.kill)
    patience.start()
    try:
        assert any('ready' in line for line in process.stderr)
        if publishes and importlib.util.find_spec('tf2_msgs') is None:
            said = process.stderr.readline()
            assert 'WARN' in said and 'tf2_msgs is not installed' in said
        process.send_signal(signal.SIGTERM)
        assert 'tf2_msgs' not in process.communicate()[1]
    finally:
        patience.cancel()
        process.kill()


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_a_signal_ends_a_replay_that_waits(bag, name):
    with waiting_replay(bag) as process:
        process.send_signal(getattr(signal, name))
        assert process.wait(DEADLINE) == 0
        assert process.stderr.read() == ''


@pytest.mark.parametrize(('seconds', 'said'), [
    ('0', []), ('0.5', ['a node did not subscribe for 0.5 s; playing all the same'])])
def test_replay_plays_to_nobody_after_as_long_as_it_is_told(bag, seconds, said):
    played = replay(bag, '--rate', '100', '--wait', seconds)
    assert played.returncode == 0
    assert [line.split(': ')[-1] for line in played.stderr.splitlines()] == said


def test_replay_is_paced(bag):
    began = time.monotonic()
    assert replay(bag, '--rate', '10', '--duration', '10', '--wait', '0').returncode == 0
    assert time.monotonic() - began >= 1.0


@pytest.mark.parametrize('arguments, complaint', [
    (('/no/such/bag',), 'no such file'),
    (('/no/such\nbag',), '/no/such\\nbag: no such file'),
    ((__file__,), 'does not have the name of a bag'),
])
def test_replay_of_no_bag_is_one_line_and_exit_code_2(arguments, complaint):
    played = replay(*arguments)
    assert played.returncode == 2
    assert complaint in played.stderr and played.stderr.count('\n') == 1


def test_replay_of_a_damaged_bag_plays_a_part_says_so_and_exits_with_3(backend, bag, paths):
    file = bag / 'bag.mcap'
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    with pytest.warns(UserWarning, match='damaged'):
        odometry = l1.read_graph(file)[0].n_poses
    assert 50 < odometry < 150
    played = replay(bag, '--rate', '40')
    assert played.returncode == 3
    (complaint,) = complaints(played)
    assert re.fullmatch(rf'replay: {file} is damaged: it breaks off after [0-9,]+ bytes; '
                        '[0-9,]+ messages before that were used', complaint)
    paths(lambda path: len(path.poses) == odometry)


def test_replay_of_a_topic_that_is_not_there_names_those_that_are(bag):
    played = replay(bag, '--topics', '/scan')
    assert played.returncode == 2
    assert '/scan' in played.stderr and '/loop_closures, /odom' in played.stderr


@pytest.mark.parametrize('arguments, words', [
    (('--start', '1e9'), '--start is 1e+09, expected at most the 19.9 s of the bag'),
    (('--rate', 'abc'), 'argument --rate: abc, expected a number above 0'),
    (('--remap', '/odom:=a//b'), 'replay: /odom cannot be played onto a//b: InvalidTopicName'),
    (('--ros-args', '-r', 'x'), "replay: RCLError: failed to initialize rcl: Couldn't parse")])
def test_replay_says_what_it_cannot_be_told(bag, arguments, words):
    played = replay(bag, *arguments)
    assert played.returncode == 2 and words in played.stderr


@pytest.mark.parametrize('arguments, words', [
    (('-p', 'keyframe.translation:=-1.0'), 'keyframe.translation'),
    (('--params-file', '/no/such.yaml'), '/no/such.yaml'),
    (('-p', 'qos_overrides./odom.subscription.reliability:=best'), 'odom cannot be subscribed')])
def test_what_is_refused_at_start_is_one_line_and_exit_code_1(arguments, words):
    run = subprocess.run([executable('backend'), '--ros-args', *arguments],
                         capture_output=True, text=True, timeout=DEADLINE)
    assert run.returncode == 1
    assert 'Traceback' not in run.stderr
    last = run.stderr.splitlines()[-1]
    assert last.startswith('backend: ') and words in last
