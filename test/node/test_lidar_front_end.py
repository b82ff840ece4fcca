# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The example front end in space knows streets again on a second lap, and the map has both."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from headers import without_header

pytest.importorskip('rclpy')
pytest.importorskip('kiss_icp')
pytest.importorskip('map_closures')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import call, header
from sensor_msgs.msg import PointCloud2, PointField
from worlds import between

EXAMPLE = Path(__file__).parents[2] / 'config' / 'lidar_front_end.py'
BLOCK, STREET = np.array((70.0, 50.0)), 14.0  # [m] from block to block, and between houses
RAYS = 300
SLOPES = np.tan(np.radians(np.linspace(-20, 12, 32)))
RANGE = 60.0
HEIGHT = 1.8
CORNER = 6.0  # [m] radius
LAPS, SEEN_AGAIN = 295, 230  # clouds, and from which on the map has seen the street before


def streets():
    """Return boxes (n, 5), their corners and heights, and poles and trees (m, 4) [m]."""
    rng = np.random.default_rng(1)
    boxes, poles = [], []
    for i, j in np.argwhere(np.ones((3, 3))) - 1:
        low = np.array((i, j)) * BLOCK
        high = low + BLOCK - STREET
        for side in range(4):
            axis, begin = side % 2, 0.0
            while begin < (high - low)[axis] - 3:
                width = min(rng.uniform(6, 18), (high - low)[axis] - begin)
                if rng.uniform() < 0.8:
                    house = np.array((low, high))
                    house[:, axis] = low[axis] + begin + np.array((0, width - rng.uniform(0, 2)))
                    ends = np.array((0, rng.uniform(5, 14))) + rng.uniform(0, 3)
                    house[:, 1 - axis] = low[1 - axis] + ends if side < 2 else (
                        high[1 - axis] - ends[::-1])
                    boxes.append((*house.ravel(), rng.uniform(4, 18)))
                begin += width + rng.choice([0, 3])
        for _ in range(15):
            place = rng.uniform(low, high)
            axis = rng.integers(2)
            place[axis] = (low[axis] - 2, high[axis] + 2)[rng.integers(2)]
            half = np.array((2.2, 0.9)) if axis else np.array((0.9, 2.2))
            if rng.uniform() < 0.3:  # a car
                boxes.append((*(place - half), *(place + half), 1.5))
            else:
                poles.append((*place, rng.choice([0.15, 0.8]), rng.uniform(3, 8)))
    return np.array(boxes), np.array(poles)


def around_the_block(count):
    """Return poses (n, 3) through the streets around a block, after the first lap 1 m aside."""
    x, y = BLOCK - STREET / 2
    low = -STREET / 2
    corners = np.array(((x, low), (x, y), (low, y), (low, low)))
    lap = []
    for k, end in enumerate(corners):
        side = end - corners[k - 1]
        heading = np.arctan2(side[1], side[0])
        ahead = side / np.linalg.norm(side)
        left = np.array((-ahead[1], ahead[0]))
        lap += [(*(corners[k - 1] + far * ahead), heading)
                for far in np.arange(CORNER, np.linalg.norm(side) - CORNER, 1.5)]
        lap += [(*(end + CORNER * ((np.sin(turn) - 1) * ahead + (1 - np.cos(turn)) * left)),
                 heading + turn) for turn in np.arange(0, np.pi / 2, 0.12)]
    poses = np.array(lap)[np.arange(count) % len(lap)]
    aside = np.clip((np.arange(count) - len(lap)) / 10, 0, 1)
    poses[:, 0] += aside * np.sin(poses[:, 2])
    poses[:, 1] -= aside * np.cos(poses[:, 2])
    return poses


