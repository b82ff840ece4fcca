# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""When the map of a running back end is saved, and what is never overwritten."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import odometry
from team import Team

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.io.graphs.map_file import MapFile, unusable_path
from l1slam_ros.io.graphs.saved_map import is_map, load_map
from l1slam_ros.io.graphs.side_files import beside
from l1slam_ros.io.node_options import NodeOptions

HOUR = 3600.0


class Robot:
    """A back end with a map file, its options, and what it warned of."""

    def __init__(self, path, period=1e-9):
        self.options = NodeOptions(save_path=str(path), autosave_period=period,
                                   on_time_jump='reset')
        self.backend = Backend(self.options)
        self.warnings = []
        self.seconds = 0
        self.map_file = MapFile(self.backend, lambda: self.options, self.warnings.append)

    def drive(self, count):
        for _ in range(count):
            self.seconds += 1
            self.backend.add_odometry(odometry(self.seconds, (self.seconds, 0.0, 0.0)))

    def load_at_start(self):
        """Load; return what is told that is no warning."""
        told = []
        self.map_file.load_at_start(told.append)
        return ''.join(told)

    def autosave(self):
        """Save where it is time, as the node does; return whether it was."""
        due = self.map_file.is_due()
        if due:
            self.map_file.autosave(periodic=True)
        return due


def keyframes(path):
    return len(load_map(path)[0].optimised.poses)


def test_a_map_is_saved_when_it_has_changed(tmp_path):
    robot, path = Robot(tmp_path / 'map.g2o'), tmp_path / 'map.g2o'
    assert not robot.autosave()
    robot.drive(1)
    assert robot.autosave() and not path.exists(), 'there is no graph yet'
    robot.drive(2)
    assert robot.autosave() and keyframes(path) == 3
    written = path.stat().st_ino
    assert not robot.autosave() and path.stat().st_ino == written
    robot.drive(1)
    assert robot.autosave() and keyframes(path) == 4 and not robot.warnings
    # A new map begins: the old one stays until there is more than that.
    robot.backend.reset()
    robot.map_file.autosave()
    assert keyframes(path) == 4


def test_the_first_save_waits_for_nothing(tmp_path):
    robot, path = Robot(tmp_path / 'map.g2o', HOUR), tmp_path / 'map.g2o'
    robot.drive(1)
    robot.autosave()
    robot.drive(1)
    assert robot.autosave() and keyframes(path) == 2
    robot.drive(1)
    assert not robot.autosave() and keyframes(path) == 2
    # What stands there and was not loaded may yet be; what was loaded is saved at once.
    another = Robot(path, HOUR)
    another.drive(3)
    assert not another.autosave() and keyframes(path) == 2
    going_on = Robot(path, HOUR)
    going_on.load_at_start()
    going_on.seconds = 10
    going_on.drive(1)
    assert going_on.autosave() and keyframes(path) == 3


@pytest.mark.parametrize('changes', [{'autosave_period': HOUR}, {'save_path': ''},
                                     {'autosave_period': 0.0}])
def test_it_is_saved_no_sooner_and_nowhere_that_nobody_said(tmp_path, changes):
    robot = Robot(tmp_path / 'map.g2o')
    robot.drive(2)
    if 'save_path' not in changes:
        robot.map_file.save()
        (tmp_path / 'map.g2o').unlink()
    robot.options = replace(robot.options, **changes)
    robot.drive(3)
    assert not robot.autosave()
    # At the end it is, if at all.
    robot.map_file.autosave()
    assert (tmp_path / 'map.g2o').exists() == (robot.options.autosave_period == HOUR)


@pytest.mark.parametrize('part, due', [(0.49, False), (0.51, True)])
def test_the_next_is_due_when_half_a_period_is_over(tmp_path, monkeypatch, part, due):
    """What is lost at most is so much, and what came while the one that is lost was written."""
    robot = Robot(tmp_path / 'map.g2o', period=HOUR)
    robot.drive(3)
    robot.map_file.autosave()
    now = time.monotonic() + part * HOUR
    monkeypatch.setattr(time, 'monotonic', lambda: now)
    assert not robot.map_file.is_due()
    robot.drive(1)
    assert robot.map_file.is_due() == due


