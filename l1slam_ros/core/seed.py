# SPDX-License-Identifier: Apache-2.0
"""
Algorithm 3: first poses by two convex L1 problems, from the graph alone.

In: a factor graph. Out: poses from which Algorithm 4 finds the optimum. The whitened residual's
rotation rows involve the rotations alone (see `noise`), so they are solved first; with the
rotations fixed, the remaining rows are linear in the translations.
"""

import numpy as np
from scipy.sparse import csr_array

from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.initial import odometry_poses, tree_poses
from l1slam_ros.core.least_squares import reweighted_start
from l1slam_ros.core.linearise import linearise, step_poses, whitened_residual
from l1slam_ros.core.manifold import Array
from l1slam_ros.core.optimality import l1_cost
from l1slam_ros.core.primal_dual import PrimalDualOptions, minimise_l1

# The paper takes 1,000 iterations or more of each; these start near the optimum.
SEED_OPTIONS = PrimalDualOptions(iterations=1000, tolerance=1e-5)
# Rounds of re-wrapping the angles; measured: 1 to 6 until the cost stops falling.
_MOST_ROUNDS = 10


def seed_poses(graph: FactorGraph, options: PrimalDualOptions = SEED_OPTIONS) -> Array:
    """
    Return the poses of Algorithm 3, (n, p).

    Angles wrap, so the first problem needs a reference to unwrap against. Three are tried, none
    of them a stored pose: the odometry chain and two breadth-first trees; the lowest cost wins.
    """
    references = [tree_poses(graph, 0), tree_poses(graph, graph.n_poses // 2)]
    if graph.between.is_odometry.sum() == graph.n_poses - 1:
        references.insert(0, odometry_poses(graph))
    candidates = [_solve_rotations(graph, poses, options) for poses in references]
    poses = min(candidates, key=lambda poses: _rotation_cost(graph, poses))
    return _solve_part(graph, poses, graph.manifold.TRANSLATION, options)


def _solve_rotations(graph: FactorGraph, poses: Array, options: PrimalDualOptions) -> Array:
    """Solve for the rotations, re-wrapped against the last solution while the cost falls."""
    cost = _rotation_cost(graph, poses)
    for _ in range(_MOST_ROUNDS):
        candidate = _solve_part(graph, poses, graph.manifold.ROTATION, options)
        candidate_cost = _rotation_cost(graph, candidate)
        if candidate_cost >= cost:
            break
        falls = cost - candidate_cost > options.tolerance * cost
        poses, cost = candidate, candidate_cost
        if not falls:
            break
    return poses


def _solve_part(
    graph: FactorGraph, poses: Array, part: slice, options: PrimalDualOptions
) -> Array:
    """Move only the `part` of the tangent space that minimises the L1 norm of its own rows."""
    system = linearise(graph, poses)
    rows, columns = (_entries(graph, n, part) for n in system.A.shape)
    A: csr_array = system.A[rows][:, columns].tocsr()
    b = system.b[rows]
    solution = minimise_l1(A, b, *reweighted_start(A, b), options)
    step = np.zeros(system.A.shape[1])
    step[columns] = solution.x
    return step_poses(graph, poses, step)


def _rotation_cost(graph: FactorGraph, poses: Array) -> float:
    residual = whitened_residual(graph, poses)
    return l1_cost(residual[_entries(graph, len(residual), graph.manifold.ROTATION)])


def _entries(graph: FactorGraph, length: int, part: slice) -> np.ndarray:
    """Return the positions of the `part` of each tangent vector in a stack of them."""
    return np.arange(length).reshape(-1, graph.manifold.TANGENT_SIZE)[:, part].ravel()
