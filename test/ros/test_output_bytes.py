# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The bytes of markers, states of loops and covariances that the node publishes."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from node_bench import EVERY_MESSAGE
from rclpy.serialization import deserialize_message
from systems import dense_covariance
from visualization_msgs.msg import Marker, MarkerArray

from bags import write_world
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.running.snapshot import ACCEPTED, EXPIRED, REJECTED, WAITING, LoopStates
from l1slam_ros.io.messages.serialisation import header_bytes
from l1slam_ros.ros.loop_status import LoopStatus, states_bytes
from l1slam_ros.ros.markers import _array_bytes
from l1slam_ros.ros.publishing import pose_with_covariance


@pytest.mark.parametrize('frame', ['map', 'm', 'world'])
def test_markers_are_what_their_bytes_say(frame, rng):
    made = [('keyframes', 3, Marker.POINTS, Marker.ADD, 0.1, rng.normal(size=(5, 3)),
             rng.random((5, 4), dtype=np.float32)),
            ('odd', 1, Marker.LINE_LIST, Marker.DELETE, 0.3, np.zeros((0, 3)),
             np.zeros((0, 4), np.float32)),
            ('loops', 7, Marker.LINE_LIST, Marker.ADD, 0.5, rng.normal(size=(2, 3)),
             rng.random((2, 4), dtype=np.float32))]
    read = deserialize_message(_array_bytes(header_bytes(frame, 10**9 + 5), made), MarkerArray)
    for marker, (name, number, kind, action, size, points, colours) in zip(
            read.markers, made, strict=True):
        assert (marker.ns, marker.id, marker.type, marker.action) == (name, number, kind, action)
        assert marker.scale.x == size and marker.pose.orientation.w == 1.0
        assert (marker.header.frame_id, marker.header.stamp.nanosec) == (frame, 5)
        assert [(p.x, p.y, p.z) for p in marker.points] == [tuple(p) for p in points]
        assert [(c.r, c.g, c.b, c.a) for c in marker.colors] == [tuple(c) for c in colours]
        assert not marker.text and not marker.mesh_resource and not marker.texture.data


# Every remainder modulo 4.
@pytest.mark.parametrize('name', ['/b', '/ba', '/bac', '/back'])
def test_ros_reads_the_states_of_loops_that_were_meant(name):
    stamps = np.array([[1, 2], [10**9 + 5, 7 * 10**9], [3, 4 * 10**9 + 1]])
    states = LoopStates(np.arange(2), stamps, np.array([ACCEPTED, REJECTED, WAITING]),
                        np.array([0.5, 12.346, np.nan]), np.array([[0, 0], [0, 1], [2, 0]]))
    data = states_bytes(name, 5_000_000_007, states, [1, 2])
    read = deserialize_message(data, DiagnosticArray)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (5, 7)
    refused, waiting = read.status
    assert refused.name == f'{name}: loop 1.000000005 - 7.000000000'
    assert (refused.level, refused.message, refused.hardware_id) == (
        DiagnosticStatus.WARN, 'rejected', name)
    assert {value.key: value.value for value in refused.values} == {
        'reference_stamp': '1.000000005', 'stamp': '7.000000000', 'state': 'rejected',
        'sigmas': '12.35'}
    assert waiting.level == DiagnosticStatus.OK and waiting.values[3].value == ''
    named = deserialize_message(
        states_bytes(name, 0, states, [1, 2], ('r1', 'r2')), DiagnosticArray).status
    assert [one.name.partition(': ')[2] for one in named] == [
        'loop r1 1.000000005 - r2 7.000000000', 'loop 2 0.000000003 - r1 4.000000001']
    assert [{value.key: value.value for value in one.values}['robot'] for one in named] == [
        'r2', 'r1']


def test_each_loop_is_told_of_when_it_comes_and_when_it_changes(bench):
    b = bench()
    told, status = [], LoopStatus(b.peer)
    b.peer.create_subscription(DiagnosticArray, 'loop_status', lambda message: told.append(
        [(one.name[-1], one.message) for one in message.status]), 1000)
    b.until(lambda: status._publisher.get_subscription_count(), 'somebody listens')
    for *in_graph, outside in (
            [{5: WAITING, 6: WAITING}], [{5: WAITING, 6: WAITING}],
            [ACCEPTED, {6: EXPIRED}], [ACCEPTED, {7: WAITING, 6: EXPIRED}],
            [REJECTED, {6: EXPIRED, 7: EXPIRED}], [REJECTED, {6: EXPIRED, 7: EXPIRED}],
            [{7: WAITING}]):
        stamps = [(1, 5) for _ in in_graph] + [(1, end) for end in outside]
        status.publish(LoopStates(np.arange(len(in_graph)), np.array(stamps), np.array(
            [*in_graph, *outside.values()]), np.zeros(len(stamps)),
            np.zeros((len(stamps), 2), np.int64)))
    b.until(lambda: len(told) == 5, 'all is told')
    assert told == [[('5', 'waiting'), ('6', 'waiting')], [('5', 'accepted'), ('6', 'expired')],
                    [('7', 'waiting')], [('5', 'rejected'), ('7', 'expired')],
                    [('7', 'waiting')]]


def test_the_covariance_is_that_of_a_dense_inverse(bench, tmp_path):
    write_world(tmp_path / 'bag', 60, 130)
    b = bench(**EVERY_MESSAGE)
    heard = []
    b.peer.create_subscription(PoseWithCovarianceStamped, 'pose_with_covariance', heard.append, 10)
    b.until(lambda: b.backend._map.covariances[0].get_subscription_count(), 'somebody listens')
    b.play(tmp_path / 'bag')
    b.until(lambda: heard and heard[-1].header.stamp == b.path().poses[-1].header.stamp
            and b.backend._backend.update(0.0) is None, 'the map is done')
    now = b.backend._backend.snapshot()
    dense = dense_covariance(now)[-1, :, -1]
    expected = deserialize_message(pose_with_covariance(
        'map', int(now.stamps[-1]), se2, now.poses[-1:], dense), PoseWithCovarianceStamped)

    def agrees():
        return np.allclose(heard[-1].pose.covariance, expected.pose.covariance, rtol=1e-6)

    b.until(agrees, 'the covariance of the newest keyframe')
    whole = np.reshape(heard[-1].pose.covariance, (6, 6))
    R = se2.adjoint(now.poses[-1:])[0, :2, :2]
    np.testing.assert_allclose(whole[:2, :2], R @ dense[:2, :2] @ R.T, rtol=1e-6,
                               atol=1e-8)
    assert whole[5, 5] == pytest.approx(dense[2, 2], rel=1e-6) and not whole[2:5].any()
    assert heard[-1].header.frame_id == 'map'
