# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Weighted linear least squares by one sparse factorisation, and starts for L1 from it.

In: a linear system. Out: the step that minimises a weighted sum of squares.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.linear_system import LinearSystem
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky
from l1slam_ros.core.solvers.optimality import smoothing

# Ten halvings bring the smoothing a thousand times below the mean residual, well under the
# percent that the primal-dual iterations then have to mend; each costs one factorisation.
_SMOOTHING_STEPS = 10
# So much of a kept dual counts: with all of it the matrix is next to singular, and steps may fail.
_KEPT = 0.7


def weighted_least_squares(
    system: LinearSystem, cholesky: BlockCholesky, weights: Array, damping: float = 0.0
) -> Array:
    """
    Return argmin_x sum_i w_i (A x - b)_i^2 + damping sum_j D_j x_j^2, (columns,).

    D is the diagonal of A'WA (Marquardt's scaling); weights (rows,).

    Raises
    ------
    GraphError : the matrix is singular: some keyframe is not tied to the anchor.

    """
    added: Array | float = 0.0
    if damping:
        added = damping * system.diagonal(weights)
    if not cholesky.factorise(system, weights, added):
        raise GraphError('the normal matrix is singular: a part of the graph is not tied to '
                         'the anchor, or weights differ beyond double precision')
    return cholesky.solve(system.transposed_times(weights * system.b))


def reweighted_step(
    system: LinearSystem, cholesky: BlockCholesky, r: Array, mu: float
) -> tuple[Array, Array]:
    """
    Return one step of iteratively reweighted least squares towards |A x - b|_1, and its dual.

    Weights w = 1 / sqrt(r^2 + mu^2) at the residual r (rows,). The normal equations say
    A'(w (A x - b)) = 0, so y = w (A x - b), clipped to the unit box, is nearly a feasible dual.

    Returns
    -------
    x : (columns,); y : (rows,)

    """
    weights = 1 / np.sqrt(r * r + mu * mu)
    x = weighted_least_squares(system, cholesky, weights)
    return x, np.clip(weights * (system.times(x) - system.b), -1, 1)


def warm_step(system: LinearSystem, cholesky: BlockCholesky, y: Array, mu: float) -> Array:
    """
    Return a step from x = 0 towards |A x - b|_1, (columns,), by a dual y (rows,) that was kept.

    It is Newton's on sum R, R = sqrt(r^2 + mu^2), where the curvature of a root is

        W = (1 - (r / R)^2) / R,    A'W A x = -A'(r / R),    r = -b,

    with y in the place of one r / R: y is near that of the optimum, and the system stays nearly
    linear for small mu (Chan, Golub and Mulet, see `primal_dual_newton`). So what is off a corner,
    and is to stay off, is free to move, where reweighting, W = 1 / R, holds it.

    Raises
    ------
    GraphError : see `weighted_least_squares`

    """
    R = np.hypot(system.b, mu)
    free = 1 + _KEPT * y * system.b / R
    return weighted_least_squares(replace(system, b=system.b / free), cholesky, free / R)


def reweighted_start(system: LinearSystem, cholesky: BlockCholesky,
                     check: Callable[[], None] = lambda: None) -> tuple[Array, Array]:
    """
    Return a primal (columns,) and a dual (rows,) near the optimum of |A x - b|_1.

    From the least squares solution, `reweighted_step` with mu halved each time: it follows the
    minimum of sum sqrt(r^2 + mu^2). The optimum of the angles is often not unique (files round
    their numbers, so costs tie): this path leads to the middle of the optimal face, where a
    first-order method alone ends wherever it came from. It ends early where sharper weights are
    beyond double precision, as on a straight way of kilometres that one weak factor ties.

    check : called before each step, raises where the work shall stop
    """
    x = weighted_least_squares(system, cholesky, np.ones_like(system.b))
    r = system.times(x) - system.b
    mu = smoothing(r)
    y = r / np.hypot(r, mu)
    with suppress(GraphError):
        for _ in range(_SMOOTHING_STEPS):
            check()
            x, y = reweighted_step(system, cholesky, r, mu)
            r = system.times(x) - system.b
            mu /= 2
    return x, y
