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
from base64 import b64encode
from dataclasses import fields, is_dataclass, replace
from hashlib import sha256

import numpy as np
import pytest
from disk import Disk
from problems import EVERY, covariance6, loop, odometry, play

from l1slam_ros.cli.main import main
from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.robust.judgement import Doubt
from l1slam_ros.core.running.backend import Backend, BackendOptions, RobustOptions
from l1slam_ros.core.running.keeper import work
from l1slam_ros.core.running.snapshot import ACCEPTED, REJECTED, WAITING
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.graphs.saved_map import is_map, load_map, save_map
from l1slam_ros.io.ours import MARK

PLENTY = 60.0
# Struck out before it comes.
TO_COME = loop(0.6, 3.2, (3.0, 1.0, 0.5))


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 130, WorldOptions(), np.random.default_rng(1))


def settle(backend):
    while backend.update(PLENTY) is not None:
        pass


def first_half(world):
    """Return a back end in the middle of its run, with loops that were refused and that wait."""
    backend = Backend(EVERY)
    backend.add_loop(loop(20.0, 30.0, (1.0, 0.0, 0.0)))
    play(backend, world, 0, 50)
    backend.add_loop(loop(0.5, 4.0, (30.0, 40.0, 0.0), 1e-4 * np.eye(6)))
    backend.add_loop(replace(loop(0.7, 4.1, (3.0, 1.0, 0.5), 0.5 * np.eye(6)), trusted=True))
    backend.add_loop(replace(loop(0.0, 2.0, (20.0, 0.0, 0.3), 0.1 * np.eye(6)),
                             reference_stamp=None))
    for struck in False, True:
        backend.add_loop(replace(loop(0.3, 3.5, (3.0, 1.0, 0.5)), struck=struck))
    backend.add_loop(replace(TO_COME, struck=True))
    settle(backend)
    backend.add_loop(replace(loop(0.0, 6.0, (7.0, 8.0, 0.0), np.diag([1, 1, 0, 0, 0, np.inf])),
                             reference_stamp=None))
    backend.add_loop(loop(0.5, 7.0, (30.0, 40.0, 0.0), 1e-4 * np.eye(6)))
    return backend


@pytest.fixture(scope='module')
def halfway(world):
    return first_half(world)


def assert_equal(a, b):
    """Compare records field by field, number by number; a root is squared in the file."""
    assert type(a) is type(b)
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if is_dataclass(x):
            assert_equal(x, y)
        elif f.name == 'sqrt_information':
            np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14 * np.abs(x).max())
        elif f.name == 'graph':
            assert_equal(x.between, y.between)
        elif f.name == 'waiting':
            assert [t for _, t in x] == [t for _, t in y]
            for (one, _), (other, _) in zip(x, y, strict=True):
                assert_equal(one, other)
        elif f.name == 'ends':
            for one, other in zip(x, y, strict=True):
                assert_equal(one, other)
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        else:
            assert x == y and type(x) is type(y), f.name


def test_all_comes_back(halfway, tmp_path):
    saved, path = halfway.saved(), tmp_path / 'map.g2o'
    assert {WAITING, ACCEPTED, REJECTED} <= set(halfway.loop_states().state)
    assert saved.builder.graph.between.struck.sum() == 1
    doubtful = replace(saved.judgement, doubts=(
        Doubt('another map', 3, 4, 5, pairs=((4, 5), (5, 4))),),
                       variance=np.array([0.1, 2 / 3]), slips=np.array([7, 9]))
    saved = replace(saved, judgement=doubtful)
    assert save_map(path, saved) == f'50 keyframes saved to {path}'
    back, said, whole = load_map(path)
    assert whole and said == f'50 keyframes loaded from {path}'
    # Its graph has another name wherever it is loaded.
    assert_equal(replace(saved, graph_began=back.graph_began), back)
    assert back.judgement.doubts[0].pairs == ((4, 5), (5, 4))  # no part of their equality
    assert [p.name for p in tmp_path.iterdir()] == ['map.g2o']
    assert len(saved.builder.loops.waiting) == 3 and len(saved.builder.loops.seen) == 20


