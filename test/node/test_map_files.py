# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""When the node saves its map, what it never overwrites, whose a file is, and what goes on."""

import os
import re
import signal
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from node_bench import (
    DEADLINE,
    EVERY_MESSAGE,
    Peer,
    call,
    loop,
    odometry,
    poses_of,
    set_parameter,
)
from worlds import as_map, edge

import l1slam_ros as l1

HOUR = 3600.0
SPACE = ('VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n'
         'EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n')


def keyframes(path):
    return l1.read_graph(path)[0].n_poses if path.exists() else 0


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'map.g2o'


@pytest.fixture
def at(bench, path):
    """Return what makes a node that saves there, by default when it is asked to."""
    return lambda period=0.0, **more: bench(save_path=str(path), autosave_period=period, **more)


def drive(b, first, last):
    """Drive; wait for the path."""
    count = len(b.path().poses)
    b.drive(first, last)
    b.map_of(count + last - first)


def save(b):
    answer = call(b, 'save')
    assert answer.success, answer.message
    return answer.message


def test_the_first_save_waits_for_nothing_and_the_next_until_half_a_period_is_over(
        at, path, monkeypatch):
    """What is lost at most is a period: so long the one that is lost may have been written."""
    first, clock = at(HOUR), time.monotonic
    drive(first, 0, 2)
    first.until(lambda: keyframes(path) == 2, 'it is saved')
    drive(first, 2, 3)
    for part in 0.0, 0.49:
        monkeypatch.setattr(time, 'monotonic', lambda part=part: clock() + part * HOUR)
        for _ in range(3):
            first.anew()
        assert keyframes(path) == 2
    monkeypatch.setattr(time, 'monotonic', lambda: clock() + 0.51 * HOUR)
    first.until(lambda: keyframes(path) == 3, 'it is saved again')
    written = path.stat().st_ino
    monkeypatch.setattr(time, 'monotonic', lambda: clock() + 2 * HOUR)
    first.anew()
    assert path.stat().st_ino == written, 'nothing has changed'


def test_what_stands_there_may_yet_be_loaded_and_what_was_loaded_is_saved_at_once(at, path):
    first = at()
    drive(first, 0, 9)
    save(first)
    first.close()
    another = at(HOUR)
    drive(another, 0, 3)
    for _ in range(3):
        another.anew()
    assert keyframes(path) == 9
    assert not set_parameter(another, 'autosave_period', 0.0)
    another.close()
    going_on = at(HOUR, load_on_start=True)
    going_on.map_of(9)
    drive(going_on, 9, 10)
    going_on.until(lambda: keyframes(path) == 10, 'it is saved')
    assert {p.name for p in path.parent.iterdir()} == {'map.g2o', 'map.g2o.1'}


def test_at_its_end_a_node_saves_only_if_it_saves_by_itself(bench, path):
    for period, save_path, saved in (0.0, path, 0), (HOUR, '', 0), (HOUR, path, 3):
        b = bench(save_path=str(save_path), autosave_period=period)
        drive(b, 0, 3)
        b.close()
        assert keyframes(path) == saved and any(path.parent.iterdir()) == (saved > 0)


@pytest.mark.parametrize('why', ['not loaded', 'reset', 'copied'])
def test_a_map_that_is_not_its_own_is_kept_for_ever(at, path, why):
    """Who starts the node forgets to load; the map began anew; a person copied another there."""
    b = at()
    drive(b, 0, 9)
    save(b)
    os.utime(path, (0, 0))
    former = path.read_bytes()
    if why == 'not loaded':
        b.close()
        b = at()
    elif why == 'reset':
        call(b, 'reset')
        b.map_of(0)
    else:
        path.write_text(SPACE)
        former = path.read_bytes()
    said = []
    for k in range(4):
        drive(b, 9 + 3 * k, 12 + 3 * k)
        said.append(save(b))
    kept, = (p for p in path.parent.iterdir() if p.name not in ('map.g2o', 'map.g2o.1'))
    assert kept.suffix == '.g2o' and kept.read_bytes() == former
    assert f'{path} held another map: it is kept as {kept}' in said[0]
    assert not any('is kept' in one for one in said[1:])
    assert keyframes(path) == len(b.path().poses) == keyframes(path.with_name('map.g2o.1')) + 3


def test_what_saves_by_itself_keeps_the_graph_of_a_user_too(at, path):
    path.write_text(SPACE)
    drive(at(0.2), 0, 3)
    assert SPACE in [p.read_text() for p in path.parent.glob('map.2*.g2o')]


def test_two_who_save_to_one_path_do_not_fill_the_disk(at, path):
    nodes, said = [at(0.2), at(0.2)], set()
    heard = nodes[0].listen(type(nodes[0].path()), 'path', 1000)
    for k in range(30):
        nodes[0].drive(k, k + 1)
        for b in nodes:
            b.anew()
            said |= {one.message for message in b.received['/diagnostics']
                     for one in message.status}
        if any('another program saves there' in one for one in said):
            break
    assert any(f'{path}: another program saves there, too; expected a save_path of its own' in one
               for one in said), said
    assert heard and len(list(path.parent.iterdir())) < 10
    # Who asks for it is answered.
    assert 'keyframes saved to' in save(nodes[0])


def test_at_start_a_missing_map_is_no_error_and_a_damaged_one_is_kept(at, path, capfd):
    first = at(load_on_start=True)
    said = capfd.readouterr().err
    assert f'the map begins empty: {path}: cannot be read: No such file or directory' in said
    assert 'WARN' not in said
    drive(first, 0, 3)
    save(first)
    first.close()
    damaged = path.read_bytes()[:-1]
    path.write_bytes(damaged)
    second = at(load_on_start=True)
    said = capfd.readouterr().err
    assert f'the map begins empty: {path}: is damaged: ' in said and 'WARN' in said
    drive(second, 0, 4)
    assert 'it is kept as' in save(second) and keyframes(path) == 4
    assert damaged in [p.read_bytes() for p in path.parent.iterdir()]


