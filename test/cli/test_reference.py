# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Truth at the times of keyframes: between true poses, never beyond them, and not across gaps."""

import re
from pathlib import Path

import numpy as np
import pytest
from command import run, solve_json
from messages import TYPES, header, numbers, odometry, of_rosbags, pose, pose_with_covariance
from rosbags.rosbag2 import StoragePlugin
from worlds import between, compose, edge, wrapped

from bags import rosbag2_directory

SECOND = 10**9


def drive(path, stamps, moved=(0.0, 0.0, 0.0), away=()):
    """
    Write a drive along a circle as a graph, with its stamps [ns]; return the path.

    moved : the pose that the map is moved by; away : rows that are besides far from their places
    """
    poses = true_at(stamps)
    steps, ids = between(poses[:-1], poses[1:]), 7 + 2 * np.arange(len(stamps))
    poses = compose(np.array(moved), poses)
    poses[away, 0] += 100.0
    path.write_text('\n'.join([
        *(f'VERTEX_SE2 {k} {x} {y} {theta}' for k, (x, y, theta) in zip(ids, poses, strict=True)),
        *(edge(k, k + 2, step, np.eye(3)) for k, step in zip(ids, steps, strict=False))]))
    Path(f'{path}.stamps.txt').write_text(''.join(
        f'{k} {stamp // SECOND}.{stamp % SECOND:09}\n'
        for k, stamp in zip(ids, stamps, strict=True)))
    return path


def true_at(stamps):
    angle = 0.05 * (np.asarray(stamps) - 100 * SECOND) / SECOND
    return np.stack((20 * np.sin(angle), -20 * np.cos(angle), wrapped(angle)), axis=1)


def write_truth(path, stamps):
    """Write the true poses at some stamps [ns] as TUM."""
    path.write_text(''.join(
        f'{stamp // SECOND}.{stamp % SECOND:09} {x} {y} 0 0 0 {np.sin(t / 2)} {np.cos(t / 2)}\n'
        for stamp, (x, y, t) in zip(stamps, true_at(stamps), strict=True)))
    return path


def compared(capsys, graph, truth, *more):
    """Return what is said of a map as it stands, and of its truth."""
    return solve_json(capsys, graph, '--no-robust', '--start', 'file', '--outer', 0,
                      '--reference', truth, *more)


# Keyframes that fall in between the true poses, which begin later, end earlier and have a hole.
KEYFRAMES = 100 * SECOND + np.arange(0, 60 * SECOND, 730_000_000)
TRUE = 110 * SECOND + np.arange(0, 40 * SECOND, 250_000_000)
TRUE = TRUE[(TRUE < 120 * SECOND) | (TRUE > 125 * SECOND)]
BEFORE, AFTER = TRUE[TRUE < 120 * SECOND], TRUE[TRUE > 125 * SECOND]
SCORED = (((BEFORE[0] <= KEYFRAMES) & (BEFORE[-1] >= KEYFRAMES))
          | ((AFTER[0] <= KEYFRAMES) & (AFTER[-1] >= KEYFRAMES)))


def test_truth_is_interpolated_at_the_stamps_of_the_poses(capsys, tmp_path):
    graph = drive(tmp_path / 'graph.g2o', KEYFRAMES)
    truth = write_truth(tmp_path / 'truth.tum', TRUE)
    report = compared(capsys, graph, truth)
    assert 30 < report['ate_poses'] < 60
    # A chord of a quarter of a metre; the nearest true pose is up to an eighth of one off.
    assert report['ate'] < 5e-4
    moved = drive(tmp_path / 'moved.g2o', KEYFRAMES, (3.0, 4.0, 1.0))
    assert compared(capsys, moved, truth)['ate'] < 5e-4
    # The keyframes that have no truth count for nothing.
    away = drive(tmp_path / 'away.g2o', KEYFRAMES, away=np.flatnonzero(~SCORED))
    assert compared(capsys, away, truth)['ate'] < 5e-4
    assert report['ate_poses'] == np.count_nonzero(SCORED)


def test_a_truth_that_is_slow_throughout_has_no_gaps(capsys, tmp_path):
    slow = 100 * SECOND + np.arange(0, 60 * SECOND, 5 * SECOND)
    report = compared(capsys, drive(tmp_path / 'graph.g2o', KEYFRAMES),
                      write_truth(tmp_path / 'truth.tum', slow))
    assert report['ate_poses'] == np.count_nonzero(slow[-1] >= KEYFRAMES)


def recorded(topic, messages):
    """Return pairs of type and message as a recording, all of 1 s."""
    return [(topic, kind, SECOND, bytes(TYPES.serialize_cdr(message, kind)))
            for kind, message in messages]