def test_what_is_loaded_goes_on_as_if_nothing_had_been(world, halfway, tmp_path, monkeypatch):
    path = tmp_path / 'map.g2o'
    save_map(path, halfway.saved())
    backend, undisturbed = Backend(EVERY), first_half(world)
    backend.restore(load_map(path)[0])
    np.testing.assert_array_equal(backend.poses, halfway.poses)
    np.testing.assert_array_equal(backend.snapshot().map_to_odom, halfway.snapshot().map_to_odom)
    # Nothing is judged anew, nor improved: there is nothing new.
    with monkeypatch.context() as patch:
        patch.setattr(work, 'improve', None)
        assert backend.update(PLENTY) is None
    for one in backend, undisturbed:
        one.add_loop(TO_COME)
        play(one, world, 50)
        settle(one)
        assert one.snapshot().graph.between.struck.sum() == 2
    a, b = (one.saved().optimised for one in (backend, undisturbed))
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-3)
    # Each is up to 6e-6 above the optimum (of 120 worlds), wherever it came from.
    assert a.cost == pytest.approx(b.cost, rel=1e-5)
    assert_equal(backend.saved().builder, undisturbed.saved().builder)
    np.testing.assert_array_equal(backend.loop_states().state, undisturbed.loop_states().state)


def test_the_motion_after_the_last_keyframe_is_not_lost(tmp_path):
    """Nor its covariance, nor the frame of the odometry."""
    options = BackendOptions(KeyframeOptions(1.0, 0.0, 0.0), OdometryOptions('increment'))
    backends, path = [Backend(options) for _ in range(2)], tmp_path / 'map.g2o'

    def drive(backend, first, last):
        for k in range(first, last):
            backend.add_odometry(odometry(k, (5 + 0.3 * k, 0.1 * k, 0.02 * k), covariance6(
                np.diag(1 + k + np.arange(3)) * 1e-4)))

    drive(backends[0], 0, 9)
    save_map(path, backends[0].saved())
    backends[1].restore(load_map(path)[0])
    for backend in backends:
        drive(backend, 9, 20)
    assert_equal(*(backend.saved().builder for backend in backends))
    # Begun elsewhere, or anew, odometry goes on from where the robot was.
    for time, pose in (30, (40.0, 50.0, 1.0)), (20, (0.0, 0.0, 0.0)), (9000, (8.0, 0.8, 0.16)):
        backends[0].restore(load_map(path)[0])
        assert backends[0].add_odometry(odometry(time, pose))
        moved = backends[0].robot().map_to_odom
        np.testing.assert_allclose(se2.compose(moved, np.array([pose])), [[7.4, 0.8, 0.16]],
                                   atol=1e-9)


def test_what_came_after_the_last_update_is_looked_at(world, tmp_path):
    backend, loaded = first_half(world), Backend(EVERY)
    settle(backend)
    backend.add_loop(replace(loop(0.9, 4.5, (3.0, 1.0, 0.5), 0.5 * np.eye(6)), trusted=True))
    save_map(tmp_path / 'map.g2o', backend.saved())
    loaded.restore(load_map(tmp_path / 'map.g2o')[0])
    for one in backend, loaded:
        assert one.update(PLENTY) is not None
        settle(one)
    np.testing.assert_allclose(loaded.poses, backend.poses, atol=2e-3)
    assert not np.allclose(loaded.poses, load_map(tmp_path / 'map.g2o')[0].optimised.poses)


def test_judged_otherwise_it_is_judged_anew(halfway, tmp_path):
    save_map(tmp_path / 'map.g2o', halfway.saved())
    backend = Backend(replace(EVERY, robust=RobustOptions(enabled=False)))
    backend.restore(load_map(tmp_path / 'map.g2o')[0])
    assert backend.update(PLENTY) is not None
    # What a person has struck out stays so.
    assert (backend.loop_states().state == REJECTED).sum() == 1