def cloud_from(pose, boxes, poles, rng):
    """Return the points (n, 3) of a lidar that sees houses, poles and the ground."""
    angle = 2 * np.pi / RAYS * np.arange(RAYS)
    c, s = np.cos(angle + pose[2])[:, None], np.sin(angle + pose[2])[:, None]
    with np.errstate(divide='ignore'):
        x = np.sort(np.stack([(boxes[:, k] - pose[0]) / c for k in (0, 2)]), axis=0)
        y = np.sort(np.stack([(boxes[:, k] - pose[1]) / s for k in (1, 3)]), axis=0)
    enter = np.maximum(x[0], y[0])
    off = (poles[:, :2] - pose[:2]).T
    ahead, aside = off[0] * c + off[1] * s, off[0] * s - off[1] * c
    chord = poles[:, 2] ** 2 - aside**2
    hits = np.concatenate((
        np.where((enter < np.minimum(x[1], y[1])) & (enter > 0), enter, np.inf),
        np.where((chord > 0) & (ahead > 0), ahead - np.sqrt(np.maximum(chord, 0)), np.inf)),
        axis=1)
    tops = np.concatenate((boxes[:, 4], poles[:, 3]))
    ranges = np.where(SLOPES < 0, -HEIGHT / SLOPES, np.inf) + np.zeros((RAYS, 1))
    for nearest in np.argsort(hits, axis=1)[:, :8].T:  # the first few things in each direction
        hit = hits[np.arange(RAYS), nearest][:, None]
        z = HEIGHT + SLOPES * np.minimum(hit, 2 * RANGE)
        ranges = np.where((z > 0) & (z < tops[nearest][:, None]), np.minimum(ranges, hit), ranges)
    seen = ranges < RANGE
    ranges = np.where(seen, ranges, 0) + rng.normal(0, 0.02, ranges.shape)
    return np.stack((ranges * np.cos(angle)[:, None], ranges * np.sin(angle)[:, None],
                     ranges * SLOPES), axis=2)[seen]


def laps_apart(places, keyframes):
    """Return by how much the second lap is not as far from the first as it was, at most [m]."""
    first = around_the_block(LAPS)[:, :2]
    far = []
    for j in range(SEEN_AGAIN, LAPS):
        i = int(np.argmin(np.linalg.norm(first[: j - 100] - first[j], axis=1)))
        if i in keyframes and j in keyframes:
            a, b = (np.array((places[k].x, places[k].y, places[k].z)) for k in (i, j))
            far.append(abs(np.linalg.norm(a - b) - np.linalg.norm(first[i] - first[j])))
    return max(far)


def test_the_example_in_space_closes_loops(bench):
    """A lap and more than half of one: streets of the first are known again in the second."""
    example = runpy.run_path(str(EXAMPLE))
    assert len(without_header(EXAMPLE).splitlines()) < 100
    b, front_end = bench(dimension=3), example['LidarFrontEnd']()
    b.executor.add_node(front_end)
    clouds = b.peer.create_publisher(PointCloud2, 'points', 10)
    loops, odometry = [], []
    b.peer.create_subscription(PoseWithCovarianceStamped, 'loop_closures', loops.append, 10)
    b.peer.create_subscription(Odometry, 'odom', odometry.append, 10)
    b.until(lambda: clouds.get_subscription_count() and all(
        publisher.get_subscription_count() > 1
        for publisher in (front_end.loops, front_end.odometry)), 'all are connected')
    fields = [PointField(name=name, offset=4 * k, datatype=7, count=1)
              for k, name in enumerate('xyz')]
    truth = around_the_block(LAPS)
    boxes, poles = streets()
    rng = np.random.default_rng(0)
    for k, pose in enumerate(truth):
        xyz = cloud_from(pose, boxes, poles, rng).astype(np.float32)
        clouds.publish(PointCloud2(
            header=header('base_link', (k + 1) * 10**9), height=1, width=len(xyz), fields=fields,
            point_step=12, row_step=12 * len(xyz), data=xyz.tobytes(), is_dense=True))
        b.until(lambda k=k: len(odometry) > k, 'a cloud is used')
    truth = between(truth[0], truth)
    b.until(lambda: [one.header.stamp.sec for one in b.path().poses[-1:]] == [len(truth)],
            'all is in the map')
    assert len(loops) >= 2
    for loop in loops:
        earlier = int(loop.header.frame_id.removeprefix('base_link@').split('.')[0])
        i, j = earlier - 1, loop.header.stamp.sec - 1
        assert j > i + 150  # from lap to lap
        p, q = loop.pose.pose.position, loop.pose.pose.orientation
        seen = np.array((p.x, p.y, 2 * np.arctan2(q.z, q.w)))
        assert abs(seen - between(truth[i], truth[j])).max() < 0.2
        assert abs(p.z) < 0.2
    assert call(b, 'optimize').success
    b.anew()
    assert b.states() == {'accepted': b.count('accepted_loops')}
    assert b.count('factors') == b.count('keyframes') - 1 + b.count('accepted_loops')
    in_map = {one.header.stamp.sec - 1: one.pose.position for one in b.path().poses}
    by_odometry = {k: one.pose.pose.position for k, one in enumerate(odometry)}
    off, before = (laps_apart(places, in_map) for places in (in_map, by_odometry))
    assert off < 0.15
    assert off < before / 2
    b.executor.remove_node(front_end)
    front_end.destroy_node()