def message_of(kind, stamp, pose3):
    (x, y, theta), z = pose3.tolist(), 0.0
    q = 0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)
    new, name = of_rosbags, f'geometry_msgs/msg/{kind}'
    head = header(new, *divmod(int(stamp), SECOND), 'map')
    if kind == 'Odometry':
        return 'nav_msgs/msg/Odometry', odometry(new, head, position=(x, y, z), quaternion=q)
    if kind == 'TransformStamped':
        transform = new('geometry_msgs/msg/Transform', rotation=numbers(new, 'Quaternion', q),
                        translation=numbers(new, 'Vector3', (x, y, z)))
        return name, new(name, header=head, child_frame_id='b', transform=transform)
    make = pose if kind == 'PoseStamped' else pose_with_covariance
    return name, new(name, header=head, pose=make(new, (x, y, z), q))


@pytest.mark.parametrize('kind', [
    'PoseStamped', 'PoseWithCovarianceStamped', 'TransformStamped', 'Odometry'])
def test_a_topic_is_a_truth(capsys, tmp_path, kind):
    messages = [message_of(kind, stamp, pose)
                for stamp, pose in zip(TRUE, true_at(TRUE), strict=True)]
    lost = message_of(kind, TRUE[3], np.array([np.nan, 0.0, 0.0]))
    late = messages[::-1] + messages[:5] + [lost]
    rosbag2_directory(tmp_path / 'mocap', recorded('/robot/truth', late), StoragePlugin.MCAP)
    graph = drive(tmp_path / 'graph.g2o', KEYFRAMES, away=np.flatnonzero(~SCORED))
    report = compared(capsys, graph, f'{tmp_path}/mocap:/robot/truth')
    assert report['ate_poses'] == np.count_nonzero(SCORED) and report['ate'] < 5e-4
    assert report['warnings'] == [
        f'1 message on /robot/truth of {tmp_path}/mocap refused: not_finite']


@pytest.mark.parametrize('source, said', [
    ('bag:/nothing', 'no poses on /nothing; expected true poses; geometry_msgs/msg/PoseStamped '
     'is on /pose'),
    ('bag:/time', '/time is of builtin_interfaces/msg/Time; expected one of geometry_'),
    ('missing:/pose', 'missing: no such file or directory'),
    ('bag:/pose', 'shares 0 poses with the graph, expected 2 or more; it has times from '
     r'1\.0+ to 1\.0+ s, the graph times from [0-9.]+ to [0-9.]+ s$'),
])
def test_a_topic_that_is_none_is_one_line(capsys, tmp_path, monkeypatch, source, said):
    monkeypatch.chdir(tmp_path)
    time = ('builtin_interfaces/msg/Time', header(of_rosbags).stamp)
    rosbag2_directory(tmp_path / 'bag', [
        *recorded('/pose', [message_of('PoseStamped', SECOND, np.zeros(3))]),
        *recorded('/time', [time])], StoragePlugin.MCAP)
    graph = drive(tmp_path / 'graph.g2o', KEYFRAMES)
    error, = run(capsys, 'solve', graph, '--reference', source, code=2)[1].splitlines()
    assert re.search(said, error)


def test_a_graph_without_stamps_is_said_to_have_none(capsys, tmp_path):
    graph, truth = drive(tmp_path / 'graph.g2o', KEYFRAMES), tmp_path / 'truth.csv'
    Path(f'{graph}.stamps.txt').unlink()
    truth.write_text('5, 0, 0, 0\n6, 1, 0, 0\n')
    error, = run(capsys, 'solve', graph, '--reference', truth, code=2)[1].splitlines()
    assert 'the graph has no stamps, so its poses are 0.1 s apart from 1000 s on' in error


def test_the_command_says_over_how_many_poses(capsys, tmp_path, monkeypatch):
    """`bag` stands for an input that is one, whatever else is called so."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'bag').mkdir()
    run(capsys, 'simulate', 'world', '--poses', 120, '--edges', 200)
    ate = []
    for truth in ('world.truth.txt', 'world:/ground_truth', 'bag:/ground_truth'):
        report = solve_json(capsys, 'world', '--reference', truth)
        assert report['ate_poses'] == 120 and report['warnings'] == []
        ate.append(report['ate'])
    assert ate == pytest.approx([ate[0]] * 3, rel=1e-9) and 0 < ate[0] < 0.3
    lines = Path('world.truth.txt').read_text().splitlines()
    Path('half.txt').write_text('\n'.join(lines[::2]))
    said = run(capsys, 'solve', 'world', '--reference', 'half.txt')[0]
    assert ' m over 60 of 120 poses (RMSE after rigid alignment)' in said
