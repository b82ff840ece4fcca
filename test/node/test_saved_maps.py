# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A saved map: one file that says all, proves itself whole, and keeps the one before it."""

import os
import re
import shutil
from base64 import b64encode
from hashlib import sha256

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from command import run
from disk import Disk
from node_bench import EVERY_MESSAGE, Bench, call, loop, odometry, poses_of, set_parameter
from records import read
from std_srvs.srv import SetBool
from worlds import simulated_bag

from bags import mcap_file, recording_of

START = 1000 * 10**9
PAUSE = SetBool.Request(data=True)


def between(first, last, x, variance=0.0):
    """Return a loop between two times [s] of the recording."""
    frame = f'base_link@{1000 + int(first)}.{round(first % 1 * 1e9):09}'
    return loop(START + round(last * 1e9), x, frame, variance)


def absolute(seconds, x, variance):
    message = loop(START + round(seconds * 1e9), x, 'map', variance)
    if seconds > 5:  # a position without a heading
        message.pose.covariance = np.diag([1.0, 1, 0, 0, 0, np.inf]).ravel()
    return message


def ask(b, service):
    """Call a service; return what it says."""
    return call(b, service).message


def alone(parameters, act):
    """Let a node do something with nothing else around; return what."""
    rclpy.init()
    b = Bench(rclpy, parameters)
    try:
        return act(b)
    finally:
        b.close()
        rclpy.try_shutdown()


@pytest.fixture(scope='module')
def halves(tmp_path_factory):
    """Return two bags of one drive of 80 keyframes: 50 of them and the others."""
    folder = tmp_path_factory.mktemp('halves')
    recording = recording_of(simulated_bag(folder / 'bag', 80, 130, '--seed', 1))
    half = START + 4_950_000_000
    return [mcap_file(folder / f'{name}.mcap', part) for name, part in (
        ('first', [one for one in recording if one[2] < half]),
        ('second', [one for one in recording if one[2] >= half]))]


def first_half(b, bag):
    """Drive: with loops that were refused, struck out before and after, and that wait."""
    b.send('/loop_closures', between(20.0, 30.0, 1.0))
    b.play(bag)
    b.map_of(50)
    b.send('/loop_closures', between(0.5, 4.0, 30.0, 1e-4))
    b.send('/trusted_loop_closures', between(0.7, 4.1, 3.0, 0.5))
    b.send('/absolute_poses', absolute(2.0, 20.0, 0.1))
    b.send('/loop_closures', between(0.3, 3.5, 3.0))
    b.until(lambda: len(b.loops()) >= 4, 'they are there')
    for struck in (0.3, 3.5), (0.6, 3.2):  # the second one has yet to come
        b.send('/false_loop_closures', between(*struck, 3.0))
    b.send('/absolute_poses', absolute(6.0, 7.0, 1.0))
    b.send('/loop_closures', between(0.5, 7.0, 30.0, 1e-4))
    b.rest()


def second_half(b, bag):
    b.send('/loop_closures', between(0.6, 3.2, 3.0))
    b.play(bag)
    b.map_of(80)
    b.rest()


@pytest.fixture(scope='module')
def halfway(halves, tmp_path_factory):
    """Return a map in the middle of its run."""
    path = tmp_path_factory.mktemp('halfway') / 'map.g2o'

    def act(b):
        first_half(b, halves[0])
        assert ask(b, 'save') == f'50 keyframes saved to {path}'
        return path

    return alone({'save_path': str(path), 'autosave_period': 0.0, **EVERY_MESSAGE}, act)


@pytest.fixture(scope='module')
def both(tmp_path_factory):
    """Return a path where a map of five keyframes has been saved, and then one of six."""
    path = tmp_path_factory.mktemp('both') / 'map.g2o'

    def act(b):
        for first, last in (0, 5), (5, 6):
            b.drive(first, last)
            b.map_of(last)
            b.rest()
            ask(b, 'save')
        return path

    return alone({'save_path': str(path), 'autosave_period': 0.0, **EVERY_MESSAGE}, act)


