# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Which scans are used, with which wheels, and where their grid is drawn."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from corridors import ranges_from
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from node_bench import LATCHED, ScanBench, call, header, put, stamp_of

S = 10**9
NOTHING = np.full(90, np.inf)  # seen: the wheels alone say how the robot moved


@pytest.fixture
def robot(ros):
    """Return what makes the front end with its peer; all are closed after the test."""
    robots = []

    def make(**parameters):
        robots.append(ScanBench(ros, **parameters))
        return robots[-1]

    yield make
    for made in robots:
        assert made.close(), 'its threads end'


def used(r):
    """Return the stamps of the scans that were used [ns]."""
    return [stamp_of(message.header) for message in r.odometry]


def wheels_are_used(r, count):
    r.until(lambda: r.scan_status()[2]['odom.received'] == str(count), 'the wheels are used')


def test_who_is_behind_gets_every_other_scan_and_the_wheels_of_its_stamp(robot):
    r = robot(backlog=3, laser_pose='[0.1 0.2 -1]')
    r.wheels_at(S, (1.0, 0.0, 0.0))
    wheels_are_used(r, 1)
    for k in range(1, 8):
        r.scan_at(S + k * S // 10, NOTHING)
    r.until(lambda: r.scan_status()[2]['waiting'] == '7', 'they wait for wheels')
    r.wheels_at(2 * S, (2.0, 0.0, 0.0))
    r.until(lambda: len(used(r)) == 4, 'the newest is among those that are used')
    assert used(r) == [S + k * S // 10 for k in (1, 3, 5, 7)]
    np.testing.assert_allclose([one.pose.pose.position.x for one in r.odometry],
                               [0.0, 0.2, 0.4, 0.6], atol=1e-6)
    r.until(lambda: r.refused('scans') == {'left_out': 3}, 'the others are told of')
    assert '3 left out, for want of time' in r.scan_status()[1]
    # As many as may wait are used in turn.
    for k in range(1, 4):
        r.scan_at(2 * S + k * S // 10, NOTHING)
    r.until(lambda: r.scan_status()[2]['waiting'] == '3', 'they wait for wheels')
    r.wheels_at(3 * S, (3.0, 0.0, 0.0))
    r.until(lambda: used(r)[4:] == [2 * S + k * S // 10 for k in (1, 2, 3)], 'all are used')
    r.anew()
    assert r.refused('scans') == {'left_out': 3}


def test_a_scan_that_no_odometry_surrounds_expires_and_bad_ones_are_counted(robot, capfd):
    r = robot(laser_pose='0.1, 0.2, -1')
    r.scan_at(8 * S, NOTHING[:1])
    for changes in ({'angle_increment': 0.0}, {'angle_increment': 2.0},
                    {'angle_min': float('nan')}):
        r.scan_at(8 * S, NOTHING, **changes)
    r.until(lambda: r.refused('scans') == {'scan': 4}, 'they are refused')
    r.wheels_at(10 * S, (0.0, 0.0, 0.0))
    wheels_are_used(r, 1)
    r.scan_at(9 * S, NOTHING)  # before all odometry: nothing older will come
    r.until(lambda: r.refused('scans').get('expired') == 1, 'it expires')
    r.scan_at(9 * S, NOTHING)
    r.until(lambda: r.refused('scans').get('old_stamp') == 1, 'the same again')
    r.scan_at(11 * S, NOTHING)
    r.scan_at(13 * S + 1, NOTHING)  # more than two seconds later
    r.until(lambda: r.refused('scans').get('expired') == 2, 'the first has waited too long')
    r.wheels_at(14 * S, (1.0, 0.0, 0.0))  # but four seconds without odometry are no motion known
    r.until(lambda: r.refused('scans').get('expired') == 3, 'the other has')
    r.scan_at(14 * S, NOTHING)
    r.until(lambda: used(r) == [14 * S], 'one at a stamp of the odometry is used')
    # Two stamps say that time went back.
    r.wheels_at(3 * S, (0.0, 0.0, 0.0))
    r.wheels_at(4 * S, (0.5, 0.0, 0.0))
    wheels_are_used(r, 4)
    r.scan_at(4 * S, NOTHING)
    r.until(lambda: used(r) == [14 * S, 4 * S], 'a scan of the new time is used')
    r.anew()
    assert r.scan_status()[2]['keyframes'] == '1'
    said = capfd.readouterr().err
    assert 'the stamps of odom went back: scans and map begin anew' in said
    assert ("the laser 'laser' is at x 0.1 m, y 0.2 m, yaw -1 rad of 'base_link', as laser_pose "
            'says') in said
    r.wheels_at(16 * S, (0.0, 0.0, float('nan')))
    r.until(lambda: r.refused('scans').get('not_finite') == 1, 'no pose')


@pytest.mark.parametrize('frame', ['map', 'robot/map'])
def test_the_grid_is_drawn_where_the_path_has_the_keyframes(robot, frame):
    """Odometry leads on from its last keyframe; a pose may have another frame than the path."""
    r = robot(laser_pose='0 0 0', map_resolution=0.1)
    truth = np.array([(1.6 + 0.2 * k, 1.6, 0.0) for k in range(16)])
    r.follow([ranges_from(pose, 180) for pose in truth], truth, ahead=0)
    paths = r.peer.create_publisher(Path, 'path', LATCHED)
    path = Path(header=header(frame, 3 * S))
    for k in (0, 8):  # turned by a quarter, and elsewhere
        pose = PoseStamped(header=header('' if k and '/' in frame else frame, (k + 10) * S // 10))
        put(pose.pose, (100.0, 50.0 + truth[k, 0], 0.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
        path.poses.append(pose)
    paths.publish(path)
    r.until(lambda: r.received['map'], 'a grid')
    grid = r.received['map'][-1]
    assert grid.header.frame_id == frame and stamp_of(grid.header) <= 18 * S // 10
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    walls = np.argwhere(cells >= 50)[:, ::-1] * grid.info.resolution + (
        grid.info.origin.position.x, grid.info.origin.position.y)
    # The wall y = 0 of the rooms is 1.6 m to the right of the way: at x = 101.6.
    r.anew()
    assert int(r.scan_status()[2]['keyframes']) > 4
    assert walls[:, 0].max() == pytest.approx(101.6, abs=0.2)
    assert not call(r, '/scan_loops/save_map').success, 'no map_path'
