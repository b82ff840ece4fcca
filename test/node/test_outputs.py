# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes besides the Path: the drawn graph, and the states of loops."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from node_bench import EVERY_MESSAGE, loop, odometry
from visualization_msgs.msg import Marker, MarkerArray

from bags import write_world


class Drawing:
    """What RViz would draw of the markers so far."""

    def __init__(self, b):
        self.drawn, self.heard = {}, 0
        b.peer.create_subscription(MarkerArray, 'graph', self.take, 10)

    def take(self, message):
        self.heard += 1
        for marker in message.markers:
            assert marker.header.frame_id == 'map' and marker.pose.orientation.w == 1.0
            assert not marker.text and not marker.mesh_resource and not marker.texture.data
            self.drawn.pop((marker.ns, marker.id), None)
            if marker.action == Marker.ADD:
                self.drawn[marker.ns, marker.id] = marker

    def sizes(self):
        sizes = {}
        for (name, _), marker in self.drawn.items():
            assert len(marker.colors) == len(marker.points)
            sizes[name] = sizes.get(name, 0) + len(marker.points)
        return sizes


def test_the_graph_is_drawn_for_who_looks_also_for_who_comes_late(bench, tmp_path):
    write_world(tmp_path / 'bag', 40, 60)
    b = bench(**EVERY_MESSAGE)
    early = Drawing(b)
    b.play(tmp_path / 'bag')

    def all_are_drawn(drawing, believed=0):
        points = drawing.sizes()
        if points.get('loops', 0) < 2 * believed:
            return False
        loops = [points.pop(name, 0) for name in ('loops', 'suspect_loops', 'rejected_loops')]
        return points == {'keyframes': 40, 'odometry': 2 * 39} and sum(loops) == 2 * 21

    b.until(lambda: all_are_drawn(early, believed=15),
            'keyframes and both ends of each factor are drawn, most loops as believed')
    late = Drawing(b)
    b.until(lambda: all_are_drawn(late), 'who comes late sees all of it')
    assert late.heard == 1
    path = np.array([(p.pose.position.x, p.pose.position.y) for p in b.path().poses])
    drawn = np.array([(p.x, p.y) for p in late.drawn['keyframes', 0].points])
    np.testing.assert_allclose(drawn, path, atol=2e-3)
    loops = late.drawn['loops', 0]
    assert (loops.type, loops.scale.x) == (Marker.LINE_LIST, 0.05)
    assert (late.drawn['keyframes', 0].type, late.drawn['keyframes', 0].scale.x) == (
        Marker.POINTS, 0.12)
    # From green, which has hardly any red, to yellow and red.
    assert {one.a for one in loops.colors} == {1.0}
    assert min(one.g for one in loops.colors if one.r < 0.8) > 0.6
    assert min(one.r for one in loops.colors) < 0.3 < max(one.r for one in loops.colors)
    assert {(one.r, one.a) for one in late.drawn['odometry', 0].colors} == {(0.5, 1.0)}


def test_a_person_strikes_a_loop_out_and_vouches_for_it_after_all(bench):
    b = bench(**{'robust.enabled': False})
    b.drive(0, 6)
    seen = loop(6 * 10**9, 3.0, variance=1e-6)
    b.send('/loop_closures', seen)

    def found(state, low, high):
        """Tell whether the loop is in a state, and the way from the first to the last one."""
        poses = b.path().poses
        return b.states() == {state: 1} and len(poses) == 6 and (
            low < poses[-1].pose.position.x < high)

    b.until(lambda: found('accepted', 2.9, 4.9), 'the loop is believed')
    # Only the stamps count; what else is in the message may be nothing.
    b.send('/false_loop_closures', PoseWithCovarianceStamped(header=seen.header))
    b.until(lambda: found('rejected', 5 - 1e-6, 5 + 1e-6), 'struck out')
    b.send('/trusted_loop_closures', seen)
    b.until(lambda: found('accepted', 2.9, 4.9), 'vouched for')
    told = [one for message in b.received['loop_status'] for one in message.status]
    assert [one.message for one in told if one.message != 'waiting'] == [
        'accepted', 'rejected', 'accepted'], 'each change is told of, and nothing else'
    refused = next(one for one in told if one.message == 'rejected')
    assert (refused.name, refused.level, refused.hardware_id) == (
        '/backend: loop 1.000000000 - 6.000000000', DiagnosticStatus.WARN, '/backend')
    assert [value.key for value in refused.values] == [
        'reference_stamp', 'stamp', 'state', 'sigmas']
    assert {one.level for one in told if one.message != 'rejected'} == {DiagnosticStatus.OK}


def test_the_covariance_is_that_of_the_sum_of_all_motions(bench):
    """Straight on without loops it is known: each turn moves what is behind it to the side."""
    b = bench(**EVERY_MESSAGE)
    heard = b.listen(PoseWithCovarianceStamped, 'pose_with_covariance', 10)
    b.until(lambda: b.peer.count_publishers('pose_with_covariance'), 'it is there')
    noise = np.diag([4e-4, 1e-4, 0, 0, 0, 9e-4])  # of each motion, in the axes of the robot
    expected = np.zeros((6, 6))
    for k in range(5):
        message = odometry((k + 1) * 10**9, 1.0 * k)
        message.pose.covariance = noise.ravel()
        b.send('/odom', message)
        moved = np.eye(6)
        moved[1, 5] = 4 - k
        expected += moved @ noise @ moved.T * (k > 0)
    b.until(lambda: heard and heard[-1].header.stamp.sec == 5, 'that of the newest keyframe')
    b.rest()
    whole = np.reshape(heard[-1].pose.covariance, (6, 6))
    np.testing.assert_allclose(whole, expected, rtol=1e-4, atol=1e-9)
    assert not whole[2:5].any()
    assert heard[-1].header.frame_id == 'map'
