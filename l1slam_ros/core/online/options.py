# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What makes keyframes and factors of messages: the options of `graph_builder`."""

from dataclasses import dataclass

from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loops.loop_factors import LoopOptions
from l1slam_ros.core.options import Options, option

# What a gap in the odometry is to the map: the cause it is counted by, and what is said of it.
ON_A_GAP = {'new_segment': ('new_part', 'a new part of the map begins where the last one ends'),
         'reset': ('reset', 'the map begins anew'),
         'ignore': ('moved', 'the robot is taken to be where it was')}


@dataclass(frozen=True)
class GraphBuilderOptions(Options):
    """What makes keyframes and factors of messages."""

    keyframe: KeyframeOptions = KeyframeOptions()
    odometry: OdometryOptions = OdometryOptions()
    loop: LoopOptions = LoopOptions()
    on_time_jump: str = option(
        'new_segment', 'what happens when the ROS clock or the stamps of the odometry jump back, '
        'or the odometry jumps further than any robot moves. new_segment: the map stays and a new '
        'part begins, which loops can join to it; reset: the map begins anew; ignore: the robot '
        'is taken to be where it was, and messages with old stamps are dropped', '',
        choices=tuple(ON_A_GAP))
    base_frame: str = option(
        '', "the robot's frame; empty: the first child_frame_id received", fixed=True)
