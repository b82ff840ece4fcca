# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The paper's two runs with a draw: a start of mostly noise (Figure 4), loops that lie (Figure 6).

In: a graph and its stored poses. Out: the poses that each method makes of the draw.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.batch import minimise_robustly
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, gauss_newton, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Solution
from l1slam_ros.core.solvers.optimality import Huber
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.false_loops import identity_false_loops, insert_loops

# Standard deviations of the noise on every stored pose, each [m] and [rad] alike.
NOISES = (0.25, 0.5, 1.0, 2.0)
# A map that is further off than this part of its diagonal looks bent to the eye.
_BENT = 0.02


@dataclass(frozen=True)
class NoisyStart:
    """A start with this noise, what L2 makes of it, the seed and what L1 makes of that, (n, p)."""

    noise: float
    start: Array
    l2: Array
    seed: Array
    l1: Array


@dataclass(frozen=True)
class LyingLoops:
    """
    A graph with false loops.

    clean : (n, p) its L1 map without them; seed, l1, huber, robust : (n, p) what the methods make
    of it; false, accepted : (m,) bool, which factors are, and which the robust one believed.
    """

    graph: FactorGraph
    clean: Array
    seed: Array
    l1: Array
    huber: Array
    robust: Array
    false: Mask
    accepted: Mask


def run_noisy_start(graph: FactorGraph, stored: Array, rng: np.random.Generator) -> NoisyStart:
    """Return what comes of the stored poses (n, p) under the least noise that bends the L2 map."""
    cholesky = cholesky_of(graph)
    size = np.ptp(graph.manifold.positions(stored), axis=0)
    seed = seed_poses(graph, cholesky)
    ours = _minimise_l1(graph, seed).poses
    for noise in NOISES:
        start = with_noise(graph, stored, noise, rng)
        l2 = minimise_l2(graph, start, LeastSquaresOptions(), cholesky).poses
        if off(graph, l2, ours) > _BENT * np.linalg.norm(size):
            break
    return NoisyStart(noise, start, l2, seed, ours)


def with_noise(graph: FactorGraph, poses: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Return the poses (n, p), each moved at random by sigma [m] and [rad] in its own axes."""
    size = graph.manifold.TANGENT_SIZE
    return graph.manifold.retract(poses, sigma * rng.standard_normal((len(poses), size)))


def run_false_loops(graph: FactorGraph, stored: Array, count: int,
                    rng: np.random.Generator) -> LyingLoops:
    """
    Return what comes of `count` loops between far poses that measure no motion at all.

    stored : (n, p) where Huber, as wide as g2o's, starts; the other methods read no start

    Raises
    ------
    GraphError : too few far pairs are free, or the graph is no chain of odometry with loops.

    """
    clean = _minimise_l1(graph, seed_poses(graph, cholesky_of(graph))).poses
    loops = identity_false_loops(graph, clean, count, rng)
    lying = insert_loops(graph, loops)
    cholesky = cholesky_of(lying)
    factors = lying.between
    n = graph.n_poses
    seed, robust = seed_poses(lying, cholesky), minimise_robustly(lying, _minimise_l1)
    huber = gauss_newton(lying, stored, Huber(graph.manifold.TANGENT_SIZE, 1.0),
                         LeastSquaresOptions(), cholesky)
    false = np.isin(pair_key(factors.i, factors.j, n), pair_key(loops.i, loops.j, n))
    return LyingLoops(lying, clean, seed, _minimise_l1(lying, seed).poses, huber.poses,
                      robust.solution.poses, false, robust.judgement.accepted)


def off(graph: FactorGraph, poses: Array, reference: Array) -> float:
    """Return the RMSE of the positions of poses from those of a reference, (n, p), aligned [m]."""
    positions = graph.manifold.positions
    return absolute_trajectory_error(positions(poses), positions(reference))


def _minimise_l1(graph: FactorGraph, poses: Array) -> Solution:
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0]
