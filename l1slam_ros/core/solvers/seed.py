# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Algorithm 3: initial poses by two convex L1 problems, from the graph alone.

In: a factor graph. Out: poses from which Algorithm 4 finds the optimum. The whitened residual's
rotation rows involve the rotations alone (see `noise`), so they are solved first; with the
rotations fixed, the remaining rows are linear in the translations.

Rotations turn in circles, so the first problem is convex near a reference only, and in space only
to first order: it is solved again from its solution while the cost falls. The best reference is
the chordal relaxation in L2, one linear solve: rotation matrices with R_j = R_i Z_ij as well as
may be, as if they were any matrices, then the nearest rotations.

Source: Martinec and Pajdla, "Robust rotation and translation estimation" (2007) for the
relaxation; Chatterjee and Govindu, "Efficient and robust large-scale rotation averaging" (2013)
for the repeated L1 problem.

A large graph that is clean needs none of it (`first_poses`): the L2 map, to which the relaxation
leads, is a start as good, and so are poses near it.
"""

from collections.abc import Callable

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.l1_problem import LinearProblem
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    ends,
    keyframes_of,
    linearise,
    step_part,
    whitened_residual,
)
from l1slam_ros.core.graph.spanning_tree import odometry_poses, tree_poses
from l1slam_ros.core.graph.world_frame import placed
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.gauss_newton import FITS, ROUGH_L2, linear_step, minimise_l2, spare
from l1slam_ros.core.solvers.interior_point import interior_point
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost
from l1slam_ros.core.solvers.primal_dual import PrimalDualOptions
from l1slam_ros.core.solvers.restarted_pdhg import minimise_l1_halpern
from l1slam_ros.core.solvers.reweighting import weighted_least_squares

# The paper takes 1,000 iterations or more of each; by factorisations it is some ten steps.
_OPTIONS = PrimalDualOptions(iterations=2000, tolerance=1e-3)
# Rounds until the cost stops falling; measured: 1 to 6. A step is halved so often.
_MOST_ROUNDS, _HALVINGS = 10, 6
# A reference whose cost is that much above the best one's leads nowhere else.
_NEAR = 1.5
# [sigma] A residual that departs that little from its linearisation is not wrapped anew.
_SAME = 1e-6
# From so many rows on a seed takes seconds. Below, where graphs start is as it ever was.
_MANY_ROWS = 100_000
# A clean graph: a map near that of L2 fits to within the noise (see `gauss_newton.l2_optimum`),
# and no residual is larger than so many times their root mean square. Of normal noise the largest
# of ten million is 5.5; of lies that are few among many loops one is 16 or more. And rotations are
# off [rad] by no more in the mean square: beyond twice that, L1 often has another optimum nearby,
# and which of both is better is a matter of luck.
_LARGEST, _TURNED = 8.0, 0.1


def seed_poses(graph: FactorGraph, cholesky: BlockCholesky | None,
               check: Callable[[], None] = lambda: None, chordal: Array | None = None) -> Array:
    """
    Return the poses of Algorithm 3, (n, p).

    The rotations are solved for from the best of three references, none of them a stored pose, and
    from every other one that is nearly as good; the lowest cost wins.

    Parameters
    ----------
    cholesky : of the graph; None: by the primal-dual method alone
    check : called on the way, raises where the work shall stop
    chordal : see `chordal_poses`, if the caller has them; None: they are found here

    """
    references = [placed(graph, poses) for poses in _references(graph, cholesky, chordal)]
    costs = [_rotation_cost(graph, poses) for poses in references]
    order = [k for k in np.argsort(costs, kind='stable') if costs[k] <= _NEAR * min(costs)]
    candidates: list[Array] = []
    for place, k in enumerate(order):
        # Two references that unwrap every factor alike lead to one and the same problem.
        if not any(_unwrap_alike(graph, references[k], references[other])
                   for other in order[:place]):
            candidates.append(_solve_rotations(graph, references[k], cholesky, check))
    poses = min(candidates, key=lambda poses: _rotation_cost(graph, poses))
    system = translation_system(graph, poses)
    x = _minimise(system, cholesky, check)
    return step_part(graph, poses, x, graph.manifold.TRANSLATION)


def first_poses(graph: FactorGraph, cholesky: BlockCholesky) -> Array:
    """
    Return poses to start from, (n, p): Algorithm 3's, or near the L2 map of a large clean graph.

    Arguments as those of `seed_poses`.
    """
    chordal = None
    if _is_large(graph):
        chordal = chordal_poses(graph, cholesky)
        poses = None if chordal is None else _clean_map(graph, chordal, cholesky)
        if poses is not None:
            return poses
    return seed_poses(graph, cholesky, chordal=chordal)


def _clean_map(graph: FactorGraph, chordal: Array, cholesky: BlockCholesky) -> Array | None:
    """Return poses (n, p) near the L2 map, by `chordal_poses`; None: the graph is not clean."""
    poses = linear_step(graph, placed(graph, chordal), cholesky, graph.manifold.TRANSLATION)
    if not _is_clean(graph, poses):
        poses = minimise_l2(graph, poses, ROUGH_L2, cholesky).poses
    return poses if _is_clean(graph, poses) else None


def is_near(graph: FactorGraph, poses: Array) -> bool:
    """
    Tell whether poses (n, p) of a large graph lie within one step of its L2 map.

    They do where all fits to within the noise.
    """
    return _is_large(graph) and _is_clean(graph, poses)


def _is_large(graph: FactorGraph) -> bool:
    return len(graph.between) * graph.manifold.TANGENT_SIZE > _MANY_ROWS


def _is_clean(graph: FactorGraph, poses: Array) -> bool:
    """
    Tell whether all factors agree on poses (n, p) to within the noise.

    Where rotations end a turn off, or loops lie, some residuals are out of all proportion.
    """
    whitened = whitened_residual(graph, poses)
    chi2 = l2_cost(whitened)
    turns = graph.manifold.residual(graph.between.measurement, *ends(graph, poses))[
        :, graph.manifold.ROTATION]
    return bool(chi2 <= FITS * spare(graph)
                and np.abs(whitened).max() <= _LARGEST * np.sqrt(chi2 / len(whitened))
                and (turns**2).mean() <= _TURNED**2)


def _references(graph: FactorGraph, cholesky: BlockCholesky | None,
                chordal: Array | None) -> list[Array]:
    """Return poses from which the rotations may be found, (n, p) each, the likeliest first."""
    if chordal is None and cholesky is not None:
        chordal = chordal_poses(graph, cholesky)
    first = tree_poses(graph, graph.n_poses // 2) if chordal is None else chordal
    references = [first, tree_poses(graph, 0)]
    if graph.between.is_odometry.sum() == graph.n_poses - 1:
        references.append(odometry_poses(graph))
    return references


def chordal_poses(graph: FactorGraph, cholesky: BlockCholesky) -> Array | None:
    """
    Return the rotations of the chordal relaxation in L2, (n, p), positions zero.

    The rows r of the matrices R are found each by the same system, r_j = Z_ij' r_i of each factor,
    as sure as it is of its rotation. None: that is singular.
    """
    manifold = graph.manifold
    factors = graph.between
    fixed = anchor(graph)
    part = manifold.ROTATION
    Z_t = np.swapaxes(manifold.rotation(factors.measurement), 1, 2)
    m = len(factors)
    k = Z_t.shape[1]
    size = graph.n_poses - fixed
    blocks = np.empty((m, 2, k, k))
    blocks[:, 0], blocks[:, 1] = -Z_t, np.eye(k)
    keyframe = keyframes_of(graph, fixed)
    system = LinearSystem(keyframe, blocks, np.zeros(m * k), size)
    weights = (factors.sqrt_information[:, part, part] ** 2).mean(axis=(1, 2))
    if not cholesky.factorise(system, np.repeat(weights, k)):
        return None
    # What is held fixed has R = I.
    held = (keyframe == size).any(axis=1)
    at, part_of = keyframe[held], blocks[held]
    known = -(part_of * (at == size)[:, :, None, None]).sum(axis=1)
    right = np.zeros((size + 1, k, k))
    for side in range(2):
        np.add.at(right, at[:, side], weights[held, None, None]
                  * (np.swapaxes(part_of[:, side], 1, 2) @ known))
    R = np.tile(np.eye(k), (graph.n_poses, 1, 1))
    for row in range(k):
        R[fixed:, row] = cholesky.solve(right[:size, :, row].ravel()).reshape(size, k)
    U, _, Vt = np.linalg.svd(R)
    U[:, :, -1] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return manifold.from_rotation(U @ Vt, np.zeros((graph.n_poses, k)))


def rotation_system(graph: FactorGraph, poses: Array) -> LinearSystem:
    """Return the first convex problem of Algorithm 3: the rotations, unwrapped as at `poses`."""
    return linearise(graph, poses).part(graph.manifold.ROTATION)


def translation_system(graph: FactorGraph, poses: Array) -> LinearSystem:
    """Return the second convex problem of Algorithm 3: the translations, rotations as they are."""
    return linearise(graph, poses).part(graph.manifold.TRANSLATION)


def _solve_rotations(graph: FactorGraph, poses: Array, cholesky: BlockCholesky | None,
                     check: Callable[[], None]) -> Array:
    """Solve for the rotations, from the last solution anew while the cost falls."""
    cost = _rotation_cost(graph, poses)
    for _ in range(_MOST_ROUNDS):
        system = rotation_system(graph, poses)
        x = _minimise(system, cholesky, check)
        before = cost
        poses, cost, length = _lowered(graph, poses, x, cost)
        # Where rotations wrap and are else linear, a solution may be exact.
        if not length or before - cost <= _OPTIONS.tolerance * cost or _is_same(
                length * system.times(x) - system.b, _rotation_residual(graph, poses)):
            break
    return poses


def _lowered(graph: FactorGraph, poses: Array, x: Array,
             cost: float) -> tuple[Array, float, float]:
    """Return poses, cost and length of the longest of x, x/2, ... that lowers it; 0: none."""
    for halvings in range(_HALVINGS):
        candidate = step_part(graph, poses, x / 2**halvings, graph.manifold.ROTATION)
        candidate_cost = _rotation_cost(graph, candidate)
        if candidate_cost < cost:
            return candidate, candidate_cost, 0.5**halvings
    return poses, cost, 0.0


def _minimise(system: LinearSystem, cholesky: BlockCholesky | None,
              check: Callable[[], None]) -> Array:
    """Return argmin |A x - b|_1 of one of the two convex problems."""
    check()
    if cholesky is None:
        start = np.zeros(system.size * system.block_size), np.zeros(len(system.b))
        return minimise_l1_halpern(system, *start, _OPTIONS).x
    x = weighted_least_squares(system, cholesky, np.ones(len(system.b)))
    return interior_point(LinearProblem(system), x, cholesky, _OPTIONS.iterations,
                          _OPTIONS.tolerance, lambda *_: check()).poses


def _unwrap_alike(graph: FactorGraph, poses: Array, others: Array) -> bool:
    """Tell whether the rotation problems at two sets of poses are the same."""
    fixed = anchor(graph)
    part = graph.manifold.ROTATION
    apart = graph.manifold.local(poses, others)[fixed:, part].ravel()
    system = rotation_system(graph, poses)
    return _is_same(system.times(apart) - system.b, _rotation_residual(graph, others))


def _is_same(predicted: Array, residual: Array) -> bool:
    return float(np.abs(predicted - residual).max(initial=0.0)) < _SAME


def _rotation_residual(graph: FactorGraph, poses: Array) -> Array:
    rows = whitened_residual(graph, poses).reshape(-1, graph.manifold.TANGENT_SIZE)
    return rows[:, graph.manifold.ROTATION].ravel()


def _rotation_cost(graph: FactorGraph, poses: Array) -> float:
    return l1_cost(_rotation_residual(graph, poses))
