# SPDX-License-Identifier: Apache-2.0
"""
Algorithm 3: first poses by two convex L1 problems, from the graph alone.

In: a factor graph. Out: poses from which Algorithm 4 finds the optimum. The whitened residual's
rotation rows involve the rotations alone (see `noise`), so they are solved first; with the
rotations fixed, the remaining rows are linear in the translations.
"""

from collections.abc import Callable

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import LinearProblem
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    linearise,
    step_poses,
    whitened_residual,
)
from l1slam_ros.core.graph.spanning_tree import odometry_poses, tree_poses
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.interior_point import interior_point
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

# The paper takes 1,000 iterations or more of each; by factorisations it is some ten steps.
SEED_OPTIONS = PrimalDualOptions(iterations=2000, tolerance=1e-3)
# Rounds of re-wrapping the angles; measured: 1 to 6 until the cost stops falling.
_MOST_ROUNDS = 10
# [sigma] A residual that departs that little from its linearisation is not wrapped anew.
_SAME = 1e-6


def seed_poses(
    graph: FactorGraph, cholesky: BlockCholesky | None,
    options: PrimalDualOptions = SEED_OPTIONS, check: Callable[[], None] = lambda: None,
) -> Array:
    """
    Return the poses of Algorithm 3, (n, p).

    Angles wrap, so the first problem needs a reference to unwrap against. Three are tried, none
    of them a stored pose: the odometry chain and two breadth-first trees; the lowest cost wins.

    Parameters
    ----------
    cholesky : of the graph; None: by the primal-dual method alone
    check : called on the way, raises where the work shall stop

    """
    references = [tree_poses(graph, 0), tree_poses(graph, graph.n_poses // 2)]
    if graph.between.is_odometry.sum() == graph.n_poses - 1:
        references.insert(0, odometry_poses(graph))
    references = [placed(graph, poses) for poses in references]
    candidates: list[Array] = []
    for k, reference in enumerate(references):
        # Two references that unwrap every factor alike lead to one and the same problem.
        if not any(_unwrap_alike(graph, reference, other) for other in references[:k]):
            candidates.append(_solve_rotations(graph, reference, cholesky, options, check))
    poses = min(candidates, key=lambda poses: _rotation_cost(graph, poses))
    system = translation_system(graph, poses)
    x = _minimise(system, cholesky, options, check)
    return _moved(graph, poses, x, graph.manifold.TRANSLATION)


def rotation_system(graph: FactorGraph, poses: Array) -> LinearSystem:
    """Return the first convex problem of Algorithm 3: the rotations, unwrapped as at `poses`."""
    return linearise(graph, poses).part(graph.manifold.ROTATION)


def translation_system(graph: FactorGraph, poses: Array) -> LinearSystem:
    """Return the second convex problem of Algorithm 3: the translations, rotations as they are."""
    return linearise(graph, poses).part(graph.manifold.TRANSLATION)


def _solve_rotations(graph: FactorGraph, poses: Array, cholesky: BlockCholesky | None,
                     options: PrimalDualOptions, check: Callable[[], None]) -> Array:
    """Solve for the rotations, re-wrapped against the last solution while the cost falls."""
    cost = _rotation_cost(graph, poses)
    for _ in range(_MOST_ROUNDS):
        system = rotation_system(graph, poses)
        x = _minimise(system, cholesky, options, check)
        candidate = _moved(graph, poses, x, graph.manifold.ROTATION)
        candidate_cost = _rotation_cost(graph, candidate)
        if candidate_cost >= cost:
            break
        poses, cost = candidate, candidate_cost
        if _is_same(system.times(x) - system.b, _rotation_residual(graph, poses)):
            break
    return poses


def _minimise(system: LinearSystem, cholesky: BlockCholesky | None,
              options: PrimalDualOptions, check: Callable[[], None]) -> Array:
    """Return argmin |A x - b|_1 of one of the two convex problems."""
    check()
    if cholesky is None:
        start = np.zeros(system.size * system.block_size), np.zeros(len(system.b))
        return minimise_l1_halpern(system, *start, options).x
    x = weighted_least_squares(system, cholesky, np.ones(len(system.b)))
    return interior_point(LinearProblem(system), x, cholesky, options.iterations,
                          options.tolerance, lambda *_: check()).poses


def _unwrap_alike(graph: FactorGraph, poses: Array, others: Array) -> bool:
    """Tell whether the rotation problems at two sets of poses are one and the same."""
    fixed, part = anchor(graph), graph.manifold.ROTATION
    apart = graph.manifold.local(poses, others)[fixed:, part].ravel()
    system = rotation_system(graph, poses)
    return _is_same(system.times(apart) - system.b, _rotation_residual(graph, others))


def _is_same(predicted: Array, residual: Array) -> bool:
    return float(np.abs(predicted - residual).max(initial=0.0)) < _SAME


def _moved(graph: FactorGraph, poses: Array, x: Array, part: slice) -> Array:
    """Return the poses after a step of this part of the tangent alone."""
    step = np.zeros((graph.n_poses - anchor(graph), graph.manifold.TANGENT_SIZE))
    step[:, part] = x.reshape(len(step), -1)
    return step_poses(graph, poses, step)


def _rotation_residual(graph: FactorGraph, poses: Array) -> Array:
    rows = whitened_residual(graph, poses).reshape(-1, graph.manifold.TANGENT_SIZE)
    return rows[:, graph.manifold.ROTATION].ravel()


def _rotation_cost(graph: FactorGraph, poses: Array) -> float:
    return l1_cost(_rotation_residual(graph, poses))
