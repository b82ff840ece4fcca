# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Check a graph before it is solved: long steps, misstated noise, offset loops.

In: a graph. Out: suspicious keyframes and factors, with numbers; sentences are made elsewhere. All
but `noise_scales` visit each factor once.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask, whiten
from l1slam_ros.core.geometry.quantiles import gamma_quantile
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    ends,
    keyframes_of,
    step_part,
    step_poses,
)
from l1slam_ros.core.graph.parts import connected_parts
from l1slam_ros.core.graph.spanning_tree import pair_key, tree_poses
from l1slam_ros.core.robust.innovation import BY_CHANCE, CHECKED
from l1slam_ros.core.solvers.optimality import l1_cost, l2_cost

# Steps this many times the 90% quantile are not of the same robot.
_LONG = 10.0
# Noise is estimated in a part of this size: a dense graph of 50,000 poses takes minutes.
_PART = 2000
# Fewest redundant measurements to estimate noise, and steps to estimate a robot's motion; also the
# weight of prior noise, in measurements.
FEWEST = 20
# Approximate poses suffice for the size of residuals: limits of steps, and of the relative change
# of chi2, or of a ratio.
_STEPS = 20
_TOLERANCE = 0.01
# Ratio of actual to stated errors, either way, worth reporting.
OFF_SCALE = 3.0


def parallel_factors(graph: FactorGraph) -> Indices:
    """Return the factors that share their pair of keyframes, in either direction, (k,)."""
    factors = graph.between
    _, inverse, counts = np.unique(pair_key(factors.i, factors.j, graph.n_poses),
                                   return_inverse=True, return_counts=True)
    return np.flatnonzero(counts[inverse] > 1)


@dataclass(frozen=True)
class LongSteps:
    """
    Odometry that jumps.

    factors : (k,) of much longer steps; lengths : (k,) [m]; ordinary : 90% quantile of all [m]
    """

    factors: Indices
    lengths: Array
    ordinary: float


def long_steps(graph: FactorGraph) -> LongSteps:
    """Return the odometry steps much longer than others."""
    rows = np.flatnonzero(graph.between.is_odometry)
    length = step_lengths(graph)
    ordinary = float(np.quantile(length, 0.9)) if len(length) else 0.0
    # A robot that mostly stands still has no ordinary step.
    long = length > _LONG * ordinary if ordinary else np.zeros(len(rows), bool)
    return LongSteps(rows[long], length[long], ordinary)


def step_lengths(graph: FactorGraph) -> Array:
    """Return the length of each odometry step [m], in their order."""
    manifold, factors = graph.manifold, graph.between
    steps = factors.measurement[factors.is_odometry]
    return manifold.motion(manifold.local(manifold.identity(len(steps)), steps))[0]


@dataclass(frozen=True)
class NoiseScales:
    """
    Ratios of actual to stated errors.

    Attributes
    ----------
    odometry, loops : of standard deviations, NaN with too few factors
    first, last : keyframes between which they were estimated
    turns : that of rotations over that of translations
    offset : (k,) step that all loops lack, None if noise explains it

    """

    odometry: float
    loops: float
    first: int
    last: int
    turns: float
    offset: Array | None = None


