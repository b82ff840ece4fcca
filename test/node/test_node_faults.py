# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Whatever ROS or a disk raises inside the node: it goes on, says so, and keeps its good map."""

import os
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from node_bench import call
from rclpy.publisher import Publisher


class Fault:
    """Stands before a function of a library: while it is on, calls that concern it raise."""

    def __init__(self, monkeypatch, owner, name, error, concerns=lambda *_: True):
        self.on = False
        self.calls = 0
        original = getattr(owner, name)

        def call(*arguments):
            if self.on and concerns(*arguments):
                self.calls += 1
                raise error
            return original(*arguments)

        monkeypatch.setattr(owner, name, call)


def publishing(monkeypatch, topic, error):
    """Return the fault that nothing can be published on a topic."""
    return Fault(monkeypatch, Publisher, 'publish', error,
                 lambda publisher, _: publisher.topic_name == topic)


def is_error(b, *words):
    level, sentence, _ = b.status()
    return level == DiagnosticStatus.ERROR and all(word in sentence for word in words)


def until_over(b):
    b.until(lambda: b.status()[0] == DiagnosticStatus.OK, 'it is over')


@pytest.mark.parametrize('topic, failing, error, said', [
    ('/path', 'update', ValueError('in\njected'), 'ValueError: in jected'),
    ('/path', 'update', MemoryError(), 'MemoryError'),
    ('/pose', 'odom', ValueError('injected'), 'ValueError: injected')])
def test_what_fails_is_an_error_until_it_works_again(
        bench, monkeypatch, tmp_path, topic, failing, error, said):
    fault = publishing(monkeypatch, topic, error)
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 3)
    b.map_of(3)
    until_over(b)
    fault.on = True
    b.drive(3, 5)
    b.until(lambda: is_error(b, f'{failing} failed: {said}'), 'it says so')
    b.until(lambda: b.status()[2]['odom.received'] == '5', 'messages are taken')
    assert call(b, 'save').message.startswith('5 keyframes saved')
    fault.on = False
    b.drive(5, 6)
    b.map_of(6)
    until_over(b)
    b.until(lambda: b.newest() == 6 * 10**9, 'odometry is answered')
    assert np.isfinite([message.pose.position.x for message in b.received['pose']]).all()


def test_a_failure_that_stays_is_logged_once_in_full_and_not_tried_all_the_time(
        bench, monkeypatch, capfd):
    fault = publishing(monkeypatch, '/path', ValueError('injected'))
    fault.on = True
    b = bench(**{'update.period': 0.001})
    b.drive(0, 3)
    b.until(lambda: fault.calls, 'a first update')
    began = time.monotonic()
    b.until(lambda: time.monotonic() > began + 1.2, 'a second later')
    # After pauses of .2, .4, .8 s: a hundred times as often would be a core's work.
    assert 2 <= fault.calls <= 4
    assert capfd.readouterr().err.count('Traceback') == 1
    # Whoever replaces the map is not to wait for a pause to be over.
    fault.on = False
    assert call(b, 'reset').success
    until_over(b)


def test_a_service_that_fails_says_so_and_the_next_one_is_answered(bench, monkeypatch, tmp_path):
    fault = Fault(monkeypatch, os, 'replace', MemoryError())
    b = bench(save_path=str(tmp_path / 'map.g2o'), autosave_period=0.0)
    b.drive(0, 3)
    b.map_of(3)
    fault.on = True
    answer = call(b, 'save')
    assert not answer.success and answer.message == 'MemoryError'
    b.until(lambda: is_error(b, '~/save failed: MemoryError'), 'it says so')
    b.drive(3, 4)
    b.map_of(4)
    assert call(b, 'optimize').success
    fault.on = False
    assert call(b, 'save').success
    until_over(b)