# Damage


@pytest.fixture
def two(halfway, tmp_path):
    """Return a path where a map of five keyframes has been saved, and then one of six."""
    backend, path = Backend(EVERY), tmp_path / 'map.g2o'
    for k in range(6):
        backend.add_odometry(odometry(k, (k, 0.0, 0.0)))
        if k > 3:
            save_map(path, backend.saved())
    return path


def damages(content, rng):
    """Yield the content cut short, and with a byte changed, 200 times each."""
    for length in rng.choice(len(content), 200, replace=False).tolist():
        yield content[:length]
    for place in rng.choice(len(content), 200, replace=False).tolist():
        byte = content[place] ^ int(rng.integers(1, 256))
        yield content[:place] + bytes([byte]) + content[place + 1:]


def test_what_is_damaged_is_noticed_and_the_map_before_taken(two, rng):
    content = two.read_bytes()
    for damaged in damages(content, rng):
        two.write_bytes(damaged)
        assert not is_map(two)
        saved, said, whole = load_map(two)
        assert len(saved.optimised.poses) == 5 and not whole
        # Of a file that is cut within its first line only that line can be complained of.
        assert re.match(re.escape(f'5 keyframes loaded from {two}.1, the map before: {two}')
                        + '(:1)?: ', said)
    two.write_bytes(content)
    assert load_map(two)[1] == f'6 keyframes loaded from {two}'


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


def hold(path, name, value):
    """Let a saved map hold another value, or none if it is empty, and prove itself as before."""
    lines = [line for line in path.read_text().splitlines()[:-1]
             if not line.startswith(f'#L1SLAM {name} ')]
    content = ''.join(f'{line}\n' for line in (*lines, f'#L1SLAM {name} {value}')[:len(
        lines) + bool(value)])
    path.write_text(f'{content}#L1SLAM sha256 {sha256(content.encode()).hexdigest()}\n')


@pytest.mark.parametrize('name', WRONG)
def test_where_the_contents_are_wrong_the_map_before_is_taken(two, capsys, name):
    content, before = two.read_bytes(), two.with_name('map.g2o.1')
    for value in WRONG[name]:
        two.write_bytes(content)
        hold(two, name, value)
        assert is_map(two)
        saved, said, whole = load_map(two)
        assert len(saved.optimised.poses) == 5 and not whole
        assert said.startswith(f'5 keyframes loaded from {before}, the map before: {two}: is a '
                               'saved map with wrong contents: '), said
    before.write_bytes(two.read_bytes())
    with pytest.raises(FileError, match='cannot be loaded: .*wrong contents.*wrong contents'):
        load_map(two)
    main(['info', str(two)])
    assert 'Traceback' not in capsys.readouterr().err


@pytest.mark.parametrize('stamps', [[0] * 6, [9, 8, 7, 6, 6, 6]])
def test_a_part_begins_where_saved_stamps_do_not_rise(two, stamps):
    hold(two, 'stamps', numbers(*stamps, kind='<i8'))
    hold(two, 'end', str(stamps[-1]))
    backend = Backend(EVERY)
    with np.errstate(all='raise'):
        backend.restore(load_map(two)[0])
        backend.add_odometry(odometry(20.0, (1.0, 2.0, 0.0)))
        settle(backend)
    assert backend.poses.shape == (7, 3) and np.isfinite(backend.poses).all()


def test_what_is_missing_is_noticed_and_the_map_before_taken(two):
    two.unlink()
    assert '.1, the map before: ' in load_map(two)[1]
    two.with_name('map.g2o.1').write_text('')
    with pytest.raises(FileError, match='map.g2o: cannot be loaded: .*map.g2o: cannot be read.*'
                       'map.g2o.1: the file is empty'):
        load_map(two)
    two.with_name('map.g2o.1').unlink()
    with pytest.raises(FileError, match='map.g2o: cannot be read: No such file'):
        load_map(two)


