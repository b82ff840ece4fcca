# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A robot with a laser that drives round a block in a room, and what it records."""

from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO

import numpy as np
from records import read
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from worlds import between, compose, wrapped

from l1slam_ros.cli.main import main

# Walls, from x y to x y [m]: the room, a block in it, and what tells one corner from another.
WALLS = np.array([
    (0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 0, 8), (0, 8, 0, 0),
    (3, 3, 9, 3), (9, 3, 9, 5), (9, 5, 3, 5), (3, 5, 3, 3),
    (5, 0, 5, 0.7), (5, 0.7, 5.5, 0), (12, 6, 11.2, 6), (11.2, 6, 12, 6.8),
    (0, 2.2, 0.6, 2.6), (0.6, 2.6, 0, 3), (7, 8, 7.4, 7.3), (7.4, 7.3, 8, 8)], float)
_CORNERS = np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5)])
_STEP = 0.15
_PERIOD = 0.2
_RAYS = 240


@dataclass(frozen=True)
class Scan:
    """One turn of a laser, as sensor_msgs/msg/LaserScan has it; stamp [ns]."""

    stamp: int
    ranges: np.ndarray
    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = np.inf
    time_increment: float = 0.0


def box(x, y, u, v):
    """Return the four walls of a box, from corner (x, y) to corner (u, v)."""
    return np.array([(x, y, u, y), (u, y, u, v), (u, v, x, v), (x, v, x, y)], float)


def mirrored(walls):
    """Return what walls look like in a mirror on the x axis."""
    return walls * (1, -1, 1, -1)


def ranges_at(pose, rng, walls=WALLS, noise=0.01, rays=_RAYS):
    """Return what a laser that looks all round measures at a pose, to a centimetre, (r,) [m]."""
    angles = pose[2] + 2 * np.pi * np.arange(rays) / rays
    return _cast(np.broadcast_to(pose[:2], (rays, 2)), angles, walls) + (
        noise * rng.standard_normal(rays))


def ranges_on_the_way(pose, velocity, period, rng, walls=WALLS, noise=0.01):
    """Return what it measures while it turns once from a pose on, at a steady velocity, (r,)."""
    seconds = period * np.arange(_RAYS) / _RAYS
    steps = seconds[:, None] * velocity
    poses = compose(pose, steps)
    angles = poses[:, 2] + 2 * np.pi * np.arange(_RAYS) / _RAYS
    return _cast(poses[:, :2], angles, walls) + noise * rng.standard_normal(_RAYS)


def _cast(starts, angles, walls):
    """Return the way from each start (r, 2) at each angle to the nearest wall, (r,) [m]."""
    u = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, None]
    a, d = walls[:, :2] - starts[:, None], walls[:, 2:] - walls[:, :2]
    cross = u[..., 0] * d[:, 1] - u[..., 1] * d[:, 0]
    with np.errstate(all='ignore'):
        t = (a[..., 0] * d[:, 1] - a[..., 1] * d[:, 0]) / cross
        s = (a[..., 0] * u[..., 1] - a[..., 1] * u[..., 0]) / cross
    return np.where((t > 0) & (s >= 0) & (s <= 1), t, np.inf).min(axis=1)


def scan_at(pose, rng, walls=WALLS, noise=0.01, farthest=30.0):
    """Return a scan of a laser that looks all round at a pose."""
    return Scan(0, ranges_at(pose, rng, walls, noise), 0.0, 2 * np.pi / _RAYS, 0.05, farthest)


def along(corners, step=_STEP):
    """Return poses on a way through corners (k, 2), that turns on the spot at each, (n, 3)."""
    poses, last = [], None
    for a, b in zip(corners[:-1], corners[1:], strict=True):
        d = np.subtract(b, a)
        heading = np.arctan2(d[1], d[0])
        if last is not None:
            turn = -wrapped(last - heading)
            count = int(np.ceil(abs(turn) / 0.3))
            poses += [(*a, last + turn * k / count) for k in range(1, count)]
        length = np.hypot(*d)
        poses += [(*(a + part * d / length), heading) for part in np.arange(0, length, step)]
        last = heading
    return np.array(poses)