def test_a_save_that_fails_is_tried_again_in_the_next_period(tmp_path):
    robot = Robot(tmp_path / 'none' / 'map.g2o', period=0.5)
    robot.drive(3)
    while not robot.map_file.is_due():
        time.sleep(0.01)
    with pytest.raises(FileError, match='none/map.g2o: cannot be written'):
        robot.map_file.autosave()
    assert not robot.map_file.is_due() and not robot.map_file.is_saving
    (tmp_path / 'none').mkdir()
    while not robot.autosave():
        time.sleep(0.01)
    assert is_map(tmp_path / 'none' / 'map.g2o')


@pytest.mark.parametrize('why', ['not loaded', 'reset', 'odometry'])
def test_a_map_that_was_not_loaded_is_kept_for_ever(tmp_path, why):
    """Also where the one who starts the node forgets to load it; or the map began anew."""
    path, first = tmp_path / 'map.g2o', Robot(tmp_path / 'map.g2o')
    first.drive(9)
    first.map_file.save()
    os.utime(path, (0, 0))
    if why == 'reset':
        first.backend.reset()
    first.seconds = 0 if why == 'odometry' else 9
    second = Robot(path) if why == 'not loaded' else first
    for _ in range(4):
        second.drive(3)
        assert second.autosave()
    kept = [p for p in tmp_path.iterdir() if p.name not in ('map.g2o', 'map.g2o.1')]
    assert len(kept) == 1 and keyframes(kept[0]) == 9 and keyframes(path) == 12
    assert kept[0].suffix == '.g2o' and second.warnings == [
        f'{path} held another map: it is kept as {kept[0]}']
    # Who says ~/save may not know what is there: it is kept as well, and the answer says so.
    former = {p.read_bytes() for p in tmp_path.iterdir()}
    third = Robot(path)
    for _ in range(2):
        third.drive(2)
        said = third.map_file.save()
        assert said.count('it is kept as') == (len(third.backend.poses) == 2) * 2
    assert keyframes(path) == 4 and keyframes(tmp_path / 'map.g2o.1') == 2
    assert former < {p.read_bytes() for p in tmp_path.iterdir()} and not third.warnings


@pytest.mark.parametrize('newer', [False, True])
def test_what_is_not_its_own_any_more_is_kept(tmp_path, newer):
    """A person copies a map to where the node saves; or it is damaged, or too new to be read."""
    path, robot = tmp_path / 'map.g2o', Robot(tmp_path / 'map.g2o')
    other = Robot(tmp_path / 'other.g2o')
    for one in robot, robot, other:
        one.drive(3)
        one.map_file.save()
    content = path.read_bytes()[:-100] if newer else other.map_file._path().read_bytes()
    path.write_bytes(content)
    if newer:
        robot = Robot(path)
        assert not robot.load_at_start() and len(robot.warnings) == 1
        robot.seconds = 6
    else:
        os.remove(tmp_path / 'other.g2o')
    for _ in range(3):
        robot.drive(1)
        assert robot.autosave()
    kept = [p for p in tmp_path.iterdir() if p.read_bytes() == content]
    assert len(kept) == 1 and robot.warnings[-1].endswith(f'it is kept as {kept[0]}')


