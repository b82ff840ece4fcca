# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `scan_loops` is made of, each alone: the queue, the odometry it states, mounts, options."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import serialize_message

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.scans.odometry import ScanKeyframes, Step
from l1slam_ros.core.scans.points import Mount, Scan
from l1slam_ros.core.scans.submaps import Keyframe
from l1slam_ros.ros.scans.messages import path_in, scan_in, whole
from l1slam_ros.ros.scans.mounting import StaticTransforms
from l1slam_ros.ros.scans.options import ScanLoopsOptions
from l1slam_ros.ros.scans.placing import Placing
from l1slam_ros.ros.scans.scan_odometry import IncrementalOdometry
from l1slam_ros.ros.scans.scan_queue import ScanQueue
from l1slam_ros.ros.shell.header import header

SHIPPED = Path(__file__).parents[2] / 'config' / 'scan_loops.yaml'
S = 10**9


def scan(stamp):
    return Scan(stamp, np.ones(4), 0.0, 1.0)


def at(x, yaw=0.0):
    return np.array([x, 0.0, yaw])


def test_a_scan_gets_the_wheels_of_its_stamp():
    queue = ScanQueue(lambda: 3)
    queue.add_wheels(1 * S, at(1.0))
    queue.add_scan(scan(1 * S + S // 4))
    assert queue.take(2.0) is None and queue.waiting == 1
    queue.add_wheels(2 * S, at(2.0))
    taken, wheels = queue.take(2.0)
    assert taken.stamp == 1 * S + S // 4
    np.testing.assert_allclose(wheels, at(1.25))
    assert not queue.counts and queue.take(2.0) is None


def test_a_scan_gets_the_velocity_of_the_wheels_while_it_lasted():
    """As far as they came: it does not wait for its end."""
    turning = Scan(1 * S, np.ones(5), 0.0, 1.0, time_increment=0.05)
    for stamps, expected in (((0.9, 1.0, 1.1, 1.2, 1.3), 2.0), ((0.9, 1.1), 1.0)):
        queue = ScanQueue(lambda: 3)
        for stamp in stamps:
            queue.add_wheels(round(stamp * S), at(0.0, max(stamp - 1.0, 0.0) * 2))
        queue.add_scan(turning)
        np.testing.assert_allclose(queue.take(2.0)[0].velocity, (0.0, 0.0, expected), atol=1e-6)


def test_a_scan_that_no_odometry_surrounds_expires_and_is_counted():
    queue = ScanQueue(lambda: 3)
    queue.add_wheels(10 * S, at(0.0))
    queue.add_scan(scan(9 * S))  # before all odometry: nothing older will come
    assert queue.take(2.0) is None and queue.counts['expired'] == 1
    queue.add_scan(scan(11 * S))
    queue.add_scan(scan(13 * S))
    assert queue.take(2.0) is None and queue.waiting == 2
    queue.add_scan(scan(13 * S + 1))  # more than two seconds later
    assert queue.take(2.0) is None and queue.counts['expired'] == 2
    queue.add_wheels(14 * S, at(1.0))  # but four seconds without odometry are no motion known
    assert queue.take(2.0) is None and queue.counts['expired'] == 4


def test_who_is_behind_gets_every_other_scan_the_newest_among_them():
    queue = ScanQueue(lambda: 3)
    for k in range(1, 8):
        queue.add_wheels(k * S, at(k))
        queue.add_scan(scan(k * S))
    assert [queue.take(2.0)[0].stamp // S for _ in range(4)] == [1, 3, 5, 7]
    assert queue.counts == {'left_out': 3}


def test_three_scans_may_wait_and_are_used_in_turn():
    queue = ScanQueue(lambda: 3)
    for k in range(1, 4):
        queue.add_wheels(k * S, at(k))
        queue.add_scan(scan(k * S))
    assert [queue.take(2.0)[0].stamp // S for _ in range(3)] == [1, 2, 3]
    assert not queue.counts


def test_time_goes_back_when_two_stamps_say_so():
    queue = ScanQueue(lambda: 3)
    for stamp in (10, 11, 5, 12):  # one stray stamp
        queue.add_wheels(stamp * S, at(stamp))
    assert queue.restarts == 0 and queue.counts == {'old_stamp': 1}
    queue.add_wheels(3 * S, at(3))
    queue.add_wheels(4 * S, at(4))
    queue.add_scan(scan(4 * S))
    assert queue.restarts == 1
    assert queue.take(2.0)[0].stamp == 4 * S


def steps(rng, count=40):
    """Yield stamps and what a front end says of a robot that goes along, a metre in ten scans."""
    options = ScanKeyframes()
    keyframe = np.zeros(3)
    pose = np.zeros(3)
    for k in range(count):
        pose = se2.compose(pose[None], np.array([[0.1, 0.0, 0.02]]))[0] if k else pose
        moved = se2.between(keyframe[None], pose[None])[0]
        is_keyframe = not k or np.hypot(*moved[:2]) >= options.translation
        root = rng.normal(0, 0.02, (3, 3)) * (1, 1, 0.3)
        covariance = root @ root.T + 1e-5 * np.eye(3)
        made = Keyframe(k, pose, None, 0, 0.0) if is_keyframe else None
        yield (k + 1) * S // 10, Step(pose, made, covariance)
        keyframe = pose if is_keyframe else keyframe


def test_the_back_end_has_the_keyframes_of_the_scans_and_what_they_know(rng):
    shipped = read_params_file_of('backend')
    backend = Backend(BackendOptions.from_mapping(shipped), 2)
    told = IncrementalOdometry(ScanKeyframes())
    keyframes = []
    stated = []
    for stamp, step in steps(rng):
        pose, covariance = told.tell(stamp, step, begins=False)
        assert np.linalg.eigvalsh(covariance).min() > 0
        backend.add_odometry(OdometrySample(
            stamp, se2.to_pose3(pose[None])[0], whole(covariance), np.zeros((6, 6)), 'base'))
        if step.keyframe is not None:
            keyframes.append(stamp)
            stated.append(step.covariance)
    now = backend.snapshot()
    assert now.stamps.tolist() == keyframes and len(keyframes) > 5
    factors = now.graph.between
    found = np.linalg.inv(np.einsum('mki,mkj->mij', factors.sqrt_information[:],
                                    factors.sqrt_information[:]))
    for covariance, expected in zip(found, stated[1:], strict=True):
        # No less than the front end knows, in any direction; random ones that shrink add some.
        assert np.linalg.eigvalsh(covariance - expected).min() > -1e-9


def test_a_steady_covariance_is_stated_as_it_is():
    told, expected = IncrementalOdometry(ScanKeyframes()), np.diag((4e-4, 1e-4, 1e-5))
    total, last = np.zeros((3, 3)), np.zeros(3)
    for k in range(6):
        pose = np.array([0.1 * k, 0.0, 0.0])
        made = Keyframe(k, pose, None, 0, 0.0) if k in (0, 5) else None
        _, covariance = told.tell(k + 1, Step(pose, made, expected), begins=False)
        if k:
            Ad = se2.adjoint(se2.between(pose[None], last[None]))[0]
            total = Ad @ total @ Ad.T + covariance
        last = pose
    np.testing.assert_allclose(np.diag(total), np.diag(expected), rtol=0.05)


def test_a_new_part_is_a_gap_to_the_back_end():
    told = IncrementalOdometry(ScanKeyframes())
    backend = Backend(BackendOptions.from_mapping(read_params_file_of('backend')), 2)
    for k in range(30):
        pose = np.array([0.1 * k, 0.0, 0.0])
        made = Keyframe(k, pose, None, k // 15, 0.0) if k in (0, 5, 10, 15, 20, 25) else None
        pose, covariance = told.tell((k + 1) * S // 10, Step(pose, made, 1e-4 * np.eye(3)),
                                     begins=k == 15)
        backend.add_odometry(OdometrySample(
            (k + 1) * S // 10, se2.to_pose3(pose[None])[0], whole(covariance), np.zeros((6, 6)),
            'base'))
    now = backend.snapshot()
    assert now.stamps.tolist() == [(k + 1) * S // 10 for k in (0, 5, 10, 15, 20, 25)]
    assert len(now.graph.between) == 4
    assert backend.counts().told['new_part'] == 1


def transform(parent, child, pose3):
    t, q = pose3[:3], pose3[3:]
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent), child_frame_id=child, transform=SimpleNamespace(
            translation=SimpleNamespace(x=t[0], y=t[1], z=t[2]),
            rotation=SimpleNamespace(x=q[0], y=q[1], z=q[2], w=q[3])))


def test_static_transforms_say_where_the_laser_is():
    static, half = StaticTransforms(), np.sqrt(0.5)
    static.add(SimpleNamespace(transforms=[
        transform('/base', 'mast', (0.1, 0.2, 1.0, 0, 0, half, half)),
        transform('mast', 'laser', (0.3, 0.0, 0.1, 1.0, 0, 0, 0)),  # rolled by half a turn
        transform('mast', 'camera', (0, 0, 0, half, 0, 0, half))]))
    mount = static.mount('base', 'laser')
    np.testing.assert_allclose((mount.x, mount.y, mount.yaw), (0.1, 0.5, np.pi / 2))
    assert mount.upside_down
    assert static.mount('base', 'sonar') is None and static.mount('base', 'base') == Mount()
    with pytest.raises(MessageError, match='scans parallel to the floor'):
        static.mount('base', 'camera')
    circle = StaticTransforms()
    circle.add(SimpleNamespace(transforms=[transform('a', 'b', (0, 0, 0, 0, 0, 0, 1)),
                                           transform('b', 'a', (0, 0, 0, 0, 0, 0, 1))]))
    assert circle.mount('base', 'a') is None


@pytest.mark.parametrize('given, expected', [
    ('0.1, 0, 1.5', Mount(0.1, 0.0, 1.5)), ('[0.1 0.2 -1]', Mount(0.1, 0.2, -1.0)),
    ([0.1, 0.0, 0.5, 3.14159], Mount(0.1, 0.0, 0.5, True)), ('', None)])
def test_a_laser_pose_is_a_text_or_a_list(given, expected):
    assert ScanLoopsOptions(laser_pose=given).mount() == expected


def laser_scan(count=10, increment=0.1, **changes):
    values = {'angle_min': 0.0, 'angle_increment': increment, 'range_min': 0.1, 'range_max': 8.0,
              'time_increment': 0.0, 'ranges': [1.0] * count}
    stamp = SimpleNamespace(sec=1, nanosec=0)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), **values | changes)


def test_the_nearer_limit_of_the_range_counts():
    assert scan_in(laser_scan(), 0.0).range_max == 8.0
    assert scan_in(laser_scan(), 5.0).range_max == 5.0
    assert scan_in(laser_scan(range_max=0.0), 0.0).range_max == np.inf


@pytest.mark.parametrize('bad', [
    {'count': 1}, {'increment': 0.0}, {'increment': 2.0}, {'angle_min': np.nan}])
def test_what_is_no_scan_is_refused(bad):
    with pytest.raises(MessageError, match='a scan of') as caught:
        scan_in(laser_scan(**bad), 0.0)
    assert caught.value.cause == 'scan'


@pytest.mark.parametrize('frame', ['', 'map', 'maps', 'robot/map'])
@pytest.mark.parametrize('other', [None, 'x', 'one/more'], ids=str)
def test_a_path_is_read_as_ros_reads_it(rng, frame, other):
    """Also where one pose has a frame of its own, so that there is no one layout."""
    for count in (0, 1, 2, 7):
        message = PathMessage(header=header(frame, 3 * S + 7))
        for k in range(count):
            x, yaw = rng.normal(size=2)
            named = other if other is not None and k == 3 else frame
            pose = PoseStamped(header=header(named, (k + 1) * S + k))
            place, turn = pose.pose.position, pose.pose.orientation
            place.x, place.y, turn.z, turn.w = x, -x, np.sin(yaw / 2), np.cos(yaw / 2)
            message.poses.append(pose)
        found, stamps, poses = path_in(serialize_message(message))
        assert found == frame
        np.testing.assert_array_equal(stamps, [(k + 1) * S + k for k in range(count)])
        np.testing.assert_array_equal(poses, se2.from_pose3(np.array([
            (p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y,
             p.orientation.z, p.orientation.w)
            for p in (one.pose for one in message.poses)]).reshape(-1, 7)))


def test_keyframes_are_placed_by_the_path_and_odometry_from_there():
    placing = Placing()
    for k in range(10):
        placing.add_odometry((k + 1) * S, at(1.0 * k))
    keyframes = [Keyframe((k + 1) * S, at(1.0 * k), None, 0, 1.0 * k) for k in (0, 3, 5, 9)]
    assert len(placing.place(keyframes)) == 0
    # The path turns by a quarter, and has its keyframes elsewhere.
    placing.set_path('map', np.array([1, 5, 8]) * S, np.array(
        [(0, 0, np.pi / 2), (0.5, 4, np.pi / 2), (0.5, 7, np.pi / 2)]))
    np.testing.assert_allclose(placing.place(keyframes)[:, :2], [(0, 0), (0, 3), (0.5, 5)],
                               atol=1e-12)


def test_what_is_not_known_is_infinite():
    placing = Placing()
    keyframes = [Keyframe(k * S, at(1.0 * k), None, 0, 1.0 * k) for k in range(1, 4)]
    assert np.isinf(placing.spread(keyframes)).all()
    for stamp, sigma in ((1, 0.0), (3, 0.3)):
        placing.add_known(stamp * S, np.diag((sigma**2 / 2, sigma**2 / 2, 0.01)))
    np.testing.assert_allclose(placing.spread(keyframes)[:, 0],
                               [0.3, np.hypot(0.15, 0.3), np.hypot(0.3, 0.3)])


def read_params_file_of(name):
    return yaml.safe_load(SHIPPED.read_text())[f'/**/{name}']['ros__parameters'] | {
        'odom_frame': 'scan_odom'} if name != 'backend' else {
        key: value for key, value in yaml.safe_load(SHIPPED.read_text())[
            '/**/backend']['ros__parameters'].items() if key != 'odom_frame'}
