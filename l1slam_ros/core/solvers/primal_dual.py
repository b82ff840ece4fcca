# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The primal-dual methods of the paper: Algorithm 1 and its form for the L1 norm, Algorithm 2.

In: a linear system A, b and where to start. Out: the step x and its dual y, kept for the next
start. The problem and its saddle form are

    min_x |A x - b|_1  =  min_x max_{|y|_inf <= 1}  y'(A x - b)

    here          A        b        x       y      tau, sigma           theta
    the paper     K = A    in F     x       y      T, Sigma (diagonal)  theta

Convergence: Chambolle and Pock (2011) for Algorithm 1 with theta = 1 and tau sigma |K|^2 <= 1;
Pock and Chambolle (2011), lemma 2 with alpha = 1, for the diagonal step sizes. The primal weight
(Applegate et al., "Practical large-scale linear programming using primal-dual hybrid gradient",
2021) scales sigma against tau and leaves their product, so the theorem, alone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.options import Options, option
from l1slam_ros.core.solvers.optimality import L1, Norm, Status, duality_gap

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Iterations between two looks at the stopping test, which costs as much as one iteration.
CHECK_EVERY = 40
# What is no larger counts as nothing.
_LEAST = float(np.finfo(float).eps)

Resolvent = Callable[[Array], Array]


@dataclass(frozen=True)
class PrimalDualOptions(Options):
    """When a primal-dual solve stops."""

    iterations: int = option(
        400, 'largest number of iterations of one primal-dual solve', '', 1, 10**7)
    tolerance: float = option(
        1e-5, 'stop when the duality gap is below this fraction of the cost', '1', 0, 1)


@dataclass(frozen=True)
class PrimalDualSolution:
    """
    The result of a primal-dual solve.

    x : (columns,) step; y : (rows,) dual; objective : |A x - b|_1; gap : see `duality_gap`;
    history : (k, 2) rows (iteration, objective), the start first; weight : the primal weight.
    """

    x: Array
    y: Array
    objective: float
    gap: float
    status: Status
    iterations: int
    history: Array
    weight: float


def primal_dual(
    K: 'csr_array',
    dual_resolvent: Resolvent,
    primal_resolvent: Resolvent,
    x: Array,
    y: Array,
    tau: Array | float,
    sigma: Array | float,
    theta: float = 1.0,
) -> Iterator[tuple[Array, Array]]:
    """
    Yield the iterates (x, y) of Algorithm 1 for min_x F(K x) + G(x), without end.

    The paper prints the primal step with sigma; tau is meant.

    Parameters
    ----------
    K : (r, c) sparse operator
    dual_resolvent : v (r,) -> (I + sigma dF*)^-1 v
    primal_resolvent : v (c,) -> (I + tau dG)^-1 v
    x, y : (c,) and (r,), the start; never written to
    tau, sigma : primal and dual step sizes, scalars or (c,) and (r,)
    theta : over-relaxation in [0, 1]

    """
    K_adjoint = K.T.tocsr()
    x_bar = x
    while True:
        y = dual_resolvent(y + sigma * (K @ x_bar))
        x_new = primal_resolvent(x - tau * (K_adjoint @ y))
        x_bar = x_new + theta * (x_new - x)
        x = x_new
        yield x, y


def diagonal_step_sizes(A: 'csr_array') -> tuple[Array, Array]:
    """Return tau_j = 1 / sum_i |A_ij| (columns,), sigma_i = 1 / sum_j |A_ij| (rows,)."""
    magnitude = abs(A)
    # Nothing moves with an empty column; an empty row's dual is to jump to its bound.
    return (_inverse(magnitude.sum(axis=0), where_zero=0.0),
            _inverse(magnitude.sum(axis=1), where_zero=1 / _LEAST))


def primal_weight(A: 'csr_array', b: Array, x: Array) -> float:
    """
    Return omega = 1 / mean_i(|A x - b|_i / max_j |A_ij|) [1/m, 1/rad].

    The mean is how far a pose has to move to satisfy a typical row, so omega is the ratio of the
    dual's size, 1, to the primal's. Without it the method depends on the unit of length.
    """
    largest = abs(A).max(axis=1).toarray().ravel()
    needed = np.abs(A @ x - b) * _inverse(largest, where_zero=0.0)
    return 1 / max(float(needed.mean()), _LEAST)


def minimise_l1(
    A: 'csr_array',
    b: Array,
    x: Array,
    y: Array,
    options: PrimalDualOptions,
    norm: Norm = L1,
) -> PrimalDualSolution:
    """
    Minimise |A x - b|_1, or another norm of it, by Algorithm 2, from (x, y).

    Algorithm 1 with K = A, F(z) = |z - b|_1 and G = 0: the resolvent of F* subtracts sigma b and
    clips to the unit box, that of G does nothing.

    Parameters
    ----------
    A, b : (rows, columns), (rows,)
    x, y : (columns,), (rows,), where to start
    options : see `PrimalDualOptions`
    norm : rows of one group share the smallest step size of them

    """
    tau, sigma = diagonal_step_sizes(A)
    omega = primal_weight(A, b, x)
    tau = tau / omega
    sigma = sigma * omega
    sigma = np.repeat(sigma.reshape(-1, norm.size).min(axis=1), norm.size)
    sigma_b = sigma * b
    iterates = primal_dual(A, lambda v: norm.resolvent(v - sigma_b, sigma), lambda v: v,
                           x, y, tau, sigma)
    history = [(0.0, norm.cost(A @ x - b))]
    gap, status = np.inf, Status.ITERATION_LIMIT
    for k in range(1, options.iterations + 1):
        x, y = next(iterates)
        if k % CHECK_EVERY and k < options.iterations:
            continue
        history.append((k, norm.cost(A @ x - b)))
        gap = duality_gap(A, b, x, y, np.abs(x), norm)
        if gap <= options.tolerance * history[-1][1]:
            status = Status.CONVERGED
            break
    return PrimalDualSolution(x, y, history[-1][1], gap, status, k, np.array(history),
                              omega)


def _inverse(values: Array, where_zero: float) -> Array:
    return np.divide(1.0, values, out=np.full_like(values, where_zero), where=values > 0)
