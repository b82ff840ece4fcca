# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Truth at the times of keyframes: between true poses, never beyond them, and not across gaps."""

from pathlib import Path

import numpy as np
import pytest
from command import run, solve_json
from messages import TYPES, header, numbers, odometry, of_rosbags, pose, pose_with_covariance
from rosbags.rosbag2 import StoragePlugin

from bags import rosbag2_directory
from l1slam_ros.cli.reference import position_error, read_truth, true_path
from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import poses_at
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.trajectory import write_tum

SECOND = 10**9


def test_nothing_is_extrapolated_nor_bridged():
    times, poses = np.array([10, 20, 30, 90, 100]), np.arange(15.0).reshape(5, 3) / 10
    at = np.array([8, 9, 10, 25, 30, 31, 32, 60, 88, 89, 90, 95, 100, 101, 102])
    rows, found = poses_at(se2, times, poses, at, 20, 1)
    assert at[rows].tolist() == [9, 10, 25, 30, 31, 89, 90, 95, 100, 101]
    # What lies beyond the end by rounding alone is at the end.
    np.testing.assert_allclose(found[[0, -1]], poses[[0, -1]], atol=1e-12)


def drive(stamps):
    """Return a record of a drive along a circle, and its poses (n, 3) at stamps [ns]."""
    poses = true_at(stamps)
    graph, k = FactorGraph(se2), np.arange(len(stamps) - 1)
    graph.add_poses(len(stamps))
    graph.add_between(k, k + 1, se2.between(poses[:-1], poses[1:]),
                      np.tile(np.eye(3), (len(k), 1, 1)))
    return GraphRecord(graph, poses, 7 + 2 * np.arange(len(stamps)), stamps), poses


def true_at(stamps):
    angle = 0.05 * (np.asarray(stamps) - 100 * SECOND) / SECOND
    return np.stack((20 * np.sin(angle), -20 * np.cos(angle), se2.wrap(angle)), axis=1)


# Keyframes that fall in between the true poses, which begin later, end earlier and have a hole.
KEYFRAMES = 100 * SECOND + np.arange(0, 60 * SECOND, 730_000_000)
TRUE = 110 * SECOND + np.arange(0, 40 * SECOND, 250_000_000)
TRUE = TRUE[(TRUE < 120 * SECOND) | (TRUE > 125 * SECOND)]
BEFORE, AFTER = TRUE[TRUE < 120 * SECOND], TRUE[TRUE > 125 * SECOND]
SCORED = (((BEFORE[0] <= KEYFRAMES) & (BEFORE[-1] >= KEYFRAMES))
          | ((AFTER[0] <= KEYFRAMES) & (AFTER[-1] >= KEYFRAMES)))


def test_truth_is_interpolated_at_the_stamps_of_the_poses(tmp_path):
    record, poses = drive(KEYFRAMES)
    write_tum(tmp_path / 'truth.tum', TRUE, true_at(TRUE), se2)
    truth = read_truth(str(tmp_path / 'truth.tum'), record, Path('graph.g2o'))
    assert truth.rows.tolist() == np.flatnonzero(SCORED).tolist() and 30 < len(truth.rows) < 60
    # A chord of a quarter of a metre; the nearest true pose is up to an eighth of one off.
    assert position_error(record, poses, truth) < 5e-4
    moved = se2.compose(np.tile([3.0, 4.0, 1.0], (len(poses), 1)), poses)
    assert position_error(record, moved, truth) < 5e-4
    path = true_path(record, moved, truth)
    gap = np.isnan(path[:, 0])
    assert gap.sum() == 1 and len(path) > 2 * len(truth.rows)
    centre = se2.compose(np.array([[3.0, 4.0, 1.0]]), np.zeros((1, 3)))[0, :2]
    np.testing.assert_allclose(np.linalg.norm(path[~gap] - centre, axis=1), 20, atol=1e-3)


def test_a_truth_that_is_slow_throughout_has_no_gaps(tmp_path):
    record, poses = drive(KEYFRAMES)
    slow = 100 * SECOND + np.arange(0, 60 * SECOND, 5 * SECOND)
    write_tum(tmp_path / 'truth.tum', slow, true_at(slow), se2)
    truth = read_truth(str(tmp_path / 'truth.tum'), record, Path('graph.g2o'))
    assert len(truth.rows) == np.count_nonzero(slow[-1] >= KEYFRAMES)