def test_two_who_save_to_one_path_do_not_fill_the_disk(tmp_path):
    path, robots = tmp_path / 'map.g2o', [Robot(tmp_path / 'map.g2o') for _ in range(2)]
    robots[1].seconds = 100
    refused = []
    for _ in range(20):
        for robot in robots:
            robot.drive(2)
            try:
                robot.autosave()
            except FileError as error:
                assert str(error).startswith(f'{path}: another program saves there, too; expected')
                refused.append(robot)
    # Alone, the other goes on.
    assert len(refused) > 15 and len(set(refused)) == 1 and keyframes(path) == 40
    assert len(list(tmp_path.iterdir())) < 10
    # At its end each saves once more, and who asks for it is answered.
    for robot in robots:
        robot.map_file.autosave()
    assert len({p.read_bytes() for p in tmp_path.iterdir() if keyframes(p) == 40}) == 2
    (other,) = {*robots} - {*refused}
    assert 'it is kept as' in other.map_file.save()
    # Alone, or elsewhere, it saves as before.
    other.drive(1)
    assert other.autosave() and keyframes(path) == 41
    stopped = refused[0]
    stopped.options = replace(stopped.options, save_path=str(tmp_path / 'own.g2o'))
    assert stopped.autosave() and keyframes(tmp_path / 'own.g2o') == 40


def test_what_was_loaded_is_its_own(tmp_path):
    path, first = tmp_path / 'map.g2o', Robot(tmp_path / 'map.g2o')
    first.drive(9)
    first.map_file.save()
    second = Robot(path)
    assert second.load_at_start() == f'9 keyframes loaded from {path}'
    assert not second.autosave()
    second.seconds = 9
    second.drive(1)
    assert second.autosave() and keyframes(path) == 10
    assert {p.name for p in tmp_path.iterdir()} == {'map.g2o', 'map.g2o.1'}
    # Elsewhere, it is saved elsewhere; there may be another map.
    second.options = replace(second.options, save_path=str(tmp_path / 'other.g2o'))
    assert second.autosave() and keyframes(tmp_path / 'other.g2o') == 10
    assert not second.autosave() and not second.warnings


def test_at_start_a_missing_map_is_no_error_and_a_damaged_one_is_kept(tmp_path):
    path, robot = tmp_path / 'map.g2o', Robot(tmp_path / 'map.g2o')
    assert robot.load_at_start() == (
        f'the map begins empty: {path}: cannot be read: No such file or directory')
    assert not robot.warnings
    for _ in range(2):
        robot.drive(3)
        robot.map_file.save()
    path.write_bytes(path.read_bytes()[:-1])
    assert not robot.load_at_start()
    assert robot.warnings[0].startswith(f'3 keyframes loaded from {path}.1, the map before: ')
    (tmp_path / 'map.g2o.1').write_bytes(b'x')
    damaged, robot = path.read_bytes(), Robot(path)
    assert not robot.load_at_start()
    assert robot.warnings[0].startswith(f'the map begins empty: {path}: cannot be loaded: ')
    robot.drive(3)
    robot.map_file.autosave()
    assert keyframes(path) == 3
    assert damaged in [p.read_bytes() for p in tmp_path.iterdir() if p != path]


def test_a_map_of_another_dimension_is_refused(tmp_path):
    path, robot = tmp_path / 'map.g2o', Robot(tmp_path / 'map.g2o')
    path.write_text('VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n'
                    'EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n')
    beside(path, 'stamps').write_text('1\n2\n')
    with pytest.raises(FileError, match='map.g2o: a map of SE3, expected one of SE2'):
        robot.map_file.load()


def test_where_no_file_can_be_is_said(tmp_path):
    assert not unusable_path('') and not unusable_path(f'{tmp_path}/map.g2o')
    assert unusable_path('~no one/map.g2o').endswith('there is no folder ' + str(
        Path('~no one').absolute()))
    assert unusable_path(str(tmp_path)) == f"save_path is '{tmp_path}', which is a directory"
    # Too long a name is said by whoever reads or writes it, and ends nothing.
    robot = Robot(tmp_path / f'{"m" * 300}.g2o')
    assert not unusable_path(robot.options.save_path)
    assert robot.load_at_start().endswith(': File name too long')
    robot.drive(3)
    for call in robot.map_file.save, robot.map_file.autosave, robot.map_file.load:
        with pytest.raises(FileError, match='File name too long'):
            call()
    # A device may be read without end, and is nothing to be replaced by a file.
    robot.options = replace(robot.options, save_path=str(tmp_path / 'map.g2o'))
    (tmp_path / 'map.g2o').symlink_to('/dev/full')
    assert unusable_path(robot.options.save_path).endswith('which is not a regular file')
    for call in robot.map_file.save, robot.map_file.autosave, robot.map_file.load:
        with pytest.raises(FileError, match='map.g2o: cannot be (read|written): it is not a reg'):
            call()


