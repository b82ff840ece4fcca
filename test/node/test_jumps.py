# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where a clock, a driver or its own map jumps, and how far ahead transforms are stamped."""

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from node_bench import loop, odometry, poses_of, stamp_of, warnings
from rosgraph_msgs.msg import Clock

import l1slam_ros as l1


@pytest.mark.parametrize('choice', ['new_segment', 'reset', 'ignore'])
def test_when_the_clock_jumps_back(bench, tmp_path, choice):
    b = bench(use_sim_time=True, on_time_jump=choice, save_path=str(tmp_path / 'map.g2o'))
    publisher = b.peer.create_publisher(Clock, '/clock', 10)
    b.until(publisher.get_subscription_count, 'the node looks at the clock')

    def tell(seconds):
        message = Clock()
        message.clock.sec = seconds
        publisher.publish(message)
        b.until(lambda: b.received['/diagnostics'] and b.received['/diagnostics'][
            -1].header.stamp.sec == seconds, f'it is {seconds}')

    tell(100)
    b.drive(0, 3)
    b.map_of(3)  # though the clock stands still
    tell(101)
    tell(50)
    for _ in range(2 if choice == 'new_segment' else 0):
        b.received['map_to_odom'].clear()
        count = len(b.received['/diagnostics'])
        b.until(lambda n=count: len(b.received['/diagnostics']) > n, 'a second has passed')
        # A transform of the time before would make tf2 ignore what comes.
        quiet = not b.received['map_to_odom']
    assert choice != 'new_segment' or quiet
    if choice == 'reset':
        b.map_of(0)
        b.until((tmp_path / 'map.g2o').exists, 'what was is saved')
        assert l1.read_graph(tmp_path / 'map.g2o')[0].n_poses == 3
        b.drive(0, 2)
    else:
        b.drive(*((3, 5) if choice == 'ignore' else (0, 2)))
    # A part that begins where the last one ends begins with a keyframe there.
    expected, end = {'new_segment': (5, 3.0), 'reset': (2, 1.0), 'ignore': (5, 4.0)}[choice]
    assert poses_of(b.map_of(expected))[-1, 0] == pytest.approx(end)


def test_the_jump_of_the_transform_is_said(bench):
    """A trusted loop says that the robot came but 4 m in what odometry says were 5.

    The front takes the most of that step at once, the map behind it the rest.
    """
    b = bench()
    b.drive(0, 6)
    b.map_of(6)
    b.send('/trusted_loop_closures', loop(6 * 10**9, 4.0, variance=1e-8))
    b.until(lambda: 0.01 < float(b.status()[2].get('jump.translation', 0)) < 1.01, 'a jump')
    b.until(lambda: b.path().poses[-1].pose.position.x == pytest.approx(4.0, abs=0.01),
            'a metre in all')


@pytest.mark.parametrize('restarts', [True, False])
def test_another_publisher_makes_a_small_jump_a_restart(bench, capfd, restarts):
    """Without it, the odometry may as well have been corrected."""
    b = bench()
    for k in range(60):
        if k == 30 and restarts:
            b.peer.destroy_publisher(b.publishers['/odom'])
            b.publishers['/odom'] = b.peer.create_publisher(Odometry, '/odom', 1000)
            b.until(lambda: b.publishers['/odom'].get_subscription_count()
                    and b.peer.count_publishers('/odom') == 1, 'the node hears of it')
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


def test_transforms_reach_to_the_odometry_that_comes_next(bench):
    """That of a bag played fast, or that comes seldom: by more than the tolerance."""
    b = bench(transform_period=3600.0)
    for k in range(5):
        b.drive(k, k + 1)
        b.until(lambda k=k: len(b.received['map_to_odom']) == k + 2, 'a transform with a message')
    # tf2 looks up between two: at first, before it is known how seldom, one at the stamp itself.
    assert [stamp_of(message.header) for message in b.received['map_to_odom']] == [
        10**9, 13 * 10**8, 23 * 10**8, 45 * 10**8, 55 * 10**8, 65 * 10**8]
    # The longest pause but one counts, and two seconds at most; a time that goes back begins anew.
    for stamp, end in (8, 0), (14, 15.5), (17, 0), (27, 29), (2, 0), (3, 3.3):
        b.send('/odom', odometry(stamp * 10**9, 5.0))
        b.until(lambda end=end: not end or stamp_of(b.received['map_to_odom'][-1].header) == round(
            end * 10**9), f'a transform up to {end} s')