def recorded(topic, messages):
    """Return pairs of type and message as a recording, all of 1 s."""
    return [(topic, kind, SECOND, bytes(TYPES.serialize_cdr(message, kind)))
            for kind, message in messages]


def message_of(kind, stamp, pose3):
    x, y, z, *q = se2.to_pose3(pose3[None])[0].tolist()
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
def test_a_topic_is_a_truth(tmp_path, kind):
    record, poses = drive(KEYFRAMES)
    messages = [message_of(kind, stamp, pose)
                for stamp, pose in zip(TRUE, true_at(TRUE), strict=True)]
    lost = message_of(kind, TRUE[3], np.array([np.nan, 0.0, 0.0]))
    late = messages[::-1] + messages[:5] + [lost]
    rosbag2_directory(tmp_path / 'mocap', recorded('/robot/truth', late), StoragePlugin.MCAP)
    truth = read_truth(f'{tmp_path}/mocap:/robot/truth', record, Path('graph.g2o'))
    assert truth.rows.tolist() == np.flatnonzero(SCORED).tolist()
    assert position_error(record, poses, truth) < 5e-4
    assert truth.skipped == (f'1 message on /robot/truth of {tmp_path}/mocap refused: not_finite',)


@pytest.mark.parametrize('source, said', [
    ('bag:/nothing', 'no poses on /nothing; expected true poses; geometry_msgs/msg/PoseStamped '
     'is on /pose'),
    ('bag:/time', '/time is of builtin_interfaces/msg/Time; expected one of geometry_'),
    ('missing:/pose', 'missing: no such file or directory'),
    ('bag:/pose', 'shares 0 poses with the graph, expected 2 or more; it has times from '
     r'1\.0+ to 1\.0+ s, the graph times from [0-9.]+ to [0-9.]+ s$'),
])
def test_a_topic_that_is_none_is_one_line(tmp_path, monkeypatch, source, said):
    monkeypatch.chdir(tmp_path)
    record, _ = drive(KEYFRAMES)
    time = ('builtin_interfaces/msg/Time', header(of_rosbags).stamp)
    rosbag2_directory(tmp_path / 'bag', [
        *recorded('/pose', [message_of('PoseStamped', SECOND, np.zeros(3))]),
        *recorded('/time', [time])], StoragePlugin.MCAP)
    with pytest.raises(FileError, match=said):
        read_truth(source, record, Path('graph.g2o'))


def test_a_graph_without_stamps_is_said_to_have_none(tmp_path):
    record, _ = drive(KEYFRAMES)
    record = GraphRecord(record.graph, record.poses, record.ids)
    (tmp_path / 'truth.csv').write_text('5, 0, 0, 0\n6, 1, 0, 0\n')
    with pytest.raises(FileError, match='shares 0 poses with the graph, expected 2 or more; it '
                       r'has times from 5\.0+ to 6\.0+ s, the graph times from 1000\.0+ to '
                       r'1008\.20+ s; the graph has no stamps, so its poses are 0.1 s apart from '
                       '1000 s on'):
        read_truth(str(tmp_path / 'truth.csv'), record, Path('graph.g2o'))


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


def test_bicocca_by_its_stamps(capsys, datasets, tmp_path):
    """4.36 m by odometry alone, as its truth has it at 5 Hz with gaps."""
    real, graph = datasets / 'real', tmp_path / 'bicocca.g2o'
    graph.write_bytes((real / 'bicocca25b_0.150.g2o').read_bytes())
    Path(f'{graph}.stamps.txt').write_bytes((real / 'bicocca25b.stamps.txt').read_bytes())
    report = solve_json(capsys, graph, '--no-robust', '--start', 'odometry', '--outer', 0,
                        '--reference', real / 'bicocca25b.truth.csv')
    assert report['ate'] == pytest.approx(4.36, abs=0.02)
    assert 7000 < report['ate_poses'] < report['poses'] == 8358
