# SPDX-License-Identifier: Apache-2.0
"""
What nobody could tell: true loops that look like chance to one who knows all the others.

In: a case whose odometry is noisier than it says. Out: the part of its true loops whose residual,
given every other true loop and the noise as it is, is not likely enough to be no coincidence. Who
knows less can only do worse, so where this is above a bar, the bar cannot be reached.
"""

import numpy as np
from robust_cases import FalseCase
from robust_kinds import NOISIER

from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import (
    claimed_volume,
    log_likelihood_ratio,
    sample_posterior,
)
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2


def undecidable(case: FalseCase) -> float:
    """Return that part, of the clean graph of a kind of `NOISIER`."""
    rng, factors = np.random.default_rng(case.seed), case.clean.between
    is_loop, rows = ~factors.is_odometry, np.arange(len(factors))
    # The loops are as noisy as they are in the public graph.
    loops = robust_solve(case.place.graph)[0].variance[1]
    graph = case.clean.subset(rows, np.where(is_loop, loops, NOISIER[case.kind] ** 2))
    cholesky = cholesky_of(graph)
    poses = minimise_l2(graph, case.place.best, LeastSquaresOptions(), cholesky).poses
    posterior = sample_posterior(graph, poses, cholesky, rng)
    # With the covariance R of a residual, R^-1 is that of the innovation of what is left out.
    log_det = -np.linalg.slogdet(posterior.moment[is_loop])[1]
    roots = np.diagonal(graph.between.sqrt_information[is_loop], axis1=1, axis2=2)
    claim = claimed_volume(graph.manifold, poses, rng) + np.log(roots).sum(axis=1)
    log_ratio = log_likelihood_ratio(posterior.left_out()[is_loop], log_det, claim,
                                     graph.manifold.TANGENT_SIZE)
    return float((log_ratio < np.log(1 / DOUBT - 1)).mean())
