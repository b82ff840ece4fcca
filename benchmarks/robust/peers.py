# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
gtsam's robust solvers: Levenberg-Marquardt with a kernel, GNC, ISAM2 with a kernel.

Kernels are on the loops alone, the odometry of the graph is not doubted, and GNC is told that it
need not be. Graphs are built before the clock starts. None but GNC says which loops it believes,
so for all of them a loop counts as kept when the map that comes out agrees with it: see `runs`.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from measuring import clock
from robust.solvers import LOOK, Found, RobustSolver
from solvers.graph_peers import PRIOR_SIGMA, gtsam_values, information_of
from solvers.graph_solvers import MOST_ITERATIONS, SAME_TOLERANCE

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph

# Each kernel at some parameters [sigma, for DCS sigma^2]: 1 is the one that its authors give.
KERNELS = {**{f'DCS {phi:g}': ('DCS', phi) for phi in (1.0, 10.0, 100.0)},
           **{f'GM {sigma:g}': ('GemanMcClure', sigma) for sigma in (1.0, 3.0, 10.0)}}
# GNC takes a loop for an outlier beyond such a quantile of chi2; its authors have the first.
QUANTILES = {'GNC 0.99': 0.99, 'GNC 0.999': 0.999}
# [m or rad] ISAM2 linearises again what has moved by more, after each pose.
_RELINEARISE = 0.01


def _noises(graph: FactorGraph, kernel: str | None) -> list[Any]:
    """Return gtsam's noise of each between factor, with the kernel where it is a loop."""
    import gtsam

    kernels, noises = gtsam.noiseModel.mEstimator, gtsam.noiseModel
    robust = None
    if kernel:
        name, parameter = KERNELS[kernel]
        robust = getattr(kernels, name).Create(parameter)
    plain = [noises.Gaussian.Information(each) for each in information_of(graph)]
    if robust is None:
        return plain
    return [noise if sure else noises.Robust.Create(robust, noise)
            for noise, sure in zip(plain, graph.between.is_odometry.tolist(), strict=True)]


def _factors(graph: FactorGraph, kernel: str | None) -> list[Any]:
    import gtsam

    factors = graph.between
    return [gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*z), noise) for i, j, z, noise in zip(
        factors.i.tolist(), factors.j.tolist(), factors.measurement.tolist(),
        _noises(graph, kernel), strict=True)]


def _prior(pose: Array) -> Any:
    import gtsam

    tight = gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)
    return gtsam.PriorFactorPose2(0, gtsam.Pose2(*pose), tight)


def _graph(graph: FactorGraph, poses: Array, kernel: str | None) -> Any:
    import gtsam

    built = gtsam.NonlinearFactorGraph()
    for factor in _factors(graph, kernel):
        built.add(factor)
    built.add(_prior(poses[0]))
    return built


def _parameters() -> Any:
    import gtsam

    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(SAME_TOLERANCE)
    options.setMaxIterations(MOST_ITERATIONS)
    return options


def _timed(optimise: Callable[[], Any]) -> Found:
    import gtsam

    began = clock()
    values = optimise()
    seconds = clock() - began
    return Found(np.array(gtsam.utilities.extractPose2(values)), seconds)


def _by_kernel(kernel: str) -> Callable[[FactorGraph, Array], Found]:
    def solve(graph: FactorGraph, poses: Array) -> Found:
        import gtsam

        built, values = _graph(graph, poses, kernel), gtsam_values(poses)
        return _timed(lambda: gtsam.LevenbergMarquardtOptimizer(
            built, values, _parameters()).optimize())

    return solve


def _by_gnc(quantile: float) -> Callable[[FactorGraph, Array], Found]:
    """Solve by graduated non-convexity, truncated least squares, from L2 on all loops."""

    def solve(graph: FactorGraph, poses: Array) -> Found:
        import gtsam

        built, values = _graph(graph, poses, None), gtsam_values(poses)
        options = gtsam.GncLMParams(_parameters())
        options.setLossType(gtsam.GncLossType.TLS)
        sure = [*np.flatnonzero(graph.between.is_odometry).tolist(), len(graph.between)]
        options.setKnownInliers(sure)

        def optimise() -> Any:
            gnc = gtsam.GncLMOptimizer(built, values, options)
            gnc.setInlierCostThresholdsAtProbability(quantile)
            return gnc.optimize()

        return _timed(optimise)

    return solve


def _isam2(kernel: str) -> Callable[[FactorGraph, Array], Found]:
    def drive(graph: FactorGraph, poses: Array) -> Found:
        """Add pose by pose, each with the factors that end there."""
        import gtsam

        options = gtsam.ISAM2Params()
        options.setRelinearizeThreshold(_RELINEARISE)
        options.relinearizeSkip = 1
        isam, at = gtsam.ISAM2(options), gtsam.Pose2()
        maps, seconds = [], 0.0
        for k, (new, step) in enumerate(_by_time(graph, kernel)):
            values = gtsam.Values()
            values.insert(k, at.compose(step))
            began = clock()
            isam.update(new, values)
            at = isam.calculateEstimatePose2(k)
            seconds += clock() - began
            if (k + 1) % LOOK == 0:
                maps.append(_map(isam))
        return Found(_map(isam), seconds, maps=tuple(maps))

    return drive


def _by_time(graph: FactorGraph, kernel: str) -> Iterator[tuple[Any, Any]]:
    """Yield, for each pose, the factors that end there, and its odometry."""
    import gtsam

    factors = graph.between
    built, ends = _factors(graph, kernel), np.maximum(factors.i, factors.j)
    forward = factors.i < factors.j
    order = np.argsort(ends, kind='stable')
    borders = np.searchsorted(ends[order], np.arange(1, graph.n_poses))
    for k, rows in enumerate(np.split(order, borders)):
        new, step = gtsam.NonlinearFactorGraph(), gtsam.Pose2()
        if not k:
            new.add(_prior(np.zeros(3)))
        for row in rows.tolist():
            new.add(built[row])
            if factors.is_odometry[row]:
                measured = gtsam.Pose2(*factors.measurement[row])
                step = measured if forward[row] else measured.inverse()
        yield new, step


def _map(isam: Any) -> Array:
    import gtsam

    poses: Array = np.array(gtsam.utilities.extractPose2(isam.calculateEstimate()))
    return poses


_METHODS = {**{name: _by_gnc(quantile) for name, quantile in QUANTILES.items()},
            **{name: _by_kernel(name) for name in KERNELS}}
PEERS = (
    *(RobustSolver(f'gtsam {name} from {start}', 'l2', start, solve)
      for name, solve in _METHODS.items() for start in ('odometry', 'seed', 'stored')),
    *(RobustSolver(f'ISAM2 {name}', 'l2', 'odometry', _isam2(name), online=True)
      for name in ('DCS 1', 'GM 1', 'GM 3')),
)
