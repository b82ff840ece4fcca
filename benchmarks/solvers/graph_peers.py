# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
gtsam and g2o on whole pose graphs, g2o in the plane alone.

Their graphs are built before the clock starts; ordering and everything else of the optimisation
is counted. All stop at the same relative decrease. gtsam's residual is Log(e), ours and g2o's is
t2v(e): the optima differ by less than the digits shown.

gtsam's L1 is by reweighting: plain Gauss-Newton, then Huber's kernel, whose weight is k / |e| for
each whitened component beyond k ("Scalar" reweighting: the L1 cost is a sum over components, not
over factors), with smaller and smaller k. Twice: four kernels, each to the tolerance of all the
others; and a dozen kernels of two steps each, the best ladder we found for little time.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import Answer, clock, timed
from solvers.cases import Case
from solvers.graph_solvers import MOST_ITERATIONS, SAME_TOLERANCE, GraphSolver

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph

# [sigma] Huber's k, and how many steps at each, at most.
_CONVERGED = (1.0, 0.1, 0.01, 0.001), MOST_ITERATIONS
_QUICK = tuple(0.3 / 2**k for k in range(12)), 2
# [m, rad] gtsam holds the first pose by a prior this tight.
PRIOR_SIGMA = 1e-6


def information_of(graph: FactorGraph) -> Array:
    """Return the information of the between factors, (m, d, d)."""
    root = graph.between.sqrt_information
    product: Array = root.transpose(0, 2, 1) @ root
    return product


def _gtsam_graph(graph: FactorGraph, poses: Array, kernel: float | None = None) -> Any:
    """Return gtsam's graph; kernel : Huber's k, on each whitened component."""
    import gtsam

    kernels, manifold = gtsam.noiseModel.mEstimator, graph.manifold
    # Its steps in space have the rotation first.
    order = np.arange(manifold.TANGENT_SIZE)
    if manifold is se3:
        order = np.concatenate((order[manifold.ROTATION], order[manifold.TRANSLATION]))
    between = gtsam.BetweenFactorPose3 if manifold is se3 else gtsam.BetweenFactorPose2
    prior = gtsam.PriorFactorPose3 if manifold is se3 else gtsam.PriorFactorPose2
    factors, built = graph.between, gtsam.NonlinearFactorGraph()
    scalar = kernels.Base.ReweightScheme.Scalar
    robust = kernels.Huber.Create(kernel, scalar) if kernel else None
    for i, j, z, information in zip(factors.i.tolist(), factors.j.tolist(),
                                    factors.measurement.tolist(), information_of(graph),
                                    strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information[np.ix_(order, order)])
        if robust:
            noise = gtsam.noiseModel.Robust.Create(robust, noise)
        built.add(between(i, j, _gtsam_pose(z), noise))
    tight = gtsam.noiseModel.Isotropic.Sigma(len(order), PRIOR_SIGMA)
    built.add(prior(0, _gtsam_pose(poses[0].tolist()), tight))
    return built


def _gtsam_pose(pose: list[float]) -> Any:
    import gtsam

    if len(pose) == se2.POSE_SIZE:
        return gtsam.Pose2(*pose)
    x, y, z, w = pose[3:]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


def gtsam_values(poses: Array) -> Any:
    """Return poses (n, p) as gtsam's, keys 0 to n - 1."""
    import gtsam

    values = gtsam.Values()
    for k, pose in enumerate(poses.tolist()):
        values.insert(k, _gtsam_pose(pose))
    return values


def _gtsam_answer(work: Callable[[], Any]) -> Answer:
    """Time the optimisation; reading the poses back is not counted."""
    import gtsam

    began = clock()
    values = work()
    seconds = clock() - began
    poses = np.array(gtsam.utilities.extractPose2(values))
    if not len(poses):
        R, t = np.split(np.array(gtsam.utilities.extractPose3(values)), [9], axis=1)
        poses = se3.from_rotation(R.reshape(-1, 3, 3), t)
    return Answer(poses, seconds)


def _gtsam_by(optimiser: str, parameters: str,
              ordering: str = 'COLAMD') -> Callable[[Case, Array], Callable[[], Answer]]:
    def prepare(case: Case, poses: Array) -> Callable[[], Answer]:
        import gtsam

        graph, values = _gtsam_graph(case.graph, poses), gtsam_values(poses)
        options = getattr(gtsam, parameters)()
        options.setRelativeErrorTol(SAME_TOLERANCE)
        options.setMaxIterations(MOST_ITERATIONS)
        options.setOrderingType(ordering)
        make = getattr(gtsam, optimiser)
        return lambda: _gtsam_answer(lambda: make(graph, values, options).optimize())

    return prepare