def noise_scales(graph: FactorGraph, rng: 'np.random.Generator') -> NoiseScales:
    """
    Compare residuals at the L2 optimum with the stated information.

    The squared residual of each group (odometry, loops) is divided by that of random noise of the
    stated size after the same fit, which accounts for the freedom it absorbs. Weights follow these
    ratios, a few times over.

    Raises
    ------
    GraphError : the part cannot be solved.

    """
    part, keyframes, is_loop = densest_part(graph)
    ends = int(keyframes[0]), int(keyframes[-1])
    if (len(part.between) - part.n_poses) * graph.manifold.TANGENT_SIZE < FEWEST:
        return NoiseScales(np.nan, np.nan, *ends, np.nan)
    system = _system(part, _l2_poses(part))
    group = np.repeat(is_loop.astype(np.int64), graph.manifold.TANGENT_SIZE)
    noise = rng.standard_normal(len(group)) * part.between.speaks.ravel()
    variance, spare = np.ones(2), np.zeros(2)

    def left_of(b: Array) -> Array:
        return b - system.A @ _least_squares(system, b, 1 / variance[group])

    for _ in range(_STEPS):
        left = left_of(np.stack((system.b, np.sqrt(variance)[group] * noise), axis=1))
        found, drawn = (np.bincount(group, column**2, minlength=2) for column in left.T)
        spare = drawn / variance
        ratio = np.divide(found, drawn, out=np.ones(2), where=spare >= FEWEST)
        variance = np.clip(variance * ratio, 1e-12, 1e12)
        if (np.abs(ratio - 1) < _TOLERANCE).all():
            break
    odometry, loops = np.where(spare >= FEWEST, np.sqrt(variance), np.nan).tolist()
    known = (spare >= FEWEST).all()
    offset = lacked_step(part, is_loop, system.b, variance, left_of) if known else None
    return NoiseScales(odometry, loops, *ends, _turns(part.manifold, left), offset)


def lacked_step(graph: FactorGraph, is_loop: Mask, b: Array, variance: Array,
                left_of: Callable[[Array], Array]) -> Array | None:
    """
    Return the step d [m, rad] that all loops lack, (k,): Z v2t(d) fits; None if noise explains it.

    left_of : residuals of a map weighted by the variances, (rows, k + 1)

    Z is the later keyframe seen from the earlier. With G (rows, k) the derivatives by d, the map
    and d minimise |A x - b - G d|^2, weighted by the variances (2,) of odometry and of loops. G_p
    and r are G and b after the map is fitted: S = G_p'W G_p is the information of d, d = -S^-1
    G_p'W r, chi2 = d'S d. Directions that the map follows are hardly checked, and excluded. The
    noise is that of loops after d; off scale, outliers may cause an offset, so None.
    """
    manifold, factors = graph.manifold, graph.between
    k = manifold.TANGENT_SIZE
    # A loop listed from its later end lacks v2t(d)^-1 on the left.
    backward = -manifold.adjoint(manifold.inverse(factors.measurement))
    lacked = np.where((factors.i > factors.j)[:, None, None], backward, np.eye(k))
    G = (is_loop[:, None, None] * factors.sqrt_information @ lacked).reshape(-1, k)
    weights = 1 / np.repeat(variance[is_loop.astype(np.int64)], k)
    left = left_of(np.column_stack((b, G)))
    weighted = weights[:, None] * G
    M = G.T @ weighted
    S = left[:, 1:].T @ weighted
    z = weighted.T @ left[:, 0]
    scale = np.sqrt(np.where(np.diag(M) > 0, np.diag(M), 1.0))
    share, V = np.linalg.eigh(S / np.outer(scale, scale))
    V, share = V[:, share > CHECKED] / scale[:, None], share[share > CHECKED]
    if not len(share):
        return None
    d = -V @ (V.T @ z / share)
    before = left[np.repeat(is_loop, k)]
    after = before[:, 0] + before[:, 1:] @ d
    # Multiplied out: exact measurements leave nothing to divide by.
    found, noise = before[:, 0] @ before[:, 0], after @ after
    spare = is_loop.sum() * k - len(share)  # ratio of likelihoods, the noise estimated, too
    likely = spare * np.expm1(2 * gamma_quantile(len(share) / 2, 1 - BY_CHANCE) / spare)
    is_sure = d @ S @ d * found > likely * noise
    is_large = d @ M @ d * found > is_loop.sum() * noise
    fits = variance[1] * noise <= OFF_SCALE**2 * found
    return d if fits and is_sure and is_large else None


def _turns(manifold: Manifold, left: Array) -> float:
    square = (left**2).reshape(-1, manifold.TANGENT_SIZE, 2).sum(axis=0)
    found, drawn = (square[part].sum(axis=0) for part in (manifold.ROTATION, manifold.TRANSLATION))
    return float(np.sqrt(found[0] / found[1] * drawn[1] / drawn[0])) if square.all() else np.nan


