# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How far ahead of the odometry transforms are stamped: a look-up at its stamp finds one."""

import pytest

pytest.importorskip('rclpy')

from node_bench import odometry, stamp_of


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
