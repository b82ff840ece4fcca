# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The scan front end beside the back end, over DDS, in rooms that are known."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from corridors import RAYS, WALLS, by_wheels, laps, ranges_from
from node_bench import ScanBench, call, poses_of, stamp_of
from worlds import compose, position_error

# A hall that is nothing like the rooms [m].
ELSEWHERE = np.array([(-2.0, -1.0, 19.0, -4.0), (19.0, -4.0, 17.0, 3.1), (17.0, 3.1, 6.0, 2.4),
                      (6.0, 2.4, 4.0, 5.5), (4.0, 5.5, -2.0, 4.2), (-2.0, 4.2, -2.0, -1.0)])


def test_two_laps_make_a_map(ros, tmp_path, rng):
    """By a laser that hangs upside down, before and beside the middle of the robot."""
    truth = laps(2)
    wheels, laser = by_wheels(truth, rng), np.array([0.2, 0.1, 0.5])
    r = ScanBench(ros, backend=True, map_path=str(tmp_path / 'corridors.pgm'), map_period=0.5,
                  laser_pose='0.2, 0.1, 0.5, 3.1416')
    # The rays of a laser that hangs upside down go clockwise.
    ranges = np.array([ranges_from(pose)[-np.arange(RAYS) % RAYS]
                       for pose in compose(truth, laser[None])])
    r.follow(ranges + rng.normal(0, 0.01, ranges.shape), wheels)

    def is_whole():
        values = r.scan_status()[2]
        return len(truth) - 2 <= int(values['scans']) == len(r.odometry) and len(
            r.path().poses) == int(values['keyframes'])

    r.until(is_whole, 'the path has every keyframe')
    assert call(r, 'optimize').success
    rows = np.array([stamp_of(p.header) for p in r.path().poses]) // 10**8 - 10
    wrong = position_error(poses_of(r.path())[:, :2], truth[rows, :2])
    assert wrong < 0.1 < position_error(wheels[rows, :2], truth[rows, :2])
    assert len(r.received['loop_closures']) >= 10
    assert r.scan_status()[2]['parts'] == '1' and r.count('odometry.new_part') == 0
    for message in r.odometry:
        covariance = np.reshape(message.pose.covariance, (6, 6))[np.ix_([0, 1, 5], [0, 1, 5])]
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert (message.header.frame_id, message.child_frame_id) == ('scan_odom', 'base_link')
    r.until(lambda: r.received['map'], 'a grid')
    grid = r.received['map'][-1]
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    # The rooms, and a little of what is behind the walls.
    width, height = np.ptp(np.argwhere(cells.T >= 50), axis=0) * grid.info.resolution
    assert (width, height) == (pytest.approx(14, abs=0.6), pytest.approx(9, abs=0.6))
    saved = call(r, '/scan_loops/save_map')
    assert saved.success and 'corridors.pgm' in saved.message
    (tmp_path / 'corridors.yaml').write_text('mine')
    refused = call(r, '/scan_loops/save_map')
    assert not refused.success and 'yaml: was not written by l1slam_ros' in refused.message
    assert r.close(), 'its threads end'


def test_where_scans_show_nothing_known_a_part_begins_for_the_back_end_too(ros, capfd):
    r = ScanBench(ros, backend=True, laser_pose='0 0 0')
    truth = np.array([(1.6 + 0.2 * k, 1.6, 0.0) for k in range(40)])
    # The robot is carried into another room while its wheels go on.
    walls = [WALLS if k < 12 else ELSEWHERE for k in range(40)]
    r.follow([ranges_from(pose, walls=seen) for pose, seen in zip(truth, walls, strict=True)],
             truth, ahead=0)
    r.until(lambda: r.scan_status()[2]['parts'] == '2', 'a part of the scans')
    r.until(lambda: r.count('odometry.new_part') == 1, 'a part of the map')
    x = np.array([message.pose.pose.position.x for message in r.odometry])
    (jump,) = np.flatnonzero(np.diff(x) > 1)
    assert jump > 12 and np.diff(x)[jump] == pytest.approx(1000, abs=1)
    assert 'nothing known any more; a new part of the map begins' in capfd.readouterr().err
    assert r.close()
