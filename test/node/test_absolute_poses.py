# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""GPS through the real node: the map comes to the world, and jumps of it are refused."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from node_bench import call, header, poses_of, put

NS = 10**9


def fix(stamp, variances, frame='map', position=(1.0, 0.0, 0.0), w=1.0):
    message = PoseWithCovarianceStamped(header=header(frame, stamp))
    put(message.pose.pose, position, (0, 0, 0, w))
    message.pose.covariance = np.diag(np.array(variances, float)).ravel()
    return message


def test_a_drive_seen_by_gps_is_in_the_world_and_goes_on(bench, tmp_path):
    """A position every three metres, two of them far off."""
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    start, ahead, false = np.array([100.0, -40.0]), np.array([np.cos(2.0), np.sin(2.0)]), [7, 16]
    b.drive(0, 31)
    for k in range(1, 31, 3):
        x, y = start + k * ahead + 50.0 * (k in false)
        b.send('/absolute_poses', fix((k + 1) * NS, (0.04, 0.04, *4 * [0.0]), 'map', (x, y, 0.0)))

    def refused():
        ends = {end for (_, end), (state, _) in b.loops().items() if state != 'accepted'}
        return sorted(end // NS - 1 for end in ends)

    def is_there(last):
        """Tell whether the path of so many keyframes is in the world."""
        expected = start + np.arange(last)[:, None] * ahead
        found = poses_of(b.path())[:, :2]
        return len(found) == last and np.abs(found - expected).max() < 0.6

    b.until(lambda: len(b.loops()) == 10 and refused() == false, 'the false ones are refused')
    assert call(b, 'optimize').success and refused() == false
    b.until(lambda: is_there(31), 'the Path is in the world')
    assert call(b, 'save').success and call(b, 'reset').success
    b.map_of(0)
    b.received['loop_status'].clear()
    assert call(b, 'load').success
    b.until(lambda: is_there(31), 'it is there again')
    b.until(lambda: len(b.loops()) == 10 and refused() == false, 'they are judged anew')
    b.drive(31, 41)
    x, y = start + 40 * ahead
    b.send('/absolute_poses', fix(41 * NS, (0.04, 0.04, *4 * [0.0]), 'map', (x, y, 0.0)))
    b.until(lambda: len(b.loops()) == 11 and refused() == false, 'the new one is believed')
    b.until(lambda: is_there(41), 'it goes on')


def test_without_a_heading_no_quaternion_is_needed_and_what_says_nothing_is_counted(bench):
    b = bench(**{'robust.enabled': False})
    b.drive(0, 4)
    for k, unsaid in enumerate((0.0, -1.0, np.inf, 1.1e6)):
        b.send('/absolute_poses', fix((k + 1) * NS, (1, 1, 1, *3 * [unsaid]), w=0.0,
                                      position=(float(k), 0, 0)))
    for message in (fix(NS, (1, 1, 1, 0, 0, 1), w=0.0), fix(NS, np.ones(6), 'a@1.000000000'),
                    fix(NS, np.ones(6), ''), fix(NS, np.zeros(6)),
                    fix(NS, np.ones(6), position=(np.nan, 0, 0)),
                    fix(NS, np.ones(6), position=(1e10, 0, 0))):
        b.send('/absolute_poses', message)
    expected = {'quaternion': 1, 'frame': 2, 'covariance': 1, 'not_finite': 1, 'range': 1}
    b.until(lambda: b.refused() == expected, 'what cannot be used is refused')
    b.until(lambda: b.states() == {'accepted': 4}, 'the others are used')
