# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Strays of every kind to the real node: counted, told once, and not in the map."""

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from node_bench import loop, odometry, warnings

NS = 10**9
NO_DOUBT = {'robust.enabled': False}


def test_bad_messages_are_counted_and_the_node_goes_on(bench, capfd):
    b = bench()
    b.send('/odom', odometry(10**9, 0.0))
    b.send('/odom', odometry(10**9 - 5, 9.0))
    for data in b'', b'\0\1\0\0' + 60 * b'\xff':  # no messages at all
        b.send('/odom', data)
    b.send('/odom', odometry(2 * 10**9, float('nan')))
    b.send('/odom', odometry(2 * 10**9, 0.0, frame='camera'))
    b.send('/loop_closures', loop(2 * 10**9, frame='map'))
    b.send('/loop_closures', loop(2 * 10**9, 2e9))
    b.send('/loop_closures', b'\0\1\0\0' + 60 * b'\xff')
    b.send('/odom', odometry(3 * 10**9, 1.0))
    b.map_of(2)
    expected = {'old_stamp': 1, 'encoding': 2, 'not_finite': 1, 'child_frame': 1, 'frame': 1,
                'range': 1}
    b.until(lambda: b.refused() == expected, 'the bad ones are counted')
    level, sentence, values = b.status()
    assert level == DiagnosticStatus.WARN and '1 not_finite' in sentence
    assert values['refused.encoding.last_minute'] == '2'
    assert (values['odom.received'], values['loop_closures.received']) == ('7', '2')
    told = ''

    def is_told(part):
        nonlocal told
        told += capfd.readouterr().err
        return part in told

    b.until(lambda: is_told('odometry stamp 999999995 ns came 5e-09 s late'), 'it is told')
    assert told.count('expected CDR') <= 1


@pytest.mark.parametrize('given, of_odometry, of_loops', [
    ('', '/base_link', 'base_link'), ('', 'base_link', '/base_link'),
    ('/base_link', 'base_link', 'base_link')])
def test_a_slash_before_a_frame_says_nothing(bench, given, of_odometry, of_loops):
    """To tf2, too: it was the habit of ROS 1."""
    b = bench(base_frame=given, map_frame='/map', **NO_DOUBT)
    for k in range(1, 6):
        b.send('/odom', odometry(k * NS, float(k), of_odometry))
    b.send('/loop_closures', loop(5 * NS, 3.5, f'{of_loops}@1.000000000'))
    b.send('/absolute_poses', loop(2 * NS, 2.0, 'map', 1.0))
    b.until(lambda: b.count('accepted_loops') == 2, 'both are used')
    assert b.map_of(5).header.frame_id == 'map' and not b.refused()


def test_odometry_in_a_frame_that_is_not_odom_frame_is_told_of(bench, capfd):
    """The tree of tf2 would not hang together, without a word."""
    b = bench(map_frame='m', odom_frame='r/odom', **NO_DOUBT)
    for k, frame in enumerate(('r/odom', '/r/odom', '', 'odom', 'odom'), 1):
        message = odometry(k * NS, float(k))
        message.header.frame_id = frame
        b.send('/odom', message)
    b.map_of(5)
    told = warnings(capfd)
    assert len(told) == 1 and "has the frame 'odom', but m -> r/odom is published" in told[0]


def test_the_last_stamp_that_there_is_has_a_transform_too(bench):
    b = bench(**NO_DOUBT)
    b.send('/odom', odometry(2**31 * NS - 1, 0.0))
    b.until(lambda: b.received['map_to_odom'], 'a transform that is no later')


def test_two_publishers_of_odometry_are_told_of(bench, capfd):
    """Of a filter and a driver on one topic, say; from the first message on nothing breaks off."""
    b = bench()
    other = b.peer.create_publisher(Odometry, '/odom', 100)
    b.until(lambda: b.peer.count_publishers('/odom') == 2 and other.get_subscription_count(),
            'both are heard')
    for k in range(6):
        b.drive(2 * k, 2 * k + 1)
        other.publish(odometry((2 * k + 2) * 10**9, 5.0))
        b.until(lambda n=2 * k + 2: b.newest() == n * 10**9, 'it is used')
    b.anew()
    assert (b.count('odom.received'), b.count('odom.lost')) == (12, 0)
    told = warnings(capfd)
    assert len(told) == 1 and told[0].endswith(
        'messages of several publishers come by turns on odom, and the map takes them for one '
        'motion; expected one publisher')
