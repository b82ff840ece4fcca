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
from hashlib import sha256

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from node_bench import DEADLINE, Peer, call, odometry, poses_of, set_parameter
from worlds import as_map, edge

import l1slam_ros as l1

GRAPH = """# my own graph
VERTEX_SE2 10 0 0 0
VERTEX_SE2 13 1 0 0
VERTEX_SE2 16 2 0 0
EDGE_SE2 10 13 1 0 0 100 0 0 100 0 100
EDGE_SE2 13 16 1 0 0 100 0 0 100 0 100
"""


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
    assert not set_parameter(b, 'autosave_period', 1e6)
    b.drive(5, 6)
    b.map_of(6)
    assert keyframes(other) == 5
    assert b.close() and keyframes(other) == 6


def test_a_settled_map_is_loaded_at_start_and_published_at_once(bench, tmp_path):
    path = tmp_path / 'map.g2o'
    first = bench(save_path=str(path))
    first.drive(0, 4)
    first.map_of(4)
    first.rest()
    assert call(first, 'save').success
    before = poses_of(first.path())
    first.close()  # or what it publishes would be heard, too
    second = bench(save_path=str(path), load_on_start=True)
    np.testing.assert_array_equal(poses_of(second.map_of(4)), before)
    second.anew()
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
    first = bench(save_path=str(path), autosave_period=0.0)  # nothing is saved when it ends
    for last in 4, 5:
        first.drive(0 if last == 4 else 4, last)
        first.map_of(last)
        assert call(first, 'save').success
    first.close()
    hold_nonsense(path)
    good = before.read_bytes()
    capfd.readouterr()
    second = bench(save_path=str(path), load_on_start=True)
    second.map_of(4)
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
    third.map_of(3)


def test_a_large_map_is_published_whenever_it_has_grown(bench, tmp_path):
    """By a thread of its own, which rests in between."""
    path, many = tmp_path / 'map.g2o', 10_002
    path.write_text('\n'.join(edge(k, k + 1, (1.0, 0.0, 0.0), 100 * np.eye(3))
                              for k in range(many - 1)) + '\n')
    b = bench(save_path=str(as_map(path)), load_on_start=True)
    b.map_of(many)
    for last in 3, 6:
        for k in range(last - 3, last):
            b.send('/odom', odometry((20_000 + k) * 10**9, 1.0 * k))
        poses = poses_of(b.map_of(many + last))
    np.testing.assert_allclose(poses[:many, 0], np.arange(many), atol=1e-3)
    np.testing.assert_allclose(poses[many:, 0], many - 1 + np.arange(6), atol=1e-3)


def kept_in(folder):
    """Return the file that has the graph by the name of a day; beside it `.1` may have it, too."""
    kept, = (file for file in folder.glob('map.2*.g2o') if file.read_bytes() == GRAPH.encode())
    return kept


@pytest.mark.parametrize('period', [0.0, 0.2], ids=['saved when asked', 'saved by itself'])
def test_a_graph_of_a_user_at_save_path_outlives_every_save_and_reset(bench, tmp_path, period):
    path = tmp_path / 'map.g2o'
    path.write_text(GRAPH)
    b = bench(save_path=str(path), autosave_period=period)
    for begin in (0, 5):
        b.drive(begin, begin + 4)
        b.until(lambda: b.count('keyframes') == 4, 'a map')
        message = call(b, 'save').message
        assert period or begin or str(kept_in(tmp_path)) in message
        assert call(b, 'save').success and call(b, 'reset').success
        assert kept_in(tmp_path)
        b.map_of(0)
        b.anew()


def test_a_killed_node_goes_on_where_it_was_and_a_signal_loses_nothing(ros, start, tmp_path):
    path = tmp_path / 'map.g2o'

    def begin():
        return start('--ros-args', '-p', f'save_path:={path}', '-p', 'autosave_period:=0.2', '-p',
                     'load_on_start:=true'), Peer(ros)

    process, first = begin()
    first.until_heard()
    first.drive(0, 10)
    first.until(lambda: keyframes(path) == 10, 'all is saved')
    process.kill()
    process.wait(DEADLINE)
    first.close()
    process, second = begin()
    second.map_of(10)
    second.until_heard()
    second.drive(10, 20)
    np.testing.assert_allclose(poses_of(second.map_of(20))[:, 0], np.arange(20), atol=1e-6)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=DEADLINE)
    second.close()
    assert process.returncode == 0 and '10 keyframes loaded from' in said, said
    *lines, last = path.read_text().splitlines(keepends=True)
    assert last.split() == ['#L1SLAM', 'sha256', sha256(''.join(lines).encode()).hexdigest()]
    assert keyframes(path) == 20
    assert set(os.listdir(tmp_path)) == {'map.g2o', 'map.g2o.1'}