def cost_at(graph: FactorGraph, poses: Array) -> float:
    """Return the L1 cost of a graph at poses (n, p), without compiled code."""
    manifold, factors = graph.manifold, graph.between
    B = manifold.between(*ends(graph, poses))
    return l1_cost(whiten(factors.sqrt_information, manifold.local(factors.measurement, B)))


def _l2_poses(graph: FactorGraph) -> Array:
    """Return the L2 map of a graph without absolute factors, (n, p), rotations first."""
    manifold, poses = graph.manifold, tree_poses(graph, 0)
    for part in (manifold.ROTATION, manifold.TRANSLATION):
        system = _system(graph, poses).part(part)
        poses = step_part(graph, poses, _least_squares(system, system.b), part)
    system = _system(graph, poses)
    for _ in range(_STEPS):
        moved = step_poses(graph, poses, _least_squares(system, system.b))
        there = _system(graph, moved)
        if l2_cost(there.b) > (1 - _TOLERANCE) * l2_cost(system.b):
            break
        poses = moved
        system = there
    return poses


def _system(graph: FactorGraph, poses: Array) -> LinearSystem:
    """
    Return the linear system of a graph, without compiled code.

    Inspection ends before that is loaded. With B = Xi^-1 Xj the residual is that of B seen from Z;
    a step s of i moves B on the right by -Ad(B^-1) s.
    """
    manifold, factors = graph.manifold, graph.between
    B = manifold.between(*ends(graph, poses))
    J_j = manifold.local_jacobian(factors.measurement, B)
    J_i = -J_j @ manifold.adjoint(manifold.inverse(B))
    roots = factors.sqrt_information
    b = -whiten(roots, manifold.local(factors.measurement, B))
    blocks = np.stack((whiten(roots, J_i), whiten(roots, J_j)), axis=1)
    fixed = anchor(graph)
    return LinearSystem(keyframes_of(graph, fixed), blocks, b.ravel(), graph.n_poses - fixed)


def _least_squares(system: LinearSystem, b: Array, weights: Array | float = 1.0) -> Array:
    """
    Return argmin_x sum_i w_i (A x - b)_i^2, (columns,) or (columns, k) for k of b.

    Raises
    ------
    GraphError : the matrix is singular.

    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    root = np.sqrt(np.broadcast_to(weights, len(system.b)))
    A = system.A.copy()
    A.data = A.data * np.repeat(root, np.diff(A.indptr))
    b = b * (root if b.ndim == 1 else root[:, None])
    try:
        factor = splu(csc_array(A.T @ A), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                      options={'SymmetricMode': True})
    except RuntimeError as error:
        raise GraphError('the normal matrix is singular') from error
    return factor.solve(A.T @ b)


def densest_part(graph: FactorGraph) -> tuple[FactorGraph, Indices, np.ndarray]:
    """
    Return the connected part of some consecutive keyframes with the most factors.

    A graph without absolute factors, its keyframes (k,), and which factors are loops (m,).
    """
    factors, n = graph.between, graph.n_poses
    first, last = np.minimum(factors.i, factors.j), np.maximum(factors.i, factors.j)
    starts = np.arange(0, max(n - _PART, 0) + 1, _PART // 2)
    counts = [np.count_nonzero((first >= start) & (last < start + _PART)) for start in starts]
    start = starts[np.argmax(counts)]
    keyframes = np.arange(start, min(start + _PART, n))
    window, _ = _restricted(graph, keyframes)
    keyframes = keyframes[max(connected_parts(window), key=len)]
    part, rows = _restricted(graph, keyframes)
    return part, keyframes, ~factors.is_odometry[rows]


def _restricted(graph: FactorGraph, keyframes: Indices) -> tuple[FactorGraph, Indices]:
    factors = graph.between
    index = np.full(graph.n_poses + 1, -1)  # the last entry is the world
    index[keyframes] = np.arange(len(keyframes))
    i, j = index[factors.i], index[factors.j]
    rows = np.flatnonzero((i >= 0) & (j >= 0))
    part = FactorGraph(graph.manifold, len(keyframes))
    part.append_between(i[rows], j[rows], factors.measurement[rows],
                        factors.sqrt_information[rows])
    return part, rows
