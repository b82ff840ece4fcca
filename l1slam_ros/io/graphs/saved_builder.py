# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What a saved map keeps of its graph builder, as values by name.

In: the state of a builder. Out: values that JSON can hold, and the state again. A map of one robot
names no robots, so that maps which were saved before there were several are read alike.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.parts import give_to
from l1slam_ros.core.online.builder_state import BuilderState, LoopsState, TrackEnd


def values_of(state: BuilderState) -> dict[str, Any]:
    """Return the values of a state for which g2o has no tag, by name."""
    first, *others = state.ends
    loops = state.loops
    values = {
        'stamps': state.stamps, 'odometry': state.odometry, 'offset': first.offset,
        'end': first.end, 'end_pose': first.end_pose, 'end_covariance': first.end_covariance,
        'loop_rows': loops.rows, 'loop_stamps': loops.stamps, 'expired': loops.expired,
        'struck_pairs': loops.struck_pairs,
        'seen': [[key.hex(), loops.seen[key]] for key in sorted(loops.seen)],
        'waiting': [[loop.reference_stamp, loop.stamp, loop.trusted, loop.struck, age,
                     loop.pose3.tolist(), loop.covariance.tolist(),
                     *(loop.robots if any(loop.robots) else ())]
                    for loop, age in loops.waiting]}
    if not (others or first.robot):
        return values
    return values | {
        'keyframe_robots': state.graph.robot, 'robot': first.robot,
        'others': [[end.robot, end.offset.tolist(), end.end, end.end_pose.tolist(),
                    end.end_covariance.tolist()] for end in others],
        'loop_robots': loops.robots, 'expired_robots': loops.expired_robots}


def restored(state: BuilderState, saved: Mapping[str, Any]) -> BuilderState:
    """Return the state of a graph with the values that were saved, the others as they were."""
    values = values_of(state) | dict(saved)
    poses = (-1, state.graph.manifold.POSE_SIZE)
    first = state.ends[0]
    end = TrackEnd(values.get('robot', 0), _floats(values['offset']).reshape(poses),
                   values['end'], _floats(values['end_pose']).reshape(poses),
                   _floats(values['end_covariance']).reshape(first.end_covariance.shape))
    others = tuple(TrackEnd(robot, _floats(offset), end, _floats(pose), _floats(covariance))
                   for robot, offset, end, pose, covariance in values.get('others', ()))
    if 'keyframe_robots' in values:
        give_to(state.graph, np.array(values['keyframe_robots']))
    return replace(
        state, stamps=np.array(values['stamps'], np.int64), ends=(end, *others),
        odometry=_floats(values['odometry']).reshape(poses), loops=_loops(values))


def _loops(values: dict[str, Any]) -> LoopsState:
    stamps, expired = _pairs(values['loop_stamps']), _pairs(values['expired'])
    robots, expired_robots = (
        _pairs(values.get(name, np.zeros_like(of)))
        for name, of in (('loop_robots', stamps), ('expired_robots', expired)))
    waiting = tuple(
        (LoopClosure(reference, stamp, np.array(pose3), np.array(covariance), trusted, struck,
                     *robots[::-1]), age)
        for reference, stamp, trusted, struck, age, pose3, covariance, *robots
        in values['waiting'])
    seen = {bytes.fromhex(key): row for key, row in values['seen']}
    return LoopsState(
        np.array(values['loop_rows'], np.int64), stamps, robots, expired, expired_robots, waiting,
        seen, _pairs(values['struck_pairs']))


def _floats(values: Any) -> Array:
    return np.array(values, float)


def _pairs(values: Any) -> Indices:
    return np.array(values, np.int64).reshape(-1, 2)