@pytest.fixture
def two(both, tmp_path):
    """Return a copy of them."""
    for name in 'map.g2o', 'map.g2o.1':
        shutil.copy(both.with_name(name), tmp_path)
    return tmp_path / 'map.g2o'


def assert_same_lines(found, expected):
    """Compare lines; the information of an edge is computed, and may differ in its last digit."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        if one != other:
            words = one.split(), other.split()
            assert words[0][:3] == words[1][:3] and words[0][0].startswith('EDGE')
            np.testing.assert_allclose(*np.array([line[3:] for line in words], float),
                                       rtol=1e-13, atol=1e-12)


def at(bench, path, **parameters):
    """Return a node that saves to a path when it is asked to."""
    return bench(save_path=str(path), autosave_period=0.0, **EVERY_MESSAGE, **parameters)


def test_what_is_loaded_is_what_was_saved_and_goes_on_as_if_nothing_had_been(
        bench, halves, halfway, tmp_path):
    assert [p.name for p in halfway.parent.iterdir()] == ['map.g2o']
    path = shutil.copy(halfway, tmp_path / 'map.g2o')
    loaded = at(bench, path, load_on_start=True)
    loaded.map_of(50)
    loaded.rest()
    assert loaded.count('updates') == 0, 'nothing is judged anew, nor improved'
    assert len(loaded.received['path']) == 1
    np.testing.assert_allclose(poses_of(loaded.path()), read(path).poses, atol=1e-12)
    assert {'waiting', 'accepted', 'rejected'} == set(loaded.states())
    # Saved again, every line is as it was.
    again = tmp_path / 'again.g2o'
    assert not set_parameter(loaded, 'save_path', str(again))
    ask(loaded, 'save')
    assert_same_lines(again.read_text().splitlines()[:-1], path.read_text().splitlines()[:-1])
    second_half(loaded, halves[1])
    found, poses = loaded.loops(), poses_of(loaded.path())
    loaded.close()
    undisturbed = at(bench, tmp_path / 'other.g2o')
    first_half(undisturbed, halves[0])
    second_half(undisturbed, halves[1])
    np.testing.assert_allclose(poses_of(undisturbed.path()), poses, atol=1e-3)
    assert {ends: state for ends, (state, _) in undisturbed.loops().items()} == {
        ends: state for ends, (state, _) in found.items()}


def test_the_motion_after_the_last_keyframe_is_not_lost(bench, tmp_path):
    """Nor its covariance, nor the frame of the odometry."""
    parameters = {'keyframe.translation': 1.0, 'keyframe.rotation': 0.0, 'autosave_period': 0.0,
                  'odometry.covariance_source': 'increment'}

    def drive(b, first, last):
        for k in range(first, last):
            message = odometry((k + 1) * 10**9, 5 + 0.3 * k)
            message.pose.covariance = np.diag((1 + k + np.arange(6)) * 1e-4).ravel()
            b.send('/odom', message)
        b.until(lambda: b.newest() == last * 10**9, 'all is used')
        b.rest()

    path, ends = tmp_path / 'map.g2o', []
    first = bench(save_path=str(path), **parameters)
    drive(first, 0, 9)
    ask(first, 'save')
    first.close()
    for name in 'one.g2o', 'other.g2o':
        loads = name == 'one.g2o'
        b = bench(save_path=str(path), load_on_start=loads, **parameters)
        drive(b, 9 if loads else 0, 20)
        assert not set_parameter(b, 'save_path', str(tmp_path / name))
        ask(b, 'save')
        ends.append([line for line in (tmp_path / name).read_text().splitlines()
                     if not re.match('#L1SLAM (sha256|cost|dual|status)', line)])
        b.close()
    assert ends[0] == ends[1] and sum(line.startswith('VERTEX') for line in ends[0]) == 5


def test_loops_that_came_after_the_last_update_are_judged_where_they_are_loaded(
        bench, halfway, tmp_path):
    path = shutil.copy(halfway, tmp_path / 'map.g2o')
    ends = START + 900_000_000, START + 4_500_000_000
    first = at(bench, path, load_on_start=True)
    call(first, 'pause', PAUSE)
    first.send('/trusted_loop_closures', between(0.9, 4.5, 3.0, 0.5))
    first.send('/loop_closures', between(1.2, 4.4, 3.0, 0.5))
    first.until(lambda: (ends[0] + 3 * 10**8, ends[1] - 10**8) in first.loops(), 'both are there')
    for k in range(2):
        first.send('/odom', odometry(START + (5 + k) * 10**9, 1.0 * k))
    first.until(lambda: first.count('keyframes') == 52, 'a step')
    ask(first, 'save')
    assert re.search('^# suspect EDGE_SE2 12 44 ', path.read_text(), re.M), 'nobody judged it'
    assert re.search('^EDGE_SE2 50 51 ', path.read_text(), re.M), 'a step is no loop'
    first.close()
    second = at(bench, path, load_on_start=True)
    second.until(lambda: second.count('updates') > 0 and second.loops()[ends][0] == 'accepted'
                 and not np.allclose(poses_of(second.path()), read(path).poses, atol=1e-3),
                 'they move the map')
    second.close()
    # Judged otherwise, it is judged anew; what a person has struck out stays so.
    third = at(bench, path, load_on_start=True, **{'robust.enabled': False})
    third.until(lambda: third.states()['rejected'] == 1, 'all but one is accepted')


# Damage


def test_what_is_damaged_is_noticed_wherever_it_is(capsys, two, rng):
    whole, said = two.read_bytes(), set()
    for name in two, f'{two}.1':
        run(capsys, 'info', name)
    for place in rng.choice(len(whole), 60, replace=False).tolist():
        byte = bytes([whole[place] ^ int(rng.integers(1, 256))])
        for damaged in whole[:place], whole[:place] + byte + whole[place + 1:]:
            two.write_bytes(damaged)
            said.add(run(capsys, 'info', two, code=2)[1])
    assert (f'l1slam: {two}: is damaged: its last line is not the checksum of those before; '
            'expected a saved map as it was written\n') in said


def numbers(*values, kind='<f8'):
    return f'{kind} {b64encode(np.array(values, kind).tobytes()).decode()}'


# Values of a map of six keyframes in a row, which begin one of its comment lines.
WRONG = {
    'stamps': ('', numbers(1, 2, kind='<i8'), '"x"', 'nonsense', numbers(*[np.nan] * 6),
               numbers(*[0, 2**62] * 3, kind='<i8')),
    'odometry': (numbers(0, 0, 0), numbers(*[np.nan] * 18), numbers(*[1e300] * 18)),
    'offset': ('[]', '[null]', numbers(0, 0)),
    'end': ('null', '"x"', '1e300', '99999999999999999999'),
    'end_covariance': (numbers(1, 2, 3), '[[1]]'),
    'loop_rows': (numbers(7, kind='<i8'), numbers(-1, kind='<i8')),
    'struck_pairs': (numbers(0, 9, kind='<i8'), numbers(0, kind='<i8')),
    'seen': ('[["00",0]]', '[["zz",0]]', '[["' + 32 * '0' + '",9]]', '[1]'),
    'waiting': ('[1]', '[[1,2,3]]', f'[["x",2,false,false,0,{[0] * 7},{[[0] * 6] * 6}]]',
                f'[[1,2,false,false,0,{[0] * 7},{[[0] * 6] * 6}]]'),
    'dual': ('', '[]', numbers(1), numbers(*[np.nan] * 15)),
    'status': ('"nonsense"', '7'),
    'accepted': (numbers(*[1] * 9, kind='|b1'), '3'),
    'sigmas': (numbers(1),),
    'variance': (numbers(1), numbers(0, -1), numbers(np.nan, np.nan)),
    'slips': (numbers(5, kind='<i8'),),
    'doubts': ('[{}]', '[1]', '{"kind":1}',
               '[{"kind":"parts","loops":1,"first":0,"last":9,"detail":"","pairs":[]}]'),
    'robust': ('"yes"', 'null', '[' * 9000),
    'trusted': (numbers(1, kind='|b1'), 'null'),
}


def proven(path, lines):
    content = ''.join(f'{line}\n' for line in lines)
    path.write_text(f'{content}#L1SLAM sha256 {sha256(content.encode()).hexdigest()}\n')


def hold(path, name, value):
    """Let a saved map hold another value, or none if it is empty, and prove itself as before."""
    lines = [line for line in path.read_text().splitlines()[:-1]
             if not line.startswith(f'#L1SLAM {name} ')]
    proven(path, [*lines, *[f'#L1SLAM {name} {value}'] * bool(value)])


def test_where_the_contents_are_wrong_or_cut_the_map_before_is_taken(bench, two, capfd):
    whole, before = two.read_bytes(), two.with_name('map.g2o.1')
    b = at(bench, two)
    taken = f'5 keyframes loaded from {before}, the map before: {two}: '
    for name, values in WRONG.items():
        for value in values:
            two.write_bytes(whole)
            hold(two, name, value)
            said = ask(b, 'load')
            assert said.startswith(f'{taken}is a saved map with wrong contents: '), (name, said)
            assert 'Traceback' not in run(capfd, 'info', two, code=None)[1]
    good = before.read_bytes()
    b.close()
    b = at(bench, two, load_on_start=True)
    b.map_of(5)
    assert taken in capfd.readouterr().err
    assert 'held another map' in ask(b, 'save')
    assert before.read_bytes() == good, 'nonsense does not take its place'
    two.write_bytes(whole)
    hold(two, 'stamps', 'nonsense')
    before.write_bytes(two.read_bytes())
    answer = call(b, 'load')
    assert not answer.success and re.search('cannot be loaded: .*wrong contents.*wrong contents',
                                            answer.message)
    before.write_bytes(good)
    two.write_bytes(whole[:-1])
    assert ask(b, 'load').startswith(taken)
    two.unlink()
    assert ask(b, 'load').startswith(taken)
    before.write_text('')
    answer = call(b, 'load')
    assert not answer.success and re.search(
        r'map.g2o: cannot be loaded: .*cannot be read.*map.g2o.1: the file is empty',
        answer.message)
    before.unlink()
    assert re.search('map.g2o: cannot be read: No such file', ask(b, 'load'))
    two.write_bytes(whole)
    assert ask(b, 'load') == f'6 keyframes loaded from {two}'


@pytest.mark.parametrize('stamps', [[0] * 6, [9, 8, 7, 6, 6, 6]])
def test_a_part_begins_where_saved_stamps_do_not_rise(bench, two, stamps):
    hold(two, 'stamps', numbers(*stamps, kind='<i8'))
    hold(two, 'end', str(stamps[-1]))
    b = at(bench, two, load_on_start=True)
    b.send('/odom', odometry(20 * 10**9, 1.0))
    assert np.isfinite(poses_of(b.map_of(7))).all()


def test_a_map_of_the_version_before_is_read(bench, two):
    known = read(two)
    first, _, rest = two.read_text().partition('\n')
    assert first.endswith(' #L1SLAM map 3')
    proven(two, ['#L1SLAM map 2', first.removesuffix(' #L1SLAM map 3'), *rest.split('\n')[:-2]])
    b = at(bench, two)
    assert ask(b, 'load') == f'6 keyframes loaded from {two}'
    np.testing.assert_array_equal(poses_of(b.map_of(6)), known.poses)


# The disk


@pytest.fixture
def writer(bench, two):
    """Return a node that loaded the map of six keyframes, and has driven on."""
    b = at(bench, two, load_on_start=True)
    b.drive(6, 8)
    b.map_of(8)
    b.rest()
    return b


def test_a_disk_that_fails_at_any_call_leaves_the_old_map_or_the_new_one(
        writer, two, monkeypatch):
    before = two.with_name('map.g2o.1')
    old = two.read_bytes(), before.read_bytes()
    for failing in range(20):
        with monkeypatch.context() as patch:
            disk = Disk(patch, two.parent, failing)
            done = call(writer, 'save').success and len(disk.calls) <= failing
        assert len(read(two).poses) in (6, 8)
        assert before.read_bytes() in old
        if done:
            break
        two.write_bytes(old[0])
        before.write_bytes(old[1])
        for kept in two.parent.glob('map.2*'):
            kept.unlink()
    assert done and failing > 4 and len(read(two).poses) == 8


@pytest.mark.parametrize('early', [True, False])
def test_a_power_cut_leaves_a_map_at_any_moment(writer, two, monkeypatch, early):
    before = two.with_name('map.g2o.1')
    found, kept = [], []
    old = two.read_bytes(), before.read_bytes()

    def look():
        found.append(disk.after_a_power_cut(two, two.parent, early))
        kept.append(disk.after_a_power_cut(before, two.parent, early))

    disk = Disk(monkeypatch, two.parent, seen=look)
    ask(writer, 'save')
    assert set(found) == {old[0], two.read_bytes()} and found[-1] == two.read_bytes()
    assert set(kept) == {old[1], old[0]} and kept[-1] == old[0]


@pytest.mark.parametrize('links', [True, False])
def test_behind_a_link_the_map_before_is_kept_and_what_killed_writers_left_is_removed(
        writer, two, monkeypatch, links):
    def refuse(*_):
        raise PermissionError

    if not links:  # then it is a copy
        monkeypatch.setattr(os, 'link', refuse)
    link, old = two.with_name('link.g2o'), two.read_bytes()
    link.symlink_to(two.name)
    for name in '.map.g2o.0123abcd.tmp', '.map.g2o.1.0123abcd.tmp', '.other.g2o.0123abcd.tmp':
        two.with_name(name).write_text('half')
    assert not set_parameter(writer, 'save_path', str(link))
    assert '8 keyframes saved' in ask(writer, 'save')
    assert link.is_symlink() and len(read(two).poses) == 8
    assert old in [p.read_bytes() for p in two.parent.iterdir() if p != two]
    assert {p.name for p in two.parent.glob('.*')} == {'.other.g2o.0123abcd.tmp'}


# Others


def test_to_others_it_is_a_graph_with_comments_and_converted_it_keeps_stamps_and_trust(
        halfway, tmp_path, capsys, bench):
    other = tmp_path / 'other.g2o'
    run(capsys, 'convert', halfway, other)

    lines = halfway.read_text().splitlines()
    edges = [sorted(re.sub('^# [a-z]+ (EDGE.*) # factor [0-9]+$', r'\1', line).removesuffix(
        ' #L1SLAM map 3') for line in path.read_text().splitlines() if 'EDGE' in line)
        for path in (halfway, other)]
    assert_same_lines(*edges)
    # As long as the shortest of buffers that others read a line into.
    assert max(map(len, lines)) < 81920
    # Others find every edge that is used before the first comment line.
    first = next(k for k, line in enumerate(lines) if line.startswith('#'))
    assert not any(line.startswith('EDGE_SE2') for line in lines[first:])
    a, b = read(halfway), read(other)
    np.testing.assert_array_equal(a.stamps, b.stamps)
    np.testing.assert_array_equal(a.graph.between.trusted, b.graph.between.trusted)
    assert a.graph.between.trusted.sum() == 1
    # A graph with the files beside it, as maps once were saved, is loaded, too.
    node = at(bench, other, load_on_start=True)
    node.until(lambda: len(node.path().poses) == 50 and node.count('updates') > 0, 'the map')
    assert '#L1SLAM' not in other.read_text()
    plain = tmp_path / 'plain.g2o'
    plain.write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    assert not set_parameter(node, 'save_path', str(plain))
    assert 'has no poses or no stamps; expected a saved map' in ask(node, 'load')
    call(node, 'reset')
    assert 'there is no graph yet to be saved' in ask(node, 'save')
