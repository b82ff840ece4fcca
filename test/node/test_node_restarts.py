# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The odometry's driver restarts while the real node listens: another publisher, another frame."""

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from node_bench import odometry, warnings
from rclpy.qos import QoSProfile


def restart_driver(b):
    """Let another publisher speak on odom from now on."""
    b.peer.destroy_publisher(b.publishers['/odom'])
    b.publishers['/odom'] = b.peer.create_publisher(Odometry, '/odom', QoSProfile(depth=1000))
    b.until(lambda: b.publishers['/odom'].get_subscription_count()
            and b.peer.count_publishers('/odom') == 1, 'the node hears of it')


@pytest.mark.parametrize('restarts', [True, False])
def test_another_publisher_makes_a_small_jump_a_restart(bench, capfd, restarts):
    """Without it, the odometry may as well have been corrected."""
    b = bench()
    for k in range(60):
        if k == 30 and restarts:
            restart_driver(b)
        stamp = 10 * 10**9 + k * 50_000_000
        b.send('/odom', odometry(stamp, 5 + 0.05 * k + 0.4 * (k >= 30)))
    b.until(lambda: b.newest() == 12_950_000_000, 'all is used')
    b.anew()
    assert b.count('keyframes') - 1 - b.count('factors') == restarts
    assert b.count('odometry.new_part') == restarts and not b.refused()
    assert (b.count('odom.received'), b.count('odom.lost')) == (60, 0)
    told = warnings(capfd)
    if restarts:
        b.until(lambda: told.extend(warnings(capfd)) or told, 'it is told of')
        assert len(told) == 1 and 'a new part of the map begins' in told[0]
        assert 'at stamp 11500000000 ns' in told[0]
        level, sentence, _ = b.status()
        assert level == DiagnosticStatus.WARN and 'last minute: 1 new_part' in sentence
    else:
        assert not told
