# SPDX-License-Identifier: Apache-2.0
"""
From graph and poses to one sparse linear system: minimise |A x - b| over the step x.

In: a graph and its poses. Out: A and b, whitened, b the negative residual, the gauge removed.
Rows keep the order of the factors (all priors' rows come after the between factors', see
`LinearSystem`); columns keep the order of the free keyframes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.noise import whiten


@dataclass(frozen=True)
class LinearSystem:
    """
    A : (rows, columns) CSR, whitened Jacobian; b : (rows,), minus the whitened residual.

    rows = d for each between factor, then d for each prior; columns = d for each free keyframe.
    """

    A: csr_array
    b: Array


def anchor(graph: FactorGraph) -> int:
    """Return how many leading keyframes are held fixed: one, unless a prior fixes the gauge."""
    return 0 if len(graph.prior) else min(1, graph.n_poses)


def whitened_residual(graph: FactorGraph, poses: Array) -> Array:
    """Return the whitened residual of every row, (rows,), in the order of `LinearSystem`."""
    manifold, factors, prior = graph.manifold, graph.between, graph.prior
    e = manifold.residual(factors.measurement, poses[factors.i], poses[factors.j])
    e_prior = manifold.local(prior.measurement, poses[prior.i])
    return np.concatenate((whiten(factors.sqrt_information, e).ravel(),
                           whiten(prior.sqrt_information, e_prior).ravel()))


def linearise(graph: FactorGraph, poses: Array) -> LinearSystem:
    """Return the system at `poses` (n, p); Jacobians with respect to right steps."""
    manifold, factors, prior = graph.manifold, graph.between, graph.prior
    J_i, J_j = manifold.residual_jacobians(
        factors.measurement, poses[factors.i], poses[factors.j])
    pair = np.concatenate((whiten(factors.sqrt_information, J_i),
                           whiten(factors.sqrt_information, J_j)), axis=2)
    single = whiten(prior.sqrt_information,
                    manifold.local_jacobian(prior.measurement, poses[prior.i]))
    d, fixed = manifold.TANGENT_SIZE, anchor(graph)
    blocks = [_block_rows(pair, np.stack((factors.i, factors.j), 1) - fixed, d),
              _block_rows(single, prior.i[:, None] - fixed, d)]
    A = _stack(blocks, (graph.n_poses - fixed) * d)
    return LinearSystem(A, -whitened_residual(graph, poses))


def step_poses(graph: FactorGraph, poses: Array, x: Array) -> Array:
    """Return the poses retracted by x (columns,); the anchor stays."""
    fixed = anchor(graph)
    step = np.asarray(x).reshape(-1, graph.manifold.TANGENT_SIZE)
    return np.concatenate((poses[:fixed], graph.manifold.retract(poses[fixed:], step)))


def _block_rows(values: Array, keyframe: Indices, d: int) -> tuple[Array, Indices]:
    """Lay (m, d, k d) blocks out as rows: values and column of each entry, (m d, k d) each."""
    column = (keyframe[:, :, None] * d + np.arange(d)).reshape(len(keyframe), 1, values.shape[2])
    rows = values.reshape(-1, values.shape[2])
    return rows, np.broadcast_to(column, values.shape).reshape(rows.shape)


def _stack(blocks: list[tuple[Array, Indices]], columns: int) -> csr_array:
    """Stack the blocks as one CSR; zeros and the columns of the anchor are left out."""
    keep = [(values != 0) & (column >= 0) for values, column in blocks]
    counts = np.concatenate([mask.sum(axis=1) for mask in keep])
    data = np.concatenate([values[mask] for (values, _), mask in zip(blocks, keep, strict=True)])
    index = np.concatenate([column[mask] for (_, column), mask in zip(blocks, keep, strict=True)])
    indptr = np.concatenate(([0], np.cumsum(counts)))
    return csr_array((data, index.astype(np.int32), indptr.astype(np.int32)),
                     shape=(len(counts), columns))
