# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""However a recording was split, and in whichever order its files are listed: it is one bag."""

import json
import shutil
import sqlite3
from contextlib import closing, redirect_stdout
from io import StringIO

import pytest
from command import run
from worlds import simulated_bag

from bags import (
    MCAP,
    NOTE,
    SQLITE,
    TYPES,
    directory_of,
    mcap_file,
    recording_of,
    ros1_file,
    rosbag2_directory,
)
from l1slam_ros.cli.main import main

POSES = 80


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('world') / 'bag'
    return simulated_bag(path, POSES, 120)


@pytest.fixture(scope='module')
def recording(bag):
    return recording_of(bag)


def solved(capsys, folder, path, code=0, command=('solve',)):
    """Return the map of a bag, what is said as JSON without the time that it took, and errors."""
    output = folder / 'out.g2o'
    out, err = run(capsys, *command, path, '--output', output, '--json', code=code)
    return output.read_bytes(), {**json.loads(out), 'seconds': 0}, err


def by_number(recording, parts):
    size = -(-len(recording) // parts)
    return [recording[k * size:(k + 1) * size] for k in range(parts)]


def by_turns(recording, parts):
    return [recording[k::parts] for k in range(parts)]


def shuffled(names):
    return names[1::2] + names[::2][::-1]


@pytest.fixture(scope='module')
def plain(tmp_path_factory, bag):
    """Return the map of the bag, what is said of it, and what is in it."""
    output, said = tmp_path_factory.mktemp('plain') / 'out.g2o', []
    for command in ('solve', str(bag), '--output', str(output), '--json'), ('info', str(bag)):
        with redirect_stdout(StringIO()) as printed:
            main([*command])
        said.append(printed.getvalue())
    return output.read_bytes(), {**json.loads(said[0]), 'seconds': 0}, said[1]


@pytest.mark.parametrize('plugin', [MCAP, SQLITE])
@pytest.mark.parametrize('parts', [2, 12])
@pytest.mark.parametrize('cut', [by_number, by_turns])
def test_a_bag_in_parts_is_the_bag(tmp_path, capsys, plain, recording, cut, parts, plugin):
    pieces = cut(recording, parts)
    assert sum(map(len, pieces)) == len(recording)
    split = directory_of(tmp_path / 'bag', pieces, plugin, order=shuffled)
    assert (*solved(capsys, tmp_path, split)[:2], run(capsys, 'info', split)[0]) == plain


def test_ros1_files_in_one_folder_are_one_bag(tmp_path, capsys, recording):
    (tmp_path / 'drive').mkdir()
    for k, piece in enumerate(by_number(recording, 3)):
        ros1_file(tmp_path / 'drive' / f'x_2026-01-31-12-0{k}-00_{k}.bag', piece)
    whole = ros1_file(tmp_path / 'x.bag', recording)
    assert solved(capsys, tmp_path, tmp_path / 'drive')[:2] == solved(
        capsys, tmp_path, whole)[:2]
    shutil.copy(whole, tmp_path / 'drive' / 'y.bag')
    assert 'with the files of 2 bags' in run(
        capsys, 'info', tmp_path / 'drive', code=2)[1]


def test_files_named_by_index_and_time_are_one_bag_without_their_list(
        tmp_path, capsys, recording):
    split = directory_of(tmp_path / 'bag', by_number(recording, 12), MCAP)
    (split / 'metadata.yaml').unlink()
    for k in range(12):
        (split / f'bag_{k}.mcap').rename(split / f'{k}_bag_2026_01_31-12_{k:02}_30.mcap')
    found, _, said = solved(capsys, tmp_path, split, code=3)
    plain = rosbag2_directory(tmp_path / 'plain', recording, MCAP, note=None)
    assert found == solved(capsys, tmp_path, plain)[0]
    assert 'its metadata.yaml is missing' in said
    shutil.copy(split / '0_bag_2026_01_31-12_00_30.mcap',
                split / '0_bag_2026_02_28-12_00_30.mcap')
    assert 'with the files of 2 bags' in run(capsys, 'info', split, code=2)[1]


def test_standard_types_need_no_definition(tmp_path, capsys, plain, recording):
    mcap = mcap_file(tmp_path / 'a.mcap', recording, defined=False)
    sqlite = rosbag2_directory(tmp_path / 'b', recording, SQLITE)
    with closing(sqlite3.connect(sqlite / 'b.db3')) as database:
        assert database.execute("UPDATE message_definitions SET encoded_message_definition = ''"
                                ).rowcount
        database.commit()
    without = rosbag2_directory(tmp_path / 'plain', recording, MCAP, note=None)
    assert solved(capsys, tmp_path, mcap)[:2] == solved(capsys, tmp_path, without)[:2]
    assert solved(capsys, tmp_path, sqlite)[:2] == plain[:2]


def changed(recording, seconds=0, child=None):
    """Return messages that came so much later, also the times among them that loops name."""
    found, begin = [], recording[0][2] / 1e9
    for topic, msgtype, time, data in recording:
        message = TYPES.deserialize_cdr(data, msgtype)
        message.header.stamp.sec += seconds
        if topic == '/odom':
            message.child_frame_id = child or message.child_frame_id
        elif (earlier := float(message.header.frame_id.rpartition('@')[2])) >= begin:
            message.header.frame_id = f'base_link@{earlier + seconds:.9f}'
        found.append((topic, msgtype, time + seconds * 10**9,
                      bytes(TYPES.serialize_cdr(message, msgtype))))
    return found


def halves(folder, recording, **change):
    first, second = by_number(recording, 2)
    return [rosbag2_directory(folder / name, messages, MCAP, note=NOTE) for name, messages in (
        ('first', first), ('second', changed(second, **change)))]


def test_bags_of_one_drive_are_merged_as_one_bag(tmp_path, capsys, plain, recording):
    first, second = halves(tmp_path, recording)
    for inputs in (first, second), (second, first):
        found = solved(capsys, tmp_path, inputs[1], command=('merge', inputs[0]))
        assert found[0] == plain[0]
        assert f'{first}: {second} goes on where it ends; they are read as one drive' in found[2]


def test_a_loop_says_after_any_pause_that_a_bag_is_of_the_drive(tmp_path, capsys, recording):
    first, second = halves(tmp_path, recording, seconds=600)
    found = solved(capsys, tmp_path, second, command=('merge', first))[1]
    assert (found['poses'], found['loops'], found['parts']) == (
        POSES, sum(m[0] == '/loop_closures' for m in recording), 1)


@pytest.mark.parametrize('change', [
    {'child': 'another'}, {'seconds': 24 * 3600}, {'seconds': -5}], ids=str)
def test_bags_of_other_drives_stay_apart(tmp_path, capsys, recording, change):
    own = [message for message in recording if message[0] == '/odom']
    first, second = halves(tmp_path, own, **change)
    said = run(capsys, 'merge', first, second, '--output', tmp_path / 'out.g2o', code=None)[1]
    assert 'one drive' not in said
    assert f'{second}: nothing that is believed joins it to {first}' in said
