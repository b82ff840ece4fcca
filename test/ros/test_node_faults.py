# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Whatever is raised inside the node: it goes on, says so, answers, and keeps its good map."""

import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from node_bench import call

from l1slam_ros.core.running.keeper import updates, work
from l1slam_ros.io.graphs import saved_map
from l1slam_ros.io.messages import conversion
from l1slam_ros.ros import publishing
from l1slam_ros.ros.threads import intake

FAULTS = ['ValueError', 'MemoryError', 'nan']


def spoilt(result):
    """Return a map with a pose that is not finite."""
    return replace(result, poses=result.poses * math.nan)


class Fault:
    """Stands before a function of a module: while it is on, calls end in a fault."""

    def __init__(self, monkeypatch, module, name, kind):
        self.on = False
        self.calls = 0
        self.original = getattr(module, name)
        self.kind = kind
        monkeypatch.setattr(module, name, self)

    def __call__(self, *arguments):
        if not self.on:
            return self.original(*arguments)
        self.calls += 1
        if self.kind == 'nan':
            return spoilt(self.original(*arguments))
        raise {'ValueError': ValueError('injected'), 'MemoryError': MemoryError()}[self.kind]

    @property
    def said(self):
        return {'nan': 'not finite', 'ValueError': 'ValueError: injected'}.get(
            self.kind, self.kind)


def is_error(b, *words):
    level, sentence, _ = b.status()
    return level == DiagnosticStatus.ERROR and all(word in sentence for word in words)


def is_ok(b):
    return b.status()[0] == DiagnosticStatus.OK


def assert_all_finite(b):
    for message in b.received['pose']:
        assert np.isfinite([message.pose.position.x, message.pose.orientation.w]).all()
    for message in b.received['path']:
        assert np.isfinite([p.pose.position.x for p in message.poses]).all()
    for message in b.received['map_to_odom']:
        assert np.isfinite(message.transform.translation.x)


@pytest.mark.parametrize('kind', FAULTS)
def test_an_update_that_fails(bench, monkeypatch, tmp_path, kind):
    fault = Fault(monkeypatch, work, 'improve', kind)
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3 and is_ok(b), 'a map')
    fault.on = True
    b.drive(3, 5)
    b.until(lambda: is_error(b, 'update failed', fault.said), 'it says so')
    b.until(lambda: len(b.received['pose']) == 5, 'odometry is answered')
    b.until(lambda: len(b.path().poses) == 5, 'the map that there is takes what comes')
    assert call(b, 'save').success and call(b, 'optimize').success
    fault.on = False
    b.drive(5, 6)
    b.until(lambda: len(b.path().poses) == 6 and is_ok(b), 'it is over')
    assert_all_finite(b)


def test_an_update_that_always_fails_is_not_tried_all_the_time(bench, monkeypatch):
    fault = Fault(monkeypatch, work, 'improve', 'ValueError')
    fault.on = True
    b = bench(**{'update.period': 0.001})
    b.drive(0, 3)
    b.until(lambda: fault.calls, 'a first update')
    began = time.monotonic()
    b.until(lambda: time.monotonic() > began + 2.0, 'two seconds later')
    # After pauses of .2, .4, .8, 1.6 s: ten times as often would be a core's work.
    assert 2 <= fault.calls <= 6
    # Whoever replaces the map is not to wait for a pause to be over.
    fault.on = False
    assert call(b, 'reset').success
    b.until(lambda: is_ok(b), 'it is over')


@pytest.mark.parametrize('kind, service, module, function', [
    ('ValueError', 'save', saved_map, 'graph_lines'),
    ('MemoryError', 'load', saved_map, 'read_graph_file'),
    ('MemoryError', 'optimize', updates, 'optimise'),
    ('nan', 'optimize', updates, 'optimise')])
def test_a_service_that_fails(bench, monkeypatch, tmp_path, kind, service, module, function):
    fault = Fault(monkeypatch, module, function, kind)
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    assert call(b, 'save').success
    fault.on = True
    answer = call(b, service)
    assert not answer.success and fault.said in answer.message
    b.until(lambda: is_error(b, f'~/{service} failed', fault.said), 'it says so')
    b.drive(3, 4)
    b.until(lambda: len(b.path().poses) == 4, 'updates go on')
    fault.on = False
    assert call(b, service).success
    b.until(lambda: is_ok(b), 'it is over')
    assert_all_finite(b)


@pytest.mark.parametrize('kind', FAULTS[:2])
def test_a_callback_that_fails(bench, monkeypatch, kind):
    fault = Fault(monkeypatch, conversion, 'odometry_in', kind)
    b = bench()
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    fault.on = True
    b.drive(3, 5)
    b.until(lambda: is_error(b, 'odom failed', fault.said), 'it says so')
    fault.on = False
    b.drive(5, 7)
    b.until(lambda: len(b.path().poses) == 5 and is_ok(b), 'it is over')
    assert_all_finite(b)


def test_an_intake_that_fails(bench, monkeypatch):
    """At its begin, as where a signal shuts ROS down just then."""
    ros = SimpleNamespace(WaitSet=intake.rclpy_implementation.WaitSet)
    monkeypatch.setattr(intake, 'rclpy_implementation', ros)
    fault = Fault(monkeypatch, ros, 'WaitSet', 'MemoryError')
    fault.on = True
    b = bench()
    b.until(lambda: 'intake' in b.backend.failures.lasting, 'it fails')
    fault.on = False
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3 and is_ok(b), 'it is over')


def test_a_publisher_that_fails(bench, monkeypatch):
    fault = Fault(monkeypatch, publishing, 'path_bytes', 'ValueError')
    fault.on = True
    b = bench()
    b.drive(0, 3)
    b.until(lambda: is_error(b, 'update failed', fault.said), 'it says so')
    fault.on = False
    b.until(lambda: len(b.path().poses) == 3 and is_ok(b), 'the map is published after all')


def test_each_kind_of_failure_is_logged_once_in_full(bench, monkeypatch, capfd):
    fault = Fault(monkeypatch, work, 'improve', 'ValueError')
    fault.on = True
    b = bench()
    b.drive(0, 3)
    b.until(lambda: fault.calls >= 3, 'three failures')
    assert capfd.readouterr().err.count('Traceback') == 1
