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

from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import index
from typing import Any

import numpy as np

from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.graph.parts import give_to
from l1slam_ros.core.online.builder_state import BuilderState, LoopsState, TrackEnd
from l1slam_ros.io.files import LARGEST

# Of a value of a saved map: its name, itself as an array, the shape and the range it must have.
Limits = tuple[str, np.ndarray, tuple[int, ...], tuple[float, float]]
ANY = -np.inf, np.inf
FINITE = -LARGEST, LARGEST
_ROBOT = 0, 2**31
_TIME = -(2.0**62), 2.0**62  # [ns]
# [bytes] Of the key of a loop in `LoopsState.seen`, without its robots.
_IDENTITY = 16


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


def limits_of(state: BuilderState) -> Iterator[Limits]:
    """Yield the limits of a state's values: what is beyond them, no map can have."""
    graph, loops, robots = state.graph, state.loops, np.unique(state.graph.robot)
    n, m = len(state.stamps), len(graph.between)
    d, p = graph.manifold.TANGENT_SIZE, graph.manifold.POSE_SIZE
    yield 'stamps', state.stamps, (n,), ANY
    for robot in robots:
        own = state.stamps[graph.robot == robot].astype(float)
        # Where stamps go back, time goes on.
        yield 'stamps', own.max() - np.diff(own).clip(max=0).sum(), (), _TIME
    yield 'odometry', _normalised(graph.manifold, state.odometry), (n, p), FINITE
    yield 'keyframe_robots', graph.robot, (n,), _ROBOT
    yield 'robot', np.sort([end.robot for end in state.ends]) - robots, robots.shape, (0, 0)
    for end in state.ends:
        for pose in end.offset, end.end_pose:
            yield 'end_pose', _normalised(graph.manifold, pose), (1, p), FINITE
        yield 'end', np.array(index(end.end), np.int64), (), ANY
        yield 'end_covariance', end.end_covariance, (d, d), ANY
    k, expired, struck, seen = map(len, (loops.rows, loops.expired, loops.struck_pairs,
                                         loops.seen))
    yield 'loop_rows', loops.rows, (k,), (0, m - 1)
    yield 'loop_stamps', loops.stamps, (k, 2), ANY
    yield 'loop_robots', loops.robots, (k, 2), _ROBOT
    yield 'expired_robots', loops.expired_robots, (expired, 2), _ROBOT
    yield 'struck_pairs', loops.struck_pairs, (struck, 2), (0, n - 1)
    yield 'seen', np.array([*loops.seen.values()], np.int64), (seen,), (-1, m - 1)
    for key in loops.seen:
        named = np.frombuffer(key[_IDENTITY:], np.int64)
        yield 'seen', np.array(len(key)), (), (_IDENTITY, 2 * _IDENTITY)
        yield 'seen', named, (2,) if len(named) else (0,), _ROBOT
    for loop, age in loops.waiting:
        yield 'waiting', np.array((*loop.stamps, age), np.int64), (3,), ANY
        yield 'waiting', np.array(loop.robots), (2,), _ROBOT
        yield 'waiting', _normalised(se3, loop.pose3[None]), (1, 7), FINITE


def _normalised(manifold: Manifold, poses: Array) -> Array:
    """Return poses with quaternions of norm 1; of a quaternion without a direction NaN."""
    with np.errstate(all='ignore'):
        return manifold.from_pose3(manifold.to_pose3(poses))


def _loops(values: dict[str, Any]) -> LoopsState:
    stamps, expired = _pairs(values['loop_stamps']), _pairs(values['expired'])
    robots, expired_robots = (
        _pairs(values.get(name, np.zeros_like(of)))
        for name, of in (('loop_robots', stamps), ('expired_robots', expired)))
    waiting = tuple(_waiting(*loop) for loop in values['waiting'])
    seen = {bytes.fromhex(key): row for key, row in values['seen']}
    return LoopsState(
        np.array(values['loop_rows'], np.int64), stamps, robots, expired, expired_robots, waiting,
        seen, _pairs(values['struck_pairs']))


def _waiting(reference: Any, stamp: Any, trusted: Any, struck: Any, age: Any, pose3: Any,
             covariance: Any, *robots: Any) -> tuple[LoopClosure, int]:
    """Return a loop that waits, and for how long it has [ns]."""
    return LoopClosure(
        None if reference is None else index(reference), index(stamp), _floats(pose3).reshape(7),
        _floats(covariance).reshape(6, 6), bool(trusted), bool(struck),
        *map(index, robots[::-1])), index(age)


def _floats(values: Any) -> Array:
    return np.array(values, float)


def _pairs(values: Any) -> Indices:
    return np.array(values, np.int64).reshape(-1, 2)
