# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A signal ends the node soon, with exit code 0 and in silence, whatever it is doing."""

import signal
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from node_bench import DEADLINE, Peer, begin, call
from worlds import as_map, made

import l1slam_ros as l1

# [s] Two are promised; a busy machine takes its part.
SOON = 6.0


def until(condition, what):
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, f'waited {DEADLINE} s in vain until {what}'
        time.sleep(0.01)


def catches(process, number):
    """Tell whether a process has a handler for a signal."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    caught = int(status.split('SigCgt:')[1].split()[0], 16)
    return bool(caught >> (number - 1) & 1)


def session(process):
    """Return the live processes of the session that a process began."""
    alive = []
    for entry in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = entry.read_text().rsplit(')', 1)[1].split()
        except OSError:
            continue
        if int(fields[3]) == process.pid and fields[0] != 'Z':
            alive.append(int(entry.parent.name))
    return alive


def assert_ends(process, number):
    process.send_signal(number)
    began = time.monotonic()
    _, said = process.communicate(timeout=DEADLINE)
    assert time.monotonic() - began < SOON
    assert process.returncode == 0, said
    assert 'Traceback' not in said and 'ERROR' not in said and 'terminate' not in said, said
    until(lambda: not session(process), 'its children have ended too')


@pytest.mark.parametrize('number, first', [
    (signal.SIGINT, ''), (signal.SIGHUP, ''), (signal.SIGTERM, 'exec >&- 2>&-;')])
def test_while_it_is_being_imported(start, number, first):
    process = start(first=first)
    until(lambda: catches(process, signal.SIGTERM), 'it takes signals')
    assert_ends(process, number)


@pytest.fixture(scope='module')
def large(tmp_path_factory):
    return as_map(made(tmp_path_factory.mktemp('large') / 'map.g2o', 5000, 8000))


@pytest.mark.parametrize('service', ['save', 'optimize'])
def test_while_it_works(start, ros, large, service):
    """Right after a load an update of a map far from its optimum goes on."""
    process = start('--ros-args', '-p', f'save_path:={large}')
    b = Peer(ros)
    assert call(b, 'load').success
    begin(b, service)
    moment = time.monotonic() + 0.3
    b.until(lambda: time.monotonic() > moment, 'it is at work')
    assert_ends(process, signal.SIGTERM)
    b.close()
    assert l1.read_graph(large)[0].n_poses == 5000
    assert not list(large.parent.glob('.*'))


def test_under_nohup_it_lives_on_without_its_terminal(start):
    process = start(first='trap "" HUP;')
    until(lambda: catches(process, signal.SIGTERM), 'it takes signals')
    assert not catches(process, signal.SIGHUP)
    assert_ends(process, signal.SIGTERM)


def test_when_ros_is_shut_down_already(start):
    """Twice is no more than once."""
    process = start()
    assert 'ready' in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    assert_ends(process, signal.SIGINT)
