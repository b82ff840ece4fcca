# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
From graph and poses to one sparse linear system: minimise |A x - b| over the step x.

In: a graph and its poses. Out: A and b, whitened, b the negative residual, the gauge removed.
Rows keep the order of the factors, columns that of the free keyframes.

The gauge: the world never moves; where no factor names it, keyframe 0 does not either. Factors
that leave a component unsaid may tie a part of the graph only in some directions: a single
position fix leaves the map free to turn. A motion that nothing determines stays zero: see
`loose_keyframes`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import FactorGraph, lowest_joined

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class LinearSystem:
    """
    |A x - b|, with A kept as the two square blocks of each factor.

    keyframe : (m, 2) which free keyframe's step each block multiplies, `size` for none: that of a
        keyframe held fixed, or of the world;
    blocks : (m, 2, k, k) whitened Jacobians; b : (rows,) minus the whitened residual, rows = m k;
    size : free keyframes; columns = size k.
    """

    keyframe: Indices
    blocks: Array
    b: Array
    size: int

    @property
    def block_size(self) -> int:
        """Rows of a factor and columns of a keyframe, k."""
        return int(self.blocks.shape[-1])

    @cached_property
    def residual(self) -> Array:
        """The whitened residual where the system was linearised, -b, (rows,)."""
        return -self.b

    @cached_property
    def A(self) -> 'csr_array':
        """(rows, columns) CSR without the zeros of the blocks."""
        from scipy.sparse import csr_array

        m, _, k, _ = self.blocks.shape
        values = self.blocks.transpose(0, 2, 1, 3).reshape(m * k, 2 * k)
        column = (self.keyframe[:, :, None] * k + np.arange(k)).reshape(m, 1, 2 * k)
        column = np.broadcast_to(column, (m, k, 2 * k)).reshape(m * k, 2 * k)
        keep = (values != 0) & (column < self.size * k)
        indptr = np.concatenate(([0], np.cumsum(keep.sum(axis=1))))
        return csr_array((values[keep], column[keep].astype(np.int32), indptr.astype(np.int32)),
                         shape=(m * k, self.size * k))

    def times(self, x: Array) -> Array:
        """Return A x, (rows,)."""
        step = x.reshape(self.size, self.block_size)
        return native.blocks.multiply(self.keyframe, self.blocks, step).ravel()

    def transposed_times(self, y: Array) -> Array:
        """Return A'y, (columns,)."""
        rows = y.reshape(-1, self.block_size)
        return native.blocks.multiply_transposed(
            self.keyframe, self.blocks, rows, self.size).ravel()

    def diagonal(self, weights: Array) -> Array:
        """Return the diagonal of A'WA, (columns,); weights : (rows,)."""
        return replace(self, blocks=self.blocks**2).transposed_times(weights)

    def weighted(self, roots: Array) -> 'LinearSystem':
        """Return the system with the rows of each factor multiplied by its root (m, k, k)."""
        roots, blocks = np.ascontiguousarray(roots), self.blocks.copy()
        native.blocks.whiten_blocks(roots, blocks)
        b = native.blocks.whiten(roots, self.b.reshape(-1, self.block_size))
        return replace(self, blocks=blocks, b=b.ravel())

    def part(self, entries: slice) -> 'LinearSystem':
        """Return the system of only these rows of each factor and columns of each keyframe."""
        blocks = np.ascontiguousarray(self.blocks[:, :, entries, entries])
        b = self.b.reshape(len(blocks), self.block_size)[:, entries].ravel()
        return LinearSystem(self.keyframe, blocks, b, self.size)


def anchor(graph: FactorGraph) -> int:
    """Return how many leading keyframes are held fixed: one, unless a factor names the world."""
    return 0 if graph.between.is_absolute.any() else min(1, graph.n_poses)


def loose_keyframes(graph: FactorGraph) -> Indices:
    """
    Return the free keyframes, columns (k,), that may stand for a motion that nothing determines.

    Keyframes that are joined by factors which say everything are rigid: one of each such part,
    the first, but for the part that is held fixed, or tied to the world, by one.
    """
    factors = graph.between
    whole = factors.freedom == graph.manifold.TANGENT_SIZE
    if whole.all():
        return np.zeros(0, np.int64)
    lowest = lowest_joined(graph.subset(whole))
    fixed = anchor(graph)
    first = np.unique(lowest[:-1])
    return first[first != lowest[-1]][fixed:] - fixed


def with_world(manifold: Manifold, poses: Array) -> Array:
    """Return the poses (n, p) with that of the world behind them, where index `WORLD` finds it."""
    return np.concatenate((poses, manifold.identity(1)))


def ends(graph: FactorGraph, poses: Array) -> tuple[Array, Array]:
    """Return the poses of the ends i and j of each between factor, (m, p) each."""
    factors = graph.between
    poses = with_world(graph.manifold, poses)
    return poses.take(factors.i, axis=0), poses.take(factors.j, axis=0)


def whitened_residual(graph: FactorGraph, poses: Array) -> Array:
    """Return the whitened residual of every row, (rows,), in the order of `LinearSystem`."""
    manifold, factors = graph.manifold, graph.between
    e = manifold.residual(factors.measurement, *ends(graph, poses))
    return native.blocks.whiten(factors.sqrt_information, e).ravel()


def linearise(graph: FactorGraph, poses: Array, residual: Array | None = None,
              fixed: int | None = None, keyframe: Indices | None = None) -> LinearSystem:
    """
    Return the system at `poses` (n, p); Jacobians with respect to right steps.

    Parameters
    ----------
    residual : of these poses, where it is known already
    fixed : how many keyframes are held in the gauge of another graph; None: see `anchor`
    keyframe : what `keyframes_of` returns for them, where it is known already

    """
    factors = graph.between
    blocks = graph.manifold.residual_jacobians(factors.measurement, *ends(graph, poses))
    native.blocks.whiten_blocks(factors.sqrt_information, blocks)
    if residual is None:
        residual = whitened_residual(graph, poses)
    fixed = anchor(graph) if fixed is None else fixed
    keyframe = keyframes_of(graph, fixed) if keyframe is None else keyframe
    return LinearSystem(keyframe, blocks, -residual, graph.n_poses - fixed)


def keyframes_of(graph: FactorGraph, fixed: int) -> Indices:
    """Return the free keyframes that each factor moves, (m, 2); see `LinearSystem`."""
    keyframe = np.stack((graph.between.i, graph.between.j), axis=1) - fixed
    return np.where(keyframe < 0, graph.n_poses - fixed, keyframe)


def neighbours(keyframe: Indices, size: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """
    Return the neighbours of each free keyframe k, adjacent[start[k]:start[k + 1]], int32.

    Each once, ascending, both ways round; keyframe, size : see `LinearSystem`
    """
    start, adjacent = native.symbolic.neighbours(np.ascontiguousarray(keyframe), size)
    return start, adjacent


def step_poses(graph: FactorGraph, poses: Array, x: Array) -> Array:
    """Return the poses retracted by x (columns,); the anchor stays."""
    fixed = anchor(graph)
    step = np.asarray(x).reshape(-1, graph.manifold.TANGENT_SIZE)
    return np.concatenate((poses[:fixed], graph.manifold.retract(poses[fixed:], step)))


def step_part(graph: FactorGraph, poses: Array, x: Array, part: slice) -> Array:
    """Return the poses after a step of this part of the tangent alone, x (columns of it,)."""
    step = np.zeros((graph.n_poses - anchor(graph), graph.manifold.TANGENT_SIZE))
    step[:, part] = x.reshape(len(step), -1)
    return step_poses(graph, poses, step)