def drifting(true, rng):
    """Return the wheels of a robot that was at poses (n, 3): they drift to the left."""
    steps = between(true[:-1], true[1:])
    steps[:, 2] += 0.02 * np.hypot(steps[:, 0], steps[:, 1]) + 0.002 * rng.standard_normal(
        len(steps))
    return driven(steps)


def driven(steps, start=(0.0, 0.0, 0.0)):
    """Return the poses (n + 1, 3) of wheels that make steps (n, 3)."""
    poses = [np.array(start)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def drive(true, seed=0, walls=WALLS, spoil=None, noise=0.01, period=_PERIOD):
    """
    Return scans and the wheels' poses of a robot that is at poses (n, 3).

    spoil : takes ranges, the number of the scan and the generator, returns other ranges
    period : from one scan to the next [s]
    """
    rng = np.random.default_rng(seed)
    wheels = drifting(true, rng)
    scans = []
    for k, pose in enumerate(true):
        ranges = ranges_at(pose, rng, walls, noise)
        scans.append(Scan(1000 * 10**9 + k * int(period * 1e9),
                          ranges if spoil is None else spoil(ranges, k, rng), 0.0,
                          2 * np.pi / _RAYS, 0.05, 30.0))
    return scans, wheels


def random_rays(ranges, _, rng, part=0.1):
    """Let so many rays end anywhere before the wall."""
    return np.where(rng.random(len(ranges)) < part, rng.random(len(ranges)) * ranges, ranges)


def glass(ranges, _, rng, part=0.2):
    """Let so many rays go on behind the wall, up to 6 m."""
    far = ranges + 6 * rng.random(len(ranges))
    return np.where(rng.random(len(ranges)) < part, far, ranges)


def laps(count=2, seed=0):
    """Return scans, the wheels' poses and the true ones (n, 3) of some laps round the block."""
    true = []
    for k in range(4 * count):
        a, b = _CORNERS[k % 4], _CORNERS[(k + 1) % 4]
        heading = k * np.pi / 2
        for part in np.arange(0, np.linalg.norm(b - a), _STEP):
            true.append((*(a + part * (b - a) / np.linalg.norm(b - a)), heading))
        true += [(*b, heading + turn) for turn in np.linspace(0, np.pi / 2, 6)[1:-1]]
    true = np.array(true)
    return *drive(true, seed), true


def write_log(path, scans, wheels):
    """Write what a laser that looks ahead has seen as a CARMEN log."""
    front = np.r_[-_RAYS // 4 : _RAYS // 4 + 1]
    lines = ['# CARMEN Logfile', 'PARAM robot_length 0.5 0 nohost 0']
    for scan, pose in zip(scans, wheels, strict=True):
        ranges = ' '.join(f'{r:.3f}' for r in scan.ranges[front])
        robot = ' '.join(f'{x:.6f}' for x in pose)
        lines.append(f'FLASER {len(front)} {ranges} {robot} {robot} {scan.stamp / 1e9:.6f} host '
                     f'{scan.stamp / 1e9 - 1000:.6f}')
    path.write_text('\n'.join(lines) + '\n')


def write_scan_bag(path, scans, wheels, mount=None):
    """
    Write scans, odometry twice as often and where the laser is, by an independent writer.

    The recorder's clock goes on, whatever the stamps of the scans do.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    time, head = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    point, vector = types['geometry_msgs/msg/Point'], types['geometry_msgs/msg/Vector3']
    quaternion = types['geometry_msgs/msg/Quaternion']

    def header(stamp, frame):
        return head(time(*divmod(stamp, 10**9)), frame)

    def odometry(stamp, pose):
        x, y, theta = pose.tolist()
        zero = vector(0.0, 0.0, 0.0)
        return types['nav_msgs/msg/Odometry'](
            header(stamp, 'odom'), 'base_link', types['geometry_msgs/msg/PoseWithCovariance'](
                types['geometry_msgs/msg/Pose'](point(x, y, 0.0), quaternion(
                    0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2))), np.zeros(36)),
            types['geometry_msgs/msg/TwistWithCovariance'](
                types['geometry_msgs/msg/Twist'](zero, zero), np.zeros(36)))

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        names = {'/wheels': 'nav_msgs/msg/Odometry', '/scan': 'sensor_msgs/msg/LaserScan',
                 '/tf_static': 'tf2_msgs/msg/TFMessage'}
        topics = {name: writer.add_connection(name, kind, typestore=store)
                  for name, kind in names.items()}

        def put(name, stamp, message):
            writer.write(topics[name], stamp, store.serialize_cdr(message, names[name]))

        if mount is not None:
            (x, y, z), q = mount
            put('/tf_static', scans[0].stamp, types['tf2_msgs/msg/TFMessage']([
                types['geometry_msgs/msg/TransformStamped'](
                    header(scans[0].stamp, 'base_link'), 'laser',
                    types['geometry_msgs/msg/Transform'](vector(x, y, z), quaternion(*q)))]))
        for k, (scan, pose) in enumerate(zip(scans, wheels, strict=True)):
            now = scans[0].stamp + k * int(_PERIOD * 1e9)
            put('/wheels', now, odometry(scan.stamp, pose))
            put('/scan', now, types['sensor_msgs/msg/LaserScan'](
                header(scan.stamp, 'laser'), scan.angle_min, 6.28, scan.angle_increment,
                scan.time_increment, 0.2, scan.range_min, scan.range_max,
                scan.ranges.astype(np.float32), np.zeros(0, np.float32)))
            if k + 1 < len(scans):
                halfway = compose(pose, 0.5 * between(pose, wheels[k + 1]))
                put('/wheels', now + 10**8, odometry(scan.stamp + 10**8, halfway))


def write_whole_log(path, scans, wheels):
    """Write all that a laser in the middle of the robot has seen as a CARMEN log."""
    lines = []
    for scan, pose in zip(scans, wheels.tolist(), strict=True):
        robot, ranges = ' '.join(map(repr, pose)), ' '.join(map(repr, scan.ranges.tolist()))
        lines.append(f'ROBOTLASER1 0 0 {2 * np.pi} {scan.angle_increment!r} 30 0.01 0 '
                     f'{len(scan.ranges)} {ranges} 0 {robot} {robot} 0 0 0 0 0 '
                     f'{scan.stamp / 1e9:.6f} host 0')
    path.write_text('\n'.join(lines) + '\n')


class FrontEndGraph:
    """
    The graph that the scan front end makes of a drive, which nobody has judged or solved.

    graph, poses : see `l1.read_graph`; rows : the number of the scan of each keyframe; said : the
    sentences on standard error; parts : of the drive, between which there is no odometry
    """

    def __init__(self, folder, scans, wheels):
        log, graph, said = folder / 'drive.log', folder / 'graph.g2o', StringIO()
        write_whole_log(log, scans, wheels)
        with redirect_stderr(said):
            assert main(['convert', str(log), str(graph)]) == 0
        found = read(graph)
        self.said = [line.removeprefix('l1slam: ') for line in said.getvalue().splitlines()]
        self.graph, self.poses = found.graph, found.poses
        self.rows = np.searchsorted([scan.stamp for scan in scans], found.stamps)
        self.odometry = found.graph.between.is_odometry
        self.loops = found.graph.between.pairs[~self.odometry]
        self.parts = self.graph.n_poses - int(self.odometry.sum())

    def way(self):
        """Return the poses by odometry, from the first one, (n, 3); there is one part."""
        assert self.parts == 1
        return driven(self.graph.between.measurement[self.odometry])

    def off(self, true):
        """Return how far the way is off where the robot was at true poses (n, 3), (k, 3)."""
        true = true[self.rows]
        return self.way() - between(true[:1], true)

    def errors(self, true):
        """Return the errors of all factors, (m, 3) in the axes of their ends."""
        factors, true = self.graph.between, true[self.rows]
        return between(factors.measurement, between(true[factors.i], true[factors.j]))

    def covariances(self):
        """Return the covariances that factors state, (m, 3, 3)."""
        root = self.graph.between.sqrt_information
        return np.linalg.inv(root.transpose(0, 2, 1) @ root)


def write_truth(path, scans, true):
    """Write the true poses as CSV."""
    path.write_text('stamp,x,y,theta\n' + ''.join(
        f'{scan.stamp / 1e9:.6f},{x},{y},{theta}\n'
        for scan, (x, y, theta) in zip(scans, true.tolist(), strict=True)))
