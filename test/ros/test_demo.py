# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The summary of the demo tells the truth."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

from l1slam_ros.ros import demo
from l1slam_ros.ros.demo import (
    BAG,
    CALM,
    DemoError,
    Heard,
    Listener,
    read_recording,
    require_the_truth,
    summarise,
)
from l1slam_ros.ros.shell.header import header

DEMO = Path(__file__).parents[2] / BAG
DEADLINE = 60.0


def test_the_summary_of_a_perfect_map_is_an_error_of_zero(tmp_path):
    recording = read_recording(DEMO)
    assert (len(recording.stamps), len(recording.loops)) == (1000, 611)
    turned = recording.truth @ np.array([[0.0, -1.0], [1.0, 0.0]]) + (5.0, 6.0)
    path = PathMessage(poses=[
        PoseStamped(header=header('map', int(stamp)), pose=Pose(position=Point(x=x, y=y)))
        for stamp, (x, y) in zip(recording.stamps, turned, strict=True)])
    grid = OccupancyGrid(data=[-1, 0, 100, 0, 0, 100])
    grid.info.resolution = 2.0
    grid.info.width = 3
    grid.info.height = 2
    states = {**states_of(recording), (1, 2): 'accepted', (1, 3): 'suspect'}
    heard = Heard(serialize_message(path), grid, 1000, states)
    for is_false in True, False:  # one of each is told apart wrongly
        ends = recording.loop_stamps[np.argmax(recording.is_false == is_false)]
        heard.states[ends] = 'accepted' if is_false else 'rejected'
    text = summarise(recording, heard, tmp_path / 'demo' / 'map.png')
    assert '0.000 m in the map' in text and '2.880 m by odometry' in text
    assert '1000 keyframes, 611 loops, 10 of them false' in text
    assert '9 false loops, 1 true ones' in text
    assert 'from the scans  2 more loops, 1 of them not in the map' in text
    assert (tmp_path / 'demo' / 'map.png').read_bytes().startswith(b'\x89PNG')


def states_of(recording):
    """Return what is to become of each loop."""
    return {ends: 'rejected' if is_false else 'accepted' for ends, is_false
            in zip(recording.loop_stamps, recording.is_false, strict=True)}


@pytest.mark.parametrize(('is_false', 'state'), [(True, 'accepted'), (False, 'rejected')])
def test_the_demo_fails_unless_it_refuses_the_false_loops_and_no_other(is_false, state):
    recording = read_recording(DEMO)
    heard = Heard(states=states_of(recording))
    require_the_truth(recording, heard)
    row = np.argmax(recording.is_false == is_false)
    heard.states[recording.loop_stamps[row]] = state
    with pytest.raises(DemoError, match='expected all 10 false ones and no true one'):
        require_the_truth(recording, heard)


def test_the_demo_may_leave_out_hardly_any_true_loops():
    recording = read_recording(DEMO)
    heard = Heard(states=states_of(recording))
    true = np.flatnonzero(~recording.is_false)[:7]
    for row in true[:6]:
        heard.states[recording.loop_stamps[row]] = 'suspect'
    require_the_truth(recording, heard)
    heard.states[recording.loop_stamps[true[6]]] = 'suspect'
    with pytest.raises(DemoError, match='7 true loops are left out as suspect, expected at most'):
        require_the_truth(recording, heard)


@pytest.fixture
def listener(ros):
    node = ros.create_node('listener')
    recording = read_recording(DEMO)
    listener = Listener(node, recording)
    listener.path = PathMessage(poses=[
        PoseStamped(header=header('map', int(stamp)))
        for stamp in recording.stamps])
    yield listener
    node.destroy_node()


def diagnostics(updates):
    """Return what a node says of its map, and of a topic of which it always says another thing."""
    rate = KeyValue(key='rate', value=str(time.monotonic()))
    return DiagnosticArray(status=[
        DiagnosticStatus(message='ok', values=[KeyValue(key='updates', value=str(updates)), rate]),
        DiagnosticStatus(message='odom', values=[rate])])


def scans_used(count, comparisons=0):
    """Return what the front end says of the scans it has used, and has still to compare."""
    return DiagnosticArray(status=[DiagnosticStatus(
        message='ok', values=[KeyValue(key='scans', value=str(count)),
                              KeyValue(key='comparisons', value=str(comparisons)),
                              KeyValue(key='keyframes', value='1')])])


def say(listener, publisher, *messages):
    """Publish messages; wait until the listener has heard of each."""
    deadline = time.monotonic() + DEADLINE
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
        rclpy.spin_once(listener.node, timeout_sec=0.1)
    for message in messages:
        before = listener.heard.calm, listener.moved
        publisher.publish(message)
        while (listener.heard.calm, listener.moved) == before:
            assert time.monotonic() < deadline
            rclpy.spin_once(listener.node, timeout_sec=0.1)


def test_the_map_is_final_when_it_is_whole_and_the_node_says_the_same_of_it(listener):
    heard = listener.heard
    publisher = listener.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
    paths = listener.node.create_publisher(
        PathMessage, 'path', QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    say(listener, publisher, *[diagnostics(7)] * 5)
    assert heard.calm > CALM and not listener.is_final()  # nothing is in the map yet
    say(listener, paths, listener.path)
    say(listener, publisher, *[diagnostics(8)] * 5)
    assert not listener.is_final()  # no loop is yet
    heard.states |= states_of(listener.recording)
    assert not listener.is_final()  # nor has the front end used a scan
    say(listener, publisher, scans_used(999), *[diagnostics(8)] * 5)
    assert listener.is_final()
    heard.states[listener.recording.loop_stamps[5]] = 'waiting'
    assert not listener.is_final()
    heard.states[listener.recording.loop_stamps[5]] = 'suspect'
    assert listener.is_final()
    say(listener, publisher, scans_used(1000))
    assert not listener.is_final()  # another scan was used
    say(listener, publisher, *[diagnostics(8)] * 5)
    assert listener.is_final()
    say(listener, publisher, scans_used(1000, 3), *[diagnostics(8)] * 5)
    assert not listener.is_final()  # a few are still to be compared
    say(listener, publisher, scans_used(1000), *[diagnostics(8)] * 5)
    assert listener.is_final()
    say(listener, publisher, diagnostics(9))
    assert not listener.is_final()  # another update


def test_the_demo_ends_with_a_sentence_when_the_node_has_died(listener):
    process = subprocess.Popen([sys.executable, '-c', 'raise SystemExit(7)'])
    with pytest.raises(DemoError, match='^backend ended with exit code 7; 0 of 1000 scans'):
        listener.wait({'backend': process}, lambda: False)


def test_the_demo_ends_with_a_sentence_when_nothing_moves(listener, monkeypatch):
    monkeypatch.setattr(demo, 'PATIENCE', 0.2)
    waiting = subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE)
    with waiting, pytest.raises(DemoError, match='^nothing has moved for .*; 0 of 1000 scans'):
        listener.wait({'backend': waiting}, lambda: False)
