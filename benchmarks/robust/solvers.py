# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What solvers of graphs with lies are to the measurements, and our own: the only door to ours."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from measuring import clock

from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.robust import batch_map
from l1slam_ros.core.robust.judgement import Doubt
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.paper.updates import Drive

# Online: an update after so many keyframes, for so long [s].
_EVERY, _BUDGET = 10, 0.1
# Updates after the last keyframe, while the robot stands still: until there is nothing more to do,
# but so many at most.
_LAST_UPDATES, _LAST_BUDGET = 200, 0.5
# [m, rad] Two measurements of one pair are the same loop.
_SAME = 1e-6
# Live: [s] how often to look whether it is at rest, and for how long.
_LOOK, _LONGEST_REST = 0.1, 120.0
DOUBTFUL, REFUSED = 'doubtful', 'refused'


@dataclass(frozen=True)
class Found:
    """
    A map and what it took.

    poses : (n, p); seconds : [s]; accepted : (m,) bool, None where the solver does not say;
    slips : rows of odometry factors it takes for lies; status : its own word on the map; why :
    it is doubtful, or there is none; maps : (k, p) each, of those on the way.
    """

    poses: Array
    seconds: float
    accepted: Mask | None = None
    slips: tuple[int, ...] = ()
    status: str = ''
    why: str = ''
    maps: tuple[Array, ...] = ()


@dataclass(frozen=True)
class RobustSolver:
    """
    Something that makes a map.

    norm : what it minimises, l1 or l2; start : of `runs.STARTS`; solve : from a graph and poses
    (n, p) to what it found; online : pose by pose, with maps on the way every `LOOK` keyframes.
    """

    name: str
    norm: str
    start: str
    solve: Callable[[FactorGraph, Array], Found]
    online: bool = False


# Keyframes between two looks at the map of a running back end.
LOOK = 50


def _batch(norm: str) -> Callable[[FactorGraph, Array], Found]:
    """Count all from the factor graph on; the poses are not looked at."""

    def solve(graph: FactorGraph, poses: Array) -> Found:
        began = clock()
        try:
            outcome = batch_map.solve(graph, None, batch_map.SolveOptions(norm=norm, robust=True))
        except L1SlamError as error:
            return Found(poses, clock() - began, graph.between.is_odometry.copy(),
                         status=REFUSED, why=str(error))
        seconds, judgement = clock() - began, outcome.judgement
        assert judgement is not None
        return Found(outcome.solution.poses, seconds, judgement.accepted,
                     tuple(judgement.slips.tolist()),
                     *_said(judgement.doubt, outcome.solution.status.value))

    return solve


def _said(doubt: Doubt | None, status: str) -> tuple[str, str]:
    """Return its word on the map, and why it is doubtful."""
    return (DOUBTFUL, str(doubt)) if doubt else (status, '')


def _online(rate: float) -> Callable[[FactorGraph, Array], Found]:
    """
    Feed the back end as the node does, robust as it is by default.

    rate : keyframes a second, updates in the background; 0: the updates are waited for
    """

    def solve(graph: FactorGraph, poses: Array) -> Found:
        maps = []
        seconds = 0.0
        process = clock()
        began = time.monotonic()
        nothing = dict.fromkeys(('translation', 'rotation', 'period'), 0.0)
        options = BackendOptions.from_mapping(
            {'keyframe': nothing, 'odometry': {'covariance_source': 'increment'}})
        drive = Drive.of(graph)
        with Backend(options, drive.dimension, rate > 0) as backend:
            for k, (sample, loops) in enumerate(drive.messages, 1):
                backend.add_odometry(sample)
                for loop in loops:
                    backend.add_loop(loop)
                if rate:
                    time.sleep(max(0.0, began + k / rate - time.monotonic()))
                elif k % _EVERY == 0:
                    seconds += _updated(backend, _BUDGET)[0]
                if k % LOOK == 0:
                    maps.append(backend.poses)
            if rate:
                _come_to_rest(backend)
                seconds = clock() - process
            else:
                for _ in range(_LAST_UPDATES):
                    took, was_due = _updated(backend, _LAST_BUDGET)
                    seconds += took
                    if not was_due:
                        break
            return _found(backend, graph, seconds, tuple(maps))

    return solve


def _come_to_rest(backend: Backend) -> None:
    """Wait, as a robot that stands still, until all is judged and mapped."""
    began = time.monotonic()
    while not backend.behind().at_rest and time.monotonic() - began < _LONGEST_REST:
        time.sleep(_LOOK)


def _found(backend: Backend, graph: FactorGraph, seconds: float,
           maps: tuple[Array, ...]) -> Found:
    """Return what the back end believes, by the rows of the graph it was fed."""
    now, factors = backend.snapshot(), graph.between
    judgement = now.judgement
    steps = np.where(factors.is_odometry, np.minimum(factors.i, factors.j), -1)
    slips = np.flatnonzero(np.isin(steps, now.graph.between.i[judgement.slips]))
    return Found(backend.poses, seconds, _accepted(backend, graph), tuple(slips.tolist()),
                 *_said(judgement.doubt, ''), maps)


def _updated(backend: Backend, budget: float) -> tuple[float, bool]:
    """Return how long an update took, and whether there was anything to do."""
    began = clock()
    was_due = backend.update(budget) is not None
    return clock() - began, was_due


def _accepted(backend: Backend, graph: FactorGraph) -> Mask:
    """Return which factors of the graph the back end uses; it takes a repeated loop once."""
    states, used = backend.loop_states(), backend.snapshot().graph.between
    rows = states.rows[states.state[: len(states.rows)] == ACCEPTED]
    measured: dict[tuple[int, int], list[Array]] = {}
    for i, j, Z in zip(used.i[rows].tolist(), used.j[rows].tolist(), used.measurement[rows],
                       strict=True):
        measured.setdefault((i, j), []).append(Z)
    accepted = graph.between.is_odometry.copy()
    for row, (i, j, Z) in enumerate(zip(*ends_in_time(graph), strict=True)):
        accepted[row] |= any(np.allclose(Z, other, atol=_SAME)
                             for other in measured.get((int(i), int(j)), []))
    return accepted


OURS = (RobustSolver('ours L1', 'l1', 'odometry', _batch('l1')),
        RobustSolver('ours L2', 'l2', 'odometry', _batch('l2')),
        RobustSolver('ours online', 'l1', 'odometry', _online(0.0), online=True),
        *(RobustSolver(f'ours live {rate}', 'l1', 'odometry', _online(rate), online=True)
          for rate in (50, 150, 400)))
