# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Simulated time as a bag player makes it: it stands still, goes on, and begins again."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from node_bench import EVERY_MESSAGE, call, header, poses_of
from rosgraph_msgs.msg import Clock

import l1slam_ros as l1
from bags import recording_of, write_world

N = 120


def test_a_bag_played_twice_by_a_clock_that_stands_is_the_map_and_the_odometry(bench, tmp_path):
    graph = write_world(tmp_path / 'bag', N, 240, 3).graph
    messages = recording_of(tmp_path / 'bag')
    b = bench(use_sim_time=True, **EVERY_MESSAGE)
    clock = b.peer.create_publisher(Clock, '/clock', 10)
    b.until(clock.get_subscription_count, 'the node hears the clock')
    once = l1.solve(graph).poses
    for turn in 1, 2:
        for number, (topic, _, time, data) in enumerate(messages):
            if not len(messages) / 3 < number < len(messages) / 2:
                clock.publish(Clock(clock=header('', time).stamp))
            b.send(topic, data)
        b.until(lambda turn=turn: b.status()[2].get('keyframes') == str(turn * N), 'all is in')
        answer = call(b, 'optimize')  # no loop joins the second part to the first
        assert (answer.success, ' joins 2 parts of ' in answer.message) == (turn == 1, turn == 2)
        # One of before it was optimised may have as many keyframes.
        b.until(lambda turn=turn: len(b.path().poses) == turn * N and np.abs(
            poses_of(b.path())[:N] - once)[:, :2].max() < 0.05, 'the map is published')
    assert b.status()[2]['refused.repeated'] == str(len(graph.between) - N + 1)
