# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a robot says on the way, for `l1.Backend`, and what that makes of it."""

from dataclasses import dataclass
from itertools import islice

import numpy as np
from heard import PERIOD, UNKNOWN, covariance6, odometry, seconds
from records import information_of
from worlds import false_of, made, truth_of

import l1slam_ros as l1

# Every message a keyframe, with the covariance it states: the graph is that of the messages.
EVERY_MESSAGE = {'keyframe': {'translation': 0.0, 'rotation': 0.0, 'period': 0.0},
                 'odometry': {'covariance_source': 'increment'}}
EVERY = l1.BackendOptions.from_mapping(EVERY_MESSAGE)
# Every loop is used, however far off.
CREDULOUS = l1.BackendOptions.from_mapping({**EVERY_MESSAGE, 'robust': {'enabled': False}})
PLENTY = 60.0  # [s] of budget: an update then ends by its own tests, on any machine
STATES = ('waiting', 'suspect', 'accepted', 'rejected', 'expired')


@dataclass(frozen=True)
class World:
    """A graph, its true poses (n, p), and its false loops as `loops_by` has them."""

    graph: l1.FactorGraph
    truth: np.ndarray
    false: set


def simulated(folder, poses, edges, *more):
    """Return a world of `l1slam simulate`."""
    path = made(folder / 'world.g2o', poses, edges, *more)
    pairs = np.sort(false_of(path), axis=1) if '--false-loops' in more else np.zeros((0, 2))
    false = {(0, 0, *map(seconds, pair)) for pair in (pairs * PERIOD).tolist()}
    return World(l1.read_graph(path)[0], truth_of(path), false)


def remeasured(graph, measurement):
    """Return the graph with other measurements (m, p)."""
    other = l1.FactorGraph(graph.manifold, graph.n_poses)
    other.add_between(graph.between.i, graph.between.j, measurement, information_of(graph))
    return other


def turning(graph, drift):
    """Return a graph in the plane whose odometry turns by so much more each metre [rad/m]."""
    rows, measurement = graph.between.is_odometry, graph.between.measurement.copy()
    measurement[rows, 2] += drift * np.hypot(*measurement[rows, :2].T)
    return remeasured(graph, measurement)


def odometry_of(graph):
    """Return the poses of the odometry alone, (n, p), each robot's from the identity."""
    poses, step_to = graph.manifold.identity(graph.n_poses), graph.between.step_to
    for k in np.flatnonzero(step_to >= 0).tolist():
        poses[k] = graph.manifold.compose(
            poses[graph.predecessor[k]], graph.between.measurement[step_to[k]])
    return poses


def covariances_of(graph):
    """Return the covariances of all factors as messages state them, (m, 6, 6)."""
    rows = np.array([0, 1, 5]) if graph.manifold.TANGENT_SIZE == 3 else np.arange(6)
    whole = np.zeros((len(graph.between), 6, 6))
    whole[:, rows[:, None], rows] = np.linalg.inv(information_of(graph))
    return whole


def drive(backend, first, last, step=1.0):
    """Drive straight ahead: keyframe k at k `step` [m] and k [s]."""
    for k in range(first, last):
        backend.add_odometry(odometry(k, (k * step, 0.0, 0.0), covariance6(1e-4 * np.eye(3))))


def messages(graph, first=0, last=None):
    """Yield the sample of each keyframe first to last of a graph, and the loops that end there."""
    factors, manifold, covariances = graph.between, graph.manifold, covariances_of(graph)
    poses = manifold.to_pose3(odometry_of(graph))
    measured, later = manifold.to_pose3(factors.measurement), np.maximum(factors.i, factors.j)
    loops = np.flatnonzero(~factors.is_odometry)
    loops = loops[np.argsort(later[loops], kind='stable')]
    first_of = np.searchsorted(later[loops], np.arange(graph.n_poses + 1))
    for k in islice(range(graph.n_poses), first, last):
        step = factors.step_to[k]
        yield l1.OdometrySample(seconds(k * PERIOD), poses[k],
                                covariances[step] if step >= 0 else UNKNOWN, UNKNOWN)
        for row in loops[first_of[k]:first_of[k + 1]].tolist():
            ends = (seconds(end * PERIOD) for end in (factors.i[row], factors.j[row]))
            yield l1.LoopClosure(*ends, measured[row], covariances[row])


def play(backend, graph, first=0, last=None):
    """Add keyframes first to last of a graph and the loops that end there."""
    for message in messages(graph, first, last):
        if isinstance(message, l1.LoopClosure):
            backend.add_loop(message)
        else:
            backend.add_odometry(message)


def played(graph, first=0, last=None, options=EVERY):
    """Return a back end that has heard of some keyframes of a graph."""
    backend = l1.Backend(options, 2 if graph.manifold.TANGENT_SIZE == 3 else 3)
    play(backend, graph, first, last)
    return backend


def settled(backend):
    """Update until there is nothing left to do; return how often."""
    for count in range(100):
        if backend.update(PLENTY) is None:
            return count
    raise AssertionError('a hundred updates of one graph did not settle')


def states(backend):
    """Return what has become of loops by their stamps [s]: {(reference, end): state}."""
    return {(i / 1e9, j / 1e9): state for state in STATES
            for _, _, i, j in loops_by(backend, state)}


def loops_by(backend, *named):
    """Return robots and stamps [ns] of the loops in some states, or of all: {(r, r, i, j)}."""
    found = backend.loop_states()
    return {(*robots, *stamps) for robots, stamps, state in zip(
        found.robots.tolist(), found.stamps.tolist(), found.state.tolist(), strict=True)
        if not named or STATES[state] in named}
