# SPDX-License-Identifier: Apache-2.0
"""
Making the compiled loops ready before they are needed.

Solves a world of a few keyframes by every method, so that each loop is compiled, at the first
use after an installation, or read from the cache, which takes a part of a second.
"""

from collections.abc import Callable

import numpy as np

from l1slam_ros.core.choice import INTERIOR_POINT, PRIMAL_DUAL, choose, minimise_by
from l1slam_ros.core.l2 import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.optimiser import OptimiserOptions
from l1slam_ros.core.prediction import innovations, sample_posterior
from l1slam_ros.core.robust import robust_solve
from l1slam_ros.core.seed import seed_poses
from l1slam_ros.core.simulate import WorldOptions, simulate_world

STEPS = ('ordering', 'least squares', 'seed', 'interior point', 'primal-dual',
         'robust solve')


def warm_up(report: Callable[[str], None] = lambda step: None) -> None:
    """Make all loops ready; report : called with each of `STEPS` as it is done."""
    world = simulate_world(12, 24, WorldOptions(), np.random.default_rng(0))
    graph, poses = world.graph, world.odometry
    choice = choose(INTERIOR_POINT, graph)
    report(STEPS[0])
    assert choice.cholesky is not None
    minimise_l2(graph, poses, LeastSquaresOptions(), choice.cholesky)
    report(STEPS[1])
    seed_poses(graph, choice.cholesky)
    report(STEPS[2])
    minimise_by(choice, graph, poses, OptimiserOptions())
    report(STEPS[3])
    seed_poses(graph, None)
    minimise_by(choose(PRIMAL_DUAL, graph), graph, poses, OptimiserOptions(outer_iterations=1))
    report(STEPS[4])
    robust_solve(graph)
    # A graph as small as this one has no loops that only together can be believed.
    posterior = sample_posterior(graph, poses, choice.cholesky, np.random.default_rng(0))
    innovations(graph, poses, posterior, 0.0).joint(posterior, np.array([0]), np.array([1]))
    report(STEPS[5])