def test_what_is_damaged_takes_the_place_of_no_map(two, halfway):
    two.write_bytes(two.read_bytes()[:-1])
    save_map(two, halfway.saved())
    two.unlink()
    assert load_map(two)[1].startswith('5 keyframes')


def test_the_commands_read_both_and_notice_damage_too(two, capsys):
    assert main(['info', str(two)]) == main(['info', f'{two}.1']) == 0
    content = two.read_bytes()
    two.write_bytes(content.replace(b'EDGE_SE2 0 1 1.0', b'EDGE_SE2 0 1 2.0'))
    assert main(['info', str(two)]) == 2
    assert capsys.readouterr().err.strip().endswith(
        f'{two}: is damaged: its last line is not the checksum of those before; expected a saved '
        'map as it was written')
    two.write_bytes(content.replace(b'map 3', b'map 4'))
    assert not is_map(two)


def test_a_map_of_the_version_before_is_read(two, tmp_path):
    first, _, rest = two.read_text().partition('\n')
    assert first.endswith(' #L1SLAM map 3')
    lines = ['#L1SLAM map 2', first.removesuffix(' #L1SLAM map 3'), *rest.split('\n')[:-2]]
    content = ''.join(f'{line}\n' for line in lines)
    old = tmp_path / 'old.g2o'
    old.write_text(f'{content}#L1SLAM sha256 {sha256(content.encode()).hexdigest()}\n')
    assert is_map(old)
    saved, known = load_map(old)[0], load_map(two)[0]
    np.testing.assert_array_equal(saved.optimised.poses, known.optimised.poses)
    np.testing.assert_array_equal(saved.judgement.accepted,
                                  known.judgement.accepted)


def test_others_find_every_believed_edge_before_the_first_comment_line(two):
    lines = two.read_text().split('\n')
    graph = lines[: next(k for k, line in enumerate(lines) if line.startswith('#'))]
    tags = [line.split()[0] for line in graph]
    saved = load_map(two)[0]
    factors = saved.builder.graph.between
    believed = saved.judgement.accepted & ~factors.is_absolute
    assert tags.count('EDGE_SE2') == np.count_nonzero(believed)


# The disk


def content_of(path):
    return path.read_bytes() if path.exists() else None


def test_a_disk_that_fails_at_any_call_leaves_the_old_map_or_the_new_one(
        two, halfway, monkeypatch):
    old, before = two.read_bytes(), content_of(two.with_name('map.g2o.1'))
    for failing in range(20):
        with monkeypatch.context() as patch:
            disk = Disk(patch, two.parent, failing)
            try:
                save_map(two, halfway.saved())
                done = len(disk.calls) <= failing
            except FileError:
                done = False
        assert load_map(two)[1].split()[0] in ('6', '50')
        assert content_of(two.with_name('map.g2o.1')) in (old, before)
        assert {p.name for p in two.parent.iterdir()} == {'map.g2o', 'map.g2o.1'}
        if done:
            break
        two.write_bytes(old)
    assert done and failing > 4 and load_map(two)[1].startswith('50')


@pytest.mark.parametrize('early', [True, False])
def test_a_power_cut_leaves_a_map_at_any_moment(two, halfway, monkeypatch, early):
    before = two.with_name('map.g2o.1')
    found = []
    kept = []
    old = two.read_bytes(), before.read_bytes()

    def look():
        found.append(disk.after_a_power_cut(two, two.parent, early))
        kept.append(disk.after_a_power_cut(before, two.parent, early))

    disk = Disk(monkeypatch, two.parent, seen=look)
    save_map(two, halfway.saved())
    assert set(found) == {old[0], two.read_bytes()} and found[-1] == two.read_bytes()
    assert set(kept) == {old[1], old[0]} and kept[-1] == old[0]


