# SPDX-License-Identifier: Apache-2.0
"""
One sparse factorisation for all: Cholesky of J'WJ in blocks of a keyframe's size.

In: which keyframes each factor joins. Out: solutions of normal equations. The order of elimination
and the pattern of the factor are those of keyframes, found once (`Pattern`) and used for blocks of
every size: of the rotations alone, of the translations, of whole poses.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array

from l1slam_ros.core.errors import FillError
from l1slam_ros.core.graph import FactorGraph
from l1slam_ros.core.linearise import LinearSystem, anchor, keyframes_of
from l1slam_ros.core.manifold import Array, Indices

# Blocks of SE(2) that one gigabyte holds.
MOST_BLOCKS = 15_000_000


@dataclass(frozen=True)
class Pattern:
    """
    The order in which keyframes are eliminated, and where the factor's blocks lie.

    position : (n,) of each keyframe in that order; first : first position of each panel, and n;
    start, rows : the rows of panel s are rows[start[s]:start[s + 1]], positions; work :
    multiplications of blocks that one factorisation takes.
    """

    position: Indices
    first: Indices
    start: Indices
    rows: Indices
    work: float


def find_pattern(keyframe: Indices, size: int, most_blocks: int) -> Pattern:
    """
    Return a pattern of little fill; keyframe, size : as in `LinearSystem`.

    Raises
    ------
    FillError : the factor would have more than `most_blocks`.

    """
    from l1slam_ros.core.kernels.ordering import minimum_degree
    from l1slam_ros.core.kernels.symbolic import panel_rows, postorder, supernodes

    i, j = keyframe[(keyframe < size).all(axis=1)].T
    both = (np.concatenate((i, j)), np.concatenate((j, i)))
    adjacency = coo_array((np.ones(2 * len(i)), both), shape=(size, size)).tocsr()
    adjacency.sum_duplicates()
    order, column, rows = minimum_degree(
        adjacency.indptr.astype(np.int32), adjacency.indices.astype(np.int32), most_blocks)
    if len(order) < size:
        raise FillError(f'the factor of {size} keyframes and {len(keyframe)} factors would have '
                        f'more than {most_blocks} blocks: too many far places are joined')
    position, parent, below, step = postorder(order, column, rows)
    first = supernodes(parent, below)
    start, pattern = panel_rows(first, column, rows, step, position)
    return Pattern(position, first, start, pattern, float(((below + 1.0) ** 2).sum() / 2))


class BlockCholesky:
    """
    Factors the normal matrices of all systems that join the same keyframes.

    Parameters
    ----------
    pattern : of `keyframe`, or of more
    keyframe : (m, 2) as in `LinearSystem`

    """

    def __init__(self, pattern: Pattern, keyframe: Indices):
        self.pattern = pattern
        self._keyframe = keyframe
        self._layouts: dict[int, _Layout] = {}
        self._factored: _Layout | None = None

    def factorise(
        self, system: LinearSystem, weights: Array, diagonal: Array | float = 0.0,
        curvature: Array | None = None, share: float = 0.0,
    ) -> bool:
        """
        Factor J'WJ + diag(diagonal) + share C; False: it is not positive definite.

        weights : (rows,); diagonal : (columns,) or one number; curvature : (m', 2 k, 2 k) of the
        first m' factors, C their sum
        """
        from l1slam_ros.core.kernels import blocks, cholesky

        k = system.block_size
        layout = self._layouts.get(k)
        if layout is None:
            layout = self._layouts[k] = _Layout(self.pattern, self._keyframe, k)
        panels, sizes = layout.panels, layout.sizes
        panels[:] = 0.0
        blocks.add_normal(panels, system.blocks, weights.reshape(-1, k), *layout.places, sizes)
        if curvature is not None and share:
            blocks.add_blocks(panels, curvature, share, *layout.places, sizes)
        added = np.full(system.size * k, diagonal, float).reshape(-1, k)
        cholesky.add_diagonal(panels, *layout.diagonal, self.pattern.position, added, sizes)
        self._factored = layout
        return bool(cholesky.factorise(panels, *layout.shape, sizes) == system.size)

    def solve(self, right: Array) -> Array:
        """Return the solution for a right hand side (columns,) by the last factorisation."""
        from l1slam_ros.core.kernels import cholesky

        layout = self._factored
        assert layout is not None, 'solve before factorise'
        x: Array = cholesky.solve(layout.panels, *layout.shape, self.pattern.position,
                                  right.reshape(-1, len(layout.sizes)), layout.sizes)
        return x.ravel()

    def solve_many(self, right: Array) -> Array:
        """Return the solutions for q right hand sides (free keyframes, k, q), of that shape."""
        from l1slam_ros.core.kernels.prediction import solve_many

        layout = self._factored
        assert layout is not None, 'solve before factorise'
        x: Array = solve_many(layout.panels, *layout.shape, self.pattern.position, right,
                              layout.sizes)
        return x


class _Layout:
    """
    Where in memory the blocks of one size lie.

    panels : all entries; shape : what describes the panels to the kernels; diagonal : address and
    panel's width of each diagonal block, (n,); places : address and width of the three blocks of
    each factor, (m, 3), and if the last one is turned, see `kernels.blocks.add_normal`.
    """

    def __init__(self, pattern: Pattern, keyframe: Indices, block_size: int):
        from l1slam_ros.core.kernels.cholesky import block_addresses

        k, n = block_size, len(pattern.position)
        areas = np.diff(pattern.first) * np.diff(pattern.start) * k * k
        offset = np.concatenate(([0], np.cumsum(areas))).astype(np.int64)
        self.sizes = (0,) * k
        self.panels = np.empty(offset[-1])
        self.shape = (pattern.first, pattern.start, pattern.rows, offset)
        row = np.arange(n)
        self.diagonal = block_addresses(row, row, *self.shape, k)
        free = keyframe < n
        position = np.append(pattern.position, 0)[np.minimum(keyframe, n)]
        address = np.full((len(keyframe), 3), -1)
        width = np.zeros((len(keyframe), 3), np.int64)
        address[:, :2] = np.where(free, np.append(self.diagonal[0], -1)[position], -1)
        width[:, :2] = np.append(self.diagonal[1], 0)[position]
        pair = np.flatnonzero(free.all(axis=1))
        row, col = position[pair].max(axis=1), position[pair].min(axis=1)
        address[pair, 2], width[pair, 2] = block_addresses(row, col, *self.shape, k)
        self.places = (address, width, position[:, 0] > position[:, 1])


def cholesky_of(graph: FactorGraph) -> BlockCholesky:
    """
    Return what factors the systems of a graph.

    Raises
    ------
    FillError : the factor would have more than `MOST_BLOCKS`.

    """
    keyframe = keyframes_of(graph)
    pattern = find_pattern(keyframe, graph.n_poses - anchor(graph), MOST_BLOCKS)
    return BlockCholesky(pattern, keyframe)
