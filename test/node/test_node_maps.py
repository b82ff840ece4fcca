# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The node never loses a map: it saves on its own, at its end too, and goes on where it was."""

import os
import signal
import time
from hashlib import sha256

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from node_bench import LATCHED, call, odometry, poses_of, set_parameter
from rclpy.qos import QoSProfile

import l1slam_ros as l1

DEADLINE = 60.0


def keyframes(path):
    return l1.read_graph(path)[0].n_poses if path.exists() else 0


def test_the_map_is_saved_while_it_grows_and_at_the_end(bench, tmp_path):
    path = tmp_path / 'map.g2o'
    b = bench(save_path=str(path), autosave_period=0.2)
    b.drive(0, 3)
    b.until(lambda: keyframes(path) == 3, 'the map is saved')
    b.drive(3, 5)
    b.until(lambda: keyframes(path) == 5, 'it is saved again')
    other = tmp_path / 'other.g2o'
    assert not set_parameter(b, 'save_path', str(other))
    assert call(b, 'save').message == f'5 keyframes saved to {other}'
    b.until(lambda: len(b.path().poses) == 5, 'the map')
    now = b.path()
    assert not set_parameter(b, 'autosave_period', 1e6)
    b.drive(5, 6)
    b.until(lambda: len(b.path().poses) == 6, 'a keyframe more')
    assert b.close() and keyframes(other) == 6 and len(now.poses) == 5


def test_a_settled_map_is_loaded_at_start_and_published_at_once(bench, tmp_path):
    path = tmp_path / 'map.g2o'
    first = bench(save_path=str(path))
    first.drive(0, 4)
    first.until(lambda: len(first.path().poses) == 4, 'a map')
    first.rest()
    assert call(first, 'save').success
    before = poses_of(first.path())
    first.close()  # or what it publishes would be heard, too
    second = bench(save_path=str(path), load_on_start=True)
    second.until(lambda: len(second.path().poses) == 4, 'the map is there without odometry')
    np.testing.assert_array_equal(poses_of(second.path()), before)
    second.received['/diagnostics'].clear()
    second.until(lambda: len(second.received['/diagnostics']) == 2, 'a second later')
    assert second.count('updates') == 0 and len(second.received['path']) == 1


def test_a_map_that_cannot_be_saved_is_an_error_until_it_can(bench, tmp_path, capfd):
    path = tmp_path / 'none' / 'map.g2o'
    b = bench(save_path=str(path), autosave_period=0.2)
    said = f'save_path is {str(path)!r}, but there is no folder {path.parent}'
    assert said in capfd.readouterr().err
    assert set_parameter(b, 'save_path', str(path)) == said
    b.drive(0, 3)
    b.until(lambda: b.status()[0] == DiagnosticStatus.ERROR
            and f'autosave failed: {path}: cannot be written: ' in b.status()[1], 'it says so')
    path.parent.mkdir()
    b.until(lambda: b.status()[0] != DiagnosticStatus.ERROR, 'it is over')
    assert keyframes(path) == 3


def hold_nonsense(path):
    """Let a saved map hold the wrong count of stamps, and prove itself all the same."""
    lines = [line if not line.startswith('#L1SLAM stamps') else '#L1SLAM stamps [1]'
             for line in path.read_text().splitlines()[:-1]]
    content = ''.join(f'{line}\n' for line in lines)
    path.write_text(f'{content}#L1SLAM sha256 {sha256(content.encode()).hexdigest()}\n')


def test_where_the_contents_of_a_map_are_wrong_the_one_before_is_loaded(bench, tmp_path, capfd):
    path, before = tmp_path / 'map.g2o', tmp_path / 'map.g2o.1'
    first = bench(save_path=str(path))
    for last in 4, 5:
        first.drive(0 if last == 4 else 4, last)
        first.until(lambda last=last: len(first.path().poses) == last, 'a map')
        assert call(first, 'save').success
    first.close()
    hold_nonsense(path)
    good = before.read_bytes()
    capfd.readouterr()
    second = bench(save_path=str(path), load_on_start=True)
    second.until(lambda: len(second.path().poses) == 4, 'the map before')
    said = f'4 keyframes loaded from {before}, the map before: {path}: is a saved map with wrong '
    assert said in capfd.readouterr().err
    assert said in call(second, 'load').message
    assert 'held another map' in call(second, 'save').message
    assert before.read_bytes() == good, 'nonsense does not take its place'
    second.close()
    for one in path, before:
        hold_nonsense(one)
    third = bench(save_path=str(path), load_on_start=True)
    said = capfd.readouterr().err
    assert f'the map begins empty: {path}: cannot be loaded: ' in said and 'Traceback' not in said
    answer = call(third, 'load')
    assert not answer.success and answer.message.count('wrong contents') == 2
    third.drive(0, 3)
    third.until(lambda: len(third.path().poses) == 3, 'it maps all the same')


class Robot:
    """The node as a process, and a peer that drives and listens."""

    def __init__(self, ros, start, path):
        self.process = start('--ros-args', '-p', f'save_path:={path}', '-p',
                             'autosave_period:=0.2', '-p', 'load_on_start:=true')
        self.node, self.heard = ros.create_node('robot'), []
        self.node.create_subscription(PathMessage, 'path', self.heard.append, LATCHED)
        self.publisher = self.node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))

    def until(self, condition, what):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f'waited {DEADLINE} s in vain until {what}'
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def drive(self, first, last):
        self.until(self.publisher.get_subscription_count, 'the node listens')
        for k in range(first, last):
            self.publisher.publish(odometry((k + 1) * 10**9, 5.0 + k))

    def end(self, number):
        self.process.send_signal(number)
        said = self.process.communicate(timeout=DEADLINE)[1]
        self.node.destroy_node()
        return said


def test_a_killed_node_goes_on_where_it_was_and_a_signal_loses_nothing(ros, start, tmp_path):
    path = tmp_path / 'map.g2o'
    first = Robot(ros, start, path)
    first.drive(0, 10)
    first.until(lambda: keyframes(path) == 10, 'all is saved')
    first.end(signal.SIGKILL)
    second = Robot(ros, start, path)
    second.until(lambda: second.heard, 'the map is back')
    assert len(second.heard[-1].poses) == 10
    second.drive(10, 20)
    second.until(lambda: len(second.heard[-1].poses) == 20, 'the robot goes on')
    np.testing.assert_allclose(poses_of(second.heard[-1])[:, 0], 5 + np.arange(20), atol=1e-6)
    said = second.end(signal.SIGTERM)
    assert second.process.returncode == 0 and '10 keyframes loaded from' in said, said
    *lines, last = path.read_text().splitlines(keepends=True)
    assert last.split() == ['#L1SLAM', 'sha256', sha256(''.join(lines).encode()).hexdigest()]
    assert keyframes(path) == 20
    assert set(os.listdir(tmp_path)) == {'map.g2o', 'map.g2o.1'}