def test_behind_a_link_the_map_before_is_kept_too(two, halfway):
    link = two.with_name('link.g2o')
    link.symlink_to(two.name)
    save_map(link, halfway.saved())
    assert link.is_symlink() and len(load_map(two)[0].optimised.poses) == len(halfway.poses)
    assert load_map(link.with_name('link.g2o.1'))[1].startswith('6 keyframes loaded')


def test_without_links_the_map_before_is_a_copy(two, halfway, monkeypatch):
    def refuse(*_):
        raise PermissionError

    old = two.read_bytes()
    monkeypatch.setattr(os, 'link', refuse)
    save_map(two, halfway.saved())
    assert two.with_name('map.g2o.1').read_bytes() == old


def test_what_killed_writers_left_is_removed(two, halfway):
    for name in '.map.g2o.0123abcd.tmp', '.map.g2o.1.0123abcd.tmp', '.other.g2o.0123abcd.tmp':
        two.with_name(name).write_text('half')
    save_map(two, halfway.saved())
    assert {p.name for p in two.parent.iterdir()} == {
        'map.g2o', 'map.g2o.1', '.other.g2o.0123abcd.tmp'}


# Others


def test_to_others_it_is_a_graph_with_comments(halfway, tmp_path):
    saved = halfway.saved()
    path = tmp_path / 'map.g2o'
    plain = tmp_path / 'plain.g2o'
    save_map(path, saved)
    graph, judgement = saved.builder.graph, saved.judgement
    write_graph_file(plain, GraphRecord(graph, saved.optimised.poses, np.arange(50)))
    lines = path.read_text().splitlines()
    def all_of(lines):
        return sorted(re.sub('^# [a-z]+ (EDGE.*) # factor [0-9]+$', r'\1', line).removesuffix(
            ' #L1SLAM map 3')
                      for line in lines if not line.startswith('#L') and line != MARK)

    assert all_of(lines) == all_of(plain.read_text().splitlines())
    used = sum(line.startswith('EDGE') for line in lines)
    assert used <= int(judgement.accepted.sum()) + (
        graph.between.is_odometry[len(judgement.accepted):].sum())
    # As long as the shortest of buffers that others read a line into.
    assert max(map(len, lines)) < 81920


def test_converted_it_keeps_stamps_and_trust(halfway, tmp_path):
    path, other = tmp_path / 'map.g2o', tmp_path / 'other.g2o'
    save_map(path, halfway.saved())
    assert main(['convert', str(path), str(other)]) == 0
    a, b = read_graph_file(path), read_graph_file(other)
    np.testing.assert_array_equal(a.stamps, b.stamps)
    np.testing.assert_array_equal(a.graph.between.trusted, b.graph.between.trusted)
    assert a.graph.between.trusted.sum() == 1 and not is_map(other)
    # A graph with the files beside it, as maps once were saved, is loaded, too.
    backend = Backend(EVERY)
    backend.restore(load_map(other)[0])
    np.testing.assert_array_equal(backend.poses, halfway.poses)
    np.testing.assert_array_equal(backend.snapshot().stamps, a.stamps)
    assert backend.update(PLENTY) is not None


def test_what_is_no_map_is_refused(halfway, tmp_path):
    path = tmp_path / 'map.g2o'
    backend = Backend(EVERY)
    backend.add_loop(replace(loop(0.0, 2.0, (20.0, 0.0, 0.3)), reference_stamp=None))
    backend.add_odometry(odometry(2.0, (0.0, 0.0, 0.0)))
    with pytest.raises(FileError, match='there is no graph yet to be saved'):
        save_map(path, backend.saved())
    saved = halfway.saved()
    write_graph_file(path, GraphRecord(saved.builder.graph, saved.optimised.poses, np.arange(50)))
    with pytest.raises(FileError, match='has no poses or no stamps; expected a saved map'):
        load_map(path)
