# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What was kept for who comes late, as replay publishes it."""

import pytest

pytest.importorskip('rclpy')

from rclpy.qos import DurabilityPolicy

from l1slam_ros.io.bags.reader import BagSummary, TopicSummary
from l1slam_ros.ros.replay import Player


def test_what_was_kept_for_who_comes_late_is_kept_by_replay(ros):
    """Who asks for what was kept, as for a grid, hears no publisher that keeps nothing."""
    kind = 'std_msgs/msg/String'
    topics = [TopicSummary('/grid', kind, 1, kept=1), TopicSummary('/r1/tf_static', kind, 2),
              TopicSummary('/said', kind, 9)]
    summary = BagSummary(tuple(topics), start=0, duration=0, note={})
    node = ros.create_node('replay')
    player = Player(node, summary, None, {}, clock=False)
    profiles = {name: publisher.qos_profile for name, publisher in player.publishers.items()}
    kept = {name: profile.depth for name, profile in profiles.items()
            if profile.durability is DurabilityPolicy.TRANSIENT_LOCAL}
    assert kept == {'/grid': 1, '/r1/tf_static': 1000} and profiles['/said'].depth == 1000
    node.destroy_node()