def test_what_cannot_be_saved_or_loaded_is_said(at, path):
    b = at()
    path.write_text(SPACE)
    path.with_name('map.g2o.stamps.txt').write_text('0 1\n1 2\n')
    assert 'map.g2o: a map of SE3, expected one of SE2' in call(b, 'load').message
    path.unlink()
    drive(b, 0, 3)
    assert 'there is no folder ' in set_parameter(b, 'save_path', '~no one/map.g2o')
    folder = str(path.parent)
    assert set_parameter(b, 'save_path', folder) == (
        f'save_path is {folder!r}, which is a directory')
    # Too long a name is said by whoever reads or writes it, and ends nothing.
    assert not set_parameter(b, 'save_path', str(path.parent / f'{"m" * 300}.g2o'))
    for service in 'save', 'load':
        answer = call(b, service)
        assert not answer.success and 'File name too long' in answer.message
    # A device may be read without end, and is nothing to be replaced by a file.
    assert not set_parameter(b, 'save_path', str(path))
    path.symlink_to('/dev/full')
    assert set_parameter(b, 'save_path', str(path)).endswith('which is not a regular file')
    for service in 'save', 'load':
        answer = call(b, service)
        assert not answer.success
        assert re.search('map.g2o: cannot be (read|written): it is not a reg', answer.message)
    assert not set_parameter(b, 'save_path', '')
    for service in 'save', 'load':
        assert 'save_path is empty, expected the name of a .g2o file' in call(b, service).message


def test_a_map_of_three_robots_is_loaded_by_their_names_in_any_order_by_fewer_and_by_none(
        at, path, bench):
    fleet, counts = at(robots=['a', 'b', 'c'], **EVERY_MESSAGE), {'c': 4, 'a': 3, 'b': 5}
    for name, count in counts.items():
        for k in range(count):
            fleet.send(f'/{name}/odom', odometry((k + 1) * 10**9, 1.0 * k, f'{name}/base_link'))
        fleet.until(lambda name=name, k=count: fleet.newest(f'{name}/') == k * 10**9, 'it drives')
    for name, other in ('c', 'a'), ('a', 'b'):
        fleet.send(f'/{name}/loop_closures', loop(
            2 * 10**9, 0.5, f'{other}/base_link@1.000000000', 0.01))
    fleet.until(lambda: len(fleet.loops()) == 2, 'loops join them')
    fleet.rest()
    save(fleet)
    fleet.close()
    # Those that are not named here keep their names, and come behind.
    for names in 'cb', 'xcab', 'abc':
        b = at(robots=[*names], load_on_start=True, **EVERY_MESSAGE)
        for name in {*names} - {'x'}:
            own = b.received[f'{name}/path']
            b.until(lambda own=own: own, 'the map is back')
            np.testing.assert_allclose(poses_of(own[-1])[:, 0], np.arange(counts[name]), atol=0.5)
        assert not any(one.poses for one in b.received.get('x/path', ()))
        save(b)
        b.close()
    # A robot without a name goes on in it; its pose is that of its path.
    nameless = bench(save_path=str(path), load_on_start=True, autosave_period=0.0, **EVERY_MESSAGE)
    nameless.map_of(12)
    nameless.send('/odom', odometry(60 * 10**9, 7.0))
    nameless.map_of(13)
    nameless.until(lambda: nameless.received['pose'], 'where it is')
    row, = (k for k, one in enumerate(nameless.path().poses) if one.header.stamp.sec == 60)
    pose = nameless.received['pose'][-1].pose.position
    assert (pose.x, pose.y) == pytest.approx(poses_of(nameless.path())[row, :2], abs=1e-6)


def test_a_map_that_cannot_be_saved_is_an_error_until_it_can(bench, path, capfd):
    path = path.with_name('none') / 'map.g2o'
    b = bench(save_path=str(path), autosave_period=0.2)
    said = f'save_path is {str(path)!r}, but there is no folder {path.parent}'
    assert said in capfd.readouterr().err
    assert set_parameter(b, 'save_path', str(path)) == said
    drive(b, 0, 3)
    b.until(lambda: b.status()[0] == DiagnosticStatus.ERROR
            and f'autosave failed: {path}: cannot be written: ' in b.status()[1], 'it says so')
    path.parent.mkdir()
    b.until(lambda: b.status()[0] != DiagnosticStatus.ERROR, 'it is over')
    assert keyframes(path) == 3


def test_a_large_map_is_published_whenever_it_has_grown(at, path):
    """By a thread of its own, which rests in between."""
    many = 10_002
    path.write_text('\n'.join(edge(k, k + 1, (1.0, 0.0, 0.0), 100 * np.eye(3))
                              for k in range(many - 1)) + '\n')
    as_map(path)
    b = at(load_on_start=True)
    b.map_of(many)
    for last in 3, 6:
        for k in range(last - 3, last):
            b.send('/odom', odometry((20_000 + k) * 10**9, 1.0 * k))
        poses = poses_of(b.map_of(many + last))
    np.testing.assert_allclose(poses[:many, 0], np.arange(many), atol=1e-3)
    np.testing.assert_allclose(poses[many:, 0], many - 1 + np.arange(6), atol=1e-3)


def test_a_killed_node_goes_on_where_it_was_and_a_signal_loses_nothing(ros, start, path):
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
    assert keyframes(path) == 20
    assert {p.name for p in path.parent.iterdir()} == {'map.g2o', 'map.g2o.1'}
