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

from geometry_msgs.msg import PoseWithCovarianceStamped
from node_bench import EVERY_MESSAGE, loop
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
    b.rest()
    sigmas = [sigmas for state, sigmas in b.loops().values() if state == 'accepted']
    worst = late.drawn['loops', 0].colors[2 * int(np.nanargmax(sigmas))]
    assert worst.r > 0.1 and worst.a == 1.0


def test_a_person_strikes_a_loop_out_and_vouches_for_it_after_all(bench):
    b = bench(**{'robust.enabled': False})
    b.drive(0, 6)
    seen = loop(6 * 10**9, 3.0, variance=1e-6)
    b.send('/loop_closures', seen)

    def states():
        return [state for state, _ in b.loops().values()]

    def end():
        return b.path().poses[-1].pose.position.x if len(b.path().poses) == 6 else None

    b.until(lambda: states() == ['accepted'] and end() and end() < 4.9, 'the loop is believed')
    # Only the stamps count; what else is in the message may be nothing.
    b.send('/false_loop_closures', PoseWithCovarianceStamped(header=seen.header))
    b.until(lambda: states() == ['rejected'] and end() and abs(end() - 5) < 1e-6, 'struck out')
    b.send('/trusted_loop_closures', seen)
    b.until(lambda: states() == ['accepted'] and end() and end() < 4.9, 'vouched for')