def test_without_a_name_nothing_is_loaded(tmp_path):
    with pytest.raises(OptionError, match='save_path is empty, expected the name of a .g2o file'):
        Robot('').load_at_start()


class Fleet:
    """A back end with a map file, whose robots have names; a, b and c drive."""

    team = Team(n=90, edges=270, lies=0, robots=3)

    def __init__(self, path, names=''):
        self.options = NodeOptions.from_mapping({
            'save_path': str(path), 'robots': [*names], 'keyframe': {
                'translation': 0.0, 'rotation': 0.0}, 'odometry': {
                    'covariance_source': 'increment'}})
        self.backend = Backend(self.options)
        self.map_file = MapFile(self.backend, lambda: self.options, lambda _: None)
        self.number = [names.find(name) for name in 'abc']

    def drive(self):
        """Let c come first."""
        samples = [come for come in self.team.messages() if not isinstance(come[1], LoopClosure)]
        for robot, sample in sorted(samples, key=lambda come: (come[1].stamp, -come[0])):
            self.backend.add_odometry(sample, self.number[robot])

    def send_loops(self, of='abc'):
        """Send the loops between some; return how many."""
        sent = 0
        for _, _, loop in self.team.loops():
            if {'abc'[robot] for robot in loop.robots} <= {*of}:
                one, other = (self.number[robot] for robot in loop.robots)
                self.backend.add_loop(replace(loop, robot=other, reference_robot=one))
                sent += 1
        return sent

    def poses(self):
        """Return the poses of a, b and c as a sees them."""
        now = self.backend.snapshot()
        poses = [now.poses[now.graph.robot == number] for number in self.number]
        first = np.tile(poses[0][:1], (30, 1))
        return np.concatenate([se2.between(first, some) for some in poses])


def test_a_map_of_three_robots_is_loaded_by_their_names_in_any_order_and_by_fewer(tmp_path):
    path, fleet = tmp_path / 'map.g2o', Fleet(tmp_path / 'map.g2o', 'abc')
    fleet.drive()
    assert fleet.send_loops() == 181
    fleet.backend.settle()
    fleet.map_file.save()
    poses = fleet.poses()
    # Those that are not named here keep their names, and come behind.
    for names, then in ('cb', 'cba'), ('xcab', 'xcab'), ('abc', 'abcx'):
        fleet = Fleet(path, names)
        fleet.map_file.load()
        fleet.number = [then.index(name) for name in 'abc']
        assert_allclose(fleet.poses(), poses, atol=1e-9)
        sent, counts = fleet.send_loops([*{*names} - {'x'}]), fleet.backend.counts()
        assert counts.refused == {'repeated': sent} and counts.sizes['accepted_loops'] == 181
        fleet.backend.settle()
        fleet.map_file.save()
        poses = fleet.poses()


def test_a_robot_without_a_name_goes_on_in_the_map_of_several(tmp_path):
    """The graph begins with another one, and yet path and pose are of its own map."""
    fleet = Fleet(tmp_path / 'map.g2o', 'abc')
    fleet.drive()
    fleet.send_loops()
    while fleet.backend.update(1.0) is not None:
        pass
    fleet.map_file.save()
    assert fleet.backend.snapshot().graph.robot[0] == 2
    nameless = Fleet(tmp_path / 'map.g2o')
    nameless.map_file.load()
    backend, sample = nameless.backend, fleet.team.sample(29)
    backend.add_odometry(replace(sample, stamp=sample.stamp + 1))
    robot, last = backend.robot(), np.flatnonzero(backend.snapshot().graph.robot == 0)[-1:]
    assert_allclose(se2.compose(robot.map_to_odom, robot.odometry), backend.poses[last], atol=1e-6)
