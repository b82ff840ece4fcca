# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What robots send a central node, and get from it: messages and bytes a second.

    python benchmarks/fleet/messages.py [--robots 100] [--odometry 10] [--keyframes 10000]

Sizes are those of serialised messages; what the middleware and the network add is not in them. A
robot drives half a metre a second, so that it makes a keyframe a second, and finds a loop with
every second one.
"""

import argparse

import numpy as np

from l1slam_ros.io.messages.serialisation import (
    odometry_bytes,
    path_bytes,
    pose_bytes,
    transform_bytes,
)

_LOOPS = 0.5  # [1/s] of a robot
_TRANSFORMS = 20.0  # [1/s] `transform_period`
_UPDATES = 5.0  # [1/s] `update.period`, while something comes


def main() -> None:
    """Print a row for each message, and the sums."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--robots', type=int, default=100)
    parser.add_argument('--odometry', type=float, default=10.0, help='[1/s]')
    parser.add_argument('--keyframes', type=int, default=10_000, help='of one robot')
    arguments = parser.parse_args()
    now = 10**18
    pose = np.eye(7)[6]
    covariance = np.eye(6)
    stamps = np.full(arguments.keyframes, now)
    to_node = (
        ('odom', arguments.odometry, odometry_bytes('r1/odom', 'r1/base_link', now, pose,
                                                    covariance)),
        ('loop_closures', _LOOPS, pose_bytes('r2/base_link@1700000000.000000042', now, pose,
                                             covariance)))
    from_node = (
        ('pose', arguments.odometry, pose_bytes('map', now, pose)),
        ('map_to_odom', _TRANSFORMS, transform_bytes('map', 'r1/odom', now, pose)),
        ('path', _UPDATES, path_bytes('map', now, stamps, np.tile(pose, (len(stamps), 1)))))
    for name, rows in (('to the node', to_node), ('from the node', from_node)):
        rates, sizes = (np.array(column, float) for column in zip(
            *((rate, len(content)) for _, rate, content in rows), strict=True))
        print(f'{name}:')
        for (topic, rate, content) in rows:
            print(f'  {topic:14} {len(content):9,} bytes, {rate:4g} a second')
        print(f'  one robot: {rates.sum():.1f} messages, {rates @ sizes / 1e3:,.1f} kB a second')
        print(f'  {arguments.robots} robots: {arguments.robots * rates.sum():,.0f} messages, '
              f'{arguments.robots * (rates @ sizes) / 1e6:,.1f} MB a second')


if __name__ == '__main__':
    main()