def _gtsam_l1(kernels: tuple[float, ...],
              steps: int) -> Callable[[Case, Array], Callable[[], Answer]]:
    def prepare(case: Case, poses: Array) -> Callable[[], Answer]:
        import gtsam

        values = gtsam_values(poses)
        graphs = [_gtsam_graph(case.graph, poses, kernel) for kernel in (None, *kernels)]
        options = gtsam.GaussNewtonParams()
        options.setRelativeErrorTol(SAME_TOLERANCE)

        def work() -> Any:
            at = values
            for k, graph in enumerate(graphs):
                options.setMaxIterations(steps if k else MOST_ITERATIONS)
                at = gtsam.GaussNewtonOptimizer(graph, at, options).optimize()
            return at

        return lambda: _gtsam_answer(work)

    return prepare


def _gtsam_lago(case: Case, poses: Array) -> Callable[[], Answer]:
    """Initialise by LAGO, then Gauss-Newton; the poses only tell where the first one is."""
    import gtsam

    graph = _gtsam_graph(case.graph, poses)
    return lambda: _gtsam_answer(lambda: gtsam.GaussNewtonOptimizer(
        graph, gtsam.lago.initialize(graph)).optimize())


def _g2o_by(algorithm: str) -> Callable[[Case, Array], Callable[[], Answer]]:
    def prepare(case: Case, poses: Array) -> Callable[[], Answer]:
        import g2opy as g2o

        optimiser, stop = _g2o_graph(case.graph, poses, algorithm)
        # The optimiser does not keep its action alive.
        optimiser.add_post_iteration_action(stop)
        vertices = [optimiser.vertex(k) for k in range(len(poses))]
        starts = [g2o.SE2(*pose) for pose in poses.tolist()]

        def work() -> Array:
            stop.set_gain_threshold(SAME_TOLERANCE)
            optimiser.initialize_optimization()
            optimiser.optimize(MOST_ITERATIONS)
            return np.zeros(0)

        def run() -> Answer:
            for vertex, start in zip(vertices, starts, strict=True):
                vertex.set_estimate(start)
            seconds = timed(work).seconds
            return Answer(np.array([vertex.estimate().to_vector() for vertex in vertices]),
                          seconds)

        return run

    return prepare


def _g2o_graph(graph: FactorGraph, poses: Array, algorithm: str) -> tuple[Any, Any]:
    """Return g2o's optimiser, with the only direct sparse solver of its wheel, and its stop."""
    import g2opy as g2o

    optimiser = g2o.SparseOptimizer()
    optimiser.set_verbose(False)
    blocks = g2o.BlockSolverSE2(g2o.LinearSolverEigenSE2())
    optimiser.set_algorithm(getattr(g2o, f'OptimizationAlgorithm{algorithm}')(blocks))
    for k, pose in enumerate(poses.tolist()):
        vertex = g2o.VertexSE2()
        vertex.set_id(k)
        vertex.set_estimate(g2o.SE2(*pose))
        vertex.set_fixed(k == 0)
        optimiser.add_vertex(vertex)
    factors = graph.between
    for i, j, z, information in zip(factors.i.tolist(), factors.j.tolist(),
                                    factors.measurement.tolist(), information_of(graph),
                                    strict=True):
        edge = g2o.EdgeSE2()
        edge.set_vertex(0, optimiser.vertex(i))
        edge.set_vertex(1, optimiser.vertex(j))
        edge.set_measurement(g2o.SE2(*z))
        edge.set_information(information)
        optimiser.add_edge(edge)
    stop = g2o.SparseOptimizerTerminateAction()
    stop.set_max_iterations(MOST_ITERATIONS)
    return optimiser, stop


def gauss_newton_by(ordering: str) -> GraphSolver:
    """Return gtsam's Gauss-Newton by METIS or COLAMD."""
    return GraphSolver(f'gtsam, L2 Gauss-Newton, {ordering}', _gtsam_by(
        'GaussNewtonOptimizer', 'GaussNewtonParams', ordering))


# What the ratios of the whole solves are to.
GAUSS_NEWTON = GraphSolver(
    'gtsam, L2 Gauss-Newton', _gtsam_by('GaussNewtonOptimizer', 'GaussNewtonParams'))
IN_SPACE = (
    GAUSS_NEWTON,
    gauss_newton_by('METIS'),
    GraphSolver('gtsam, L2 Levenberg-Marquardt',
                _gtsam_by('LevenbergMarquardtOptimizer', 'LevenbergMarquardtParams')),
    GraphSolver('gtsam, L1 by reweighting', _gtsam_l1(*_CONVERGED)),
    GraphSolver('gtsam, L1 by reweighting, quick', _gtsam_l1(*_QUICK)),
)
PEERS = (
    *IN_SPACE,
    GraphSolver('g2o, L2 Gauss-Newton', _g2o_by('GaussNewton')),
    GraphSolver('g2o, L2 Levenberg-Marquardt', _g2o_by('Levenberg')),
)
LAGO = GraphSolver('gtsam, LAGO and L2 Gauss-Newton', _gtsam_lago)
