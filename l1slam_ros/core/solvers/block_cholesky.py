# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Sparse Cholesky factorisation of J'WJ in blocks of a keyframe's size, used by all solvers.

In: the keyframes of each factor. Out: solutions of normal equations. The elimination order and
the pattern are found once (`Pattern`), for blocks of rotations, of translations, of whole poses.
"""

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core import memory, native
from l1slam_ros.core.errors import FillError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    keyframes_of,
    loose_keyframes,
    neighbours,
)

Places = NDArray[np.int32]
_NONE = np.zeros(0, np.int64)

# Multiplications, some 15 ms, from which an order whose factors come and go is not found anew.
VAST = 1.5e8
# A graph that has grown by more than this fraction is ordered anew, which is rare. Without that,
# City's last factorisation, six thousand keyframes later, would do a quarter more work.
GROWN = 1.1
# Multiplications, some 2 ms, from which a factorisation uses a second thread.
_SHARED = 20e6
# Part of its diagonal by which a loose keyframe is damped: above what factorising leaves of a
# pivot that is none, and for a heading the same as to know it to within thousands of turns.
_LOOSE = 1e-9
# Numbers in a line of the processor's cache, and in a row from which on each row begins a line of
# its own: what lies across two lines takes twice as long to read, a row is an eighth longer at
# most.
_LINE, _WIDE = 8, 64
# Bytes of a number, and of all that a solve keeps of a factor for each entry of one of its
# Jacobians: measured, 1.7 kB of a factor in the plane, most of it rows of the interior point.
_NUMBER, _BYTES_PER_ENTRY = 8, 190
# Seconds that the steps of an exact L1 map, its start included, take of a factor for each such
# entry, and for each of a block of the Cholesky factor; how many factorisations they need, and how
# many multiplications a second has: measured on a core of the machine of doc/performance.md.
_SECONDS_PER_ENTRY, _SECONDS_PER_FILL = 4.3e-7, 1.05e-7
_FACTORISATIONS, _RATE = 20, 1e10
# From so many keyframes on steps become more, as their fourth root: 14 of 10,000 keyframes, 19,
# 25, 31 and 45 of 25,000, 100,000, 200,000 and 1,000,000.
_WIDE_GRAPH = 10_000
# Seconds a keyframe to find separators over the part of all multiplications that they spare.
_SEARCH = 6e-6 / 0.3


@dataclass(frozen=True)
class Pattern:
    """
    The order in which keyframes are eliminated, and where the factor's blocks lie.

    position : (n,) of each keyframe in that order; first : first position of each panel, and n;
    start, rows : the rows of panel s are rows[start[s]:start[s + 1]], positions; halves :
    (panels,) what to factorise at the same time, 0 and 1, and what after both, 2; work :
    multiplications of blocks that one factorisation takes; found : how many keyframes there were
    when all of it was.
    """

    position: Places
    first: Places
    start: Indices
    rows: Places
    halves: NDArray[np.int8]
    work: float
    found: int

    @property
    def blocks(self) -> int:
        """Number of blocks in all panels."""
        return int((np.diff(self.first) * np.diff(self.start)).sum())

    @cached_property
    def owner(self) -> Places:
        """The panel of each position, (n,)."""
        return np.repeat(np.arange(len(self.first) - 1, dtype=np.int32), np.diff(self.first))


def find_pattern(keyframe: Indices, size: int, most_blocks: int, k: int = 1,
                 before: Pattern | None = None, uses: float | None = None) -> Pattern:
    """
    Return the best elimination order that is found, and the pattern of its factor.

    By minimum degree; where the factorisations to come take long, also after separators, of
    levels and of parts, have been put last.

    keyframe, size : as in `LinearSystem`; k : size of a block
    before : of fewer keyframes and factors. Up to `GROWN` times as many, only keyframes that new
        factors join and those above them in the elimination tree are ordered anew: that takes a
        tenth of the time, and fills in little more
    uses : factorisations to come, None: those of an exact L1 map; few do not pay for separators

    Raises
    ------
    FillError : the factor would have more than `most_blocks`.

    """
    graph = neighbours(keyframe, size)
    if before is not None and before.found <= size < GROWN * before.found:
        order = native.ordering.resume(*graph, before.position, before.first, before.start,
                                       before.rows)
        pattern = _laid_out(graph, order, before.found)
        if pattern.blocks <= most_blocks:
            return pattern
    order, work = native.ordering.minimum_degree(*graph, np.zeros(size, np.int32))
    if work * k**3 * (uses or _factorisations(size)) > _SEARCH * _RATE * size:
        for separators in native.ordering.levels, native.dissection.dissect:
            other, its_work = native.ordering.minimum_degree(*graph, separators(*graph))
            if its_work < work:
                order, work = other, its_work
    pattern = _laid_out(graph, order, size)
    if pattern.blocks > most_blocks:
        raise FillError(f'the factor of {size} keyframes and {len(keyframe)} factors has '
                        f'{pattern.blocks} blocks', pattern.blocks)
    return pattern


def _laid_out(graph: tuple[Places, Places], order: Places, found: int) -> Pattern:
    """Return the pattern of an order; found : see `Pattern`."""
    return Pattern(*native.symbolic.lay_out(*graph, order), found)


def needs(graph: FactorGraph, blocks: float, work: float) -> memory.Needs:
    """Predict the time and memory of solving a graph from the blocks and work of its factor."""
    k = graph.manifold.TANGENT_SIZE
    m = len(graph.between)
    repeated = _factorisations(graph.n_poses)
    entries = _SECONDS_PER_ENTRY * k**2 * m + _SECONDS_PER_FILL * k**2 * blocks
    return memory.Needs(blocks * _bytes_of_block(graph) + _BYTES_PER_ENTRY * k**2 * m,
                        repeated * (entries / _FACTORISATIONS + work * k**3 / _RATE))


def _factorisations(size: int) -> float:
    """Return how many factorisations an exact L1 map of so many keyframes needs."""
    return _FACTORISATIONS * max(1.0, size / _WIDE_GRAPH) ** 0.25


def most_blocks(graph: FactorGraph) -> int:
    """Return the largest number of blocks of a factor that fits into the free memory."""
    left = (memory.free() - needs(graph, 0.0, 0.0).memory) / _bytes_of_block(graph)
    return int(min(max(left, 0.0), graph.n_poses * (graph.n_poses + 1.0)))


def _bytes_of_block(graph: FactorGraph) -> int:
    """Return what a block takes [B]: of whole poses, and of those parts that a seed solves for."""
    manifold = graph.manifold
    k = manifold.TANGENT_SIZE
    parts = {len(range(*part.indices(k))) for part in (manifold.TRANSLATION, manifold.ROTATION)}
    # The chordal relaxation has blocks of a rotation matrix.
    parts |= {k, manifold.rotation(manifold.identity(1)).shape[-1]}
    return _NUMBER * sum(size * size for size in parts)


class BlockCholesky:
    """
    Factors the normal matrices of all systems whose factors join the same keyframes.

    pattern : of `keyframe`, or of more; keyframe : (m, 2) as in `LinearSystem`; loose : (k,)
    columns that may move though nothing determines how, see `loose_keyframes`: they are damped,
    by so little that whatever is determined does not feel it
    """

    def __init__(self, pattern: Pattern, keyframe: Indices, loose: Indices = _NONE):
        self.pattern, self._loose = pattern, loose
        self._keyframe = keyframe
        self._layouts: dict[int, _Layout] = {}
        self._factored: _Layout | None = None

    def factorise(
        self, system: LinearSystem, weights: Array, diagonal: Array | float = 0.0,
        curvature: Array | None = None, share: float = 0.0,
    ) -> bool:
        """
        Factor J'WJ + diag(diagonal) + share C; False: it is not positive definite.

        weights : (rows,); diagonal : (columns,) or one number; curvature : (m, 2, r, 2 k) of
        each factor, as `Manifold.residual_curvature` has it, C their sum
        """
        k = system.block_size
        layout = self._layouts.get(k)
        if layout is None:
            layout = self._layouts[k] = _Layout(self.pattern, self._keyframe, k)
        if curvature is None or not share:
            curvature = np.empty((0, 2, k // 2, 2 * k))
        added = np.full(system.size * k, diagonal, float).reshape(-1, k)
        if len(self._loose):
            own = system.diagonal(weights).reshape(-1, k)[self._loose]
            added[self._loose] += np.where(own > 0, _LOOSE * own, 1.0)
        native.blocks.assemble(layout.panels, self._keyframe, *layout.places, system.blocks,
                               weights.reshape(-1, k), added, curvature, share)
        self._factored = layout
        return self._factorise(layout) == system.size

    def _factorise(self, layout: '_Layout') -> int:
        """Return how many positions have a positive pivot before the first that has not."""
        pattern = self.pattern
        shared = pattern.work * layout.block_size**3 > _SHARED
        share = pattern.halves if shared else np.zeros(len(pattern.first) - 1, np.int8)
        return native.cholesky.factorise(
            layout.panels, *layout.shape, share, layout.block_size, _cores() if shared else 1)

    @property
    def _last(self) -> '_Layout':
        assert self._factored is not None, 'nothing was factored'
        return self._factored

    def solve(self, right: Array) -> Array:
        """Return the solution for a right hand side (columns,) by the last factorisation."""
        layout = self._last
        return native.substitution.solve(layout.panels, *layout.shape, self.pattern.position,
                                         right.reshape(-1, layout.block_size)).ravel()

    def solve_many(self, right: Array) -> None:
        """Turn q right hand sides (free keyframes, k, q) into their solutions, in place."""
        layout = self._last
        native.prediction.solve_many(layout.panels, *layout.shape, self.pattern.position, right)

    def log_det(self) -> float:
        """Return the ln of the determinant of the matrix that was factored last."""
        *_, corner, stride = self._last.places
        pivots = corner[:, None] + np.arange(self._last.block_size) * (stride[:, None] + 1)
        return 2 * float(np.log(self._last.panels[pivots]).sum())

    @property
    def factor(self) -> tuple[Array | Indices | Places, ...]:
        """The factor of the last factorisation, as `native.front.begin` takes it."""
        return self._last.panels, *self._last.shape, self.pattern.position, self.pattern.owner


def _cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)


class _Layout:
    """
    Where in memory the blocks of one size lie.

    panels : all entries; shape : what describes the panels to the kernels; places : where in them
    the blocks of factors and keyframes are, see `native.symbolic.block_addresses`.
    """

    def __init__(self, pattern: Pattern, keyframe: Indices, block_size: int):
        self.block_size = block_size
        width = np.diff(pattern.first).astype(np.int64) * block_size
        stride = np.where(width < _WIDE, width, _whole_lines(width))
        areas = _whole_lines(stride * np.diff(pattern.start) * block_size)
        offset = np.concatenate(([0], np.cumsum(areas))).astype(np.int64)
        memory = np.empty(offset[-1] + _LINE)
        begin = -memory.ctypes.data // memory.itemsize % _LINE
        self.panels = memory[begin:begin + offset[-1]]
        self.shape = (pattern.first, pattern.start, pattern.rows, offset, stride)
        self.places: _Places = native.symbolic.block_addresses(
            keyframe, pattern.position, *self.shape, block_size)


_Places = tuple[Indices, Indices, NDArray[np.bool_], Indices, Indices]


def _whole_lines(numbers: Indices) -> Indices:
    return -(-numbers // _LINE) * _LINE


def cholesky_of(graph: FactorGraph, before: Pattern | None = None,
                uses: float | None = None) -> BlockCholesky:
    """
    Return what factors the systems of a graph; before, uses : see `find_pattern`.

    Raises
    ------
    FillError : a solve by them would take more memory than is free.

    """
    fixed = anchor(graph)
    keyframe = keyframes_of(graph, fixed)
    try:
        pattern = find_pattern(keyframe, graph.n_poses - fixed, most_blocks(graph),
                               graph.manifold.TANGENT_SIZE, before, uses)
    except FillError as error:
        takes = needs(graph, error.blocks, 0.0).memory
        raise FillError(
            f'factorising {graph.n_poses} keyframes and {len(graph.between)} factors takes '
            f'{memory.in_gigabytes(takes)} of memory, and '
            f'{memory.in_gigabytes(memory.free())} are free', error.blocks) from error
    return BlockCholesky(pattern, keyframe, loose_keyframes(graph))


def with_pattern(pattern: Pattern, graph: FactorGraph) -> BlockCholesky:
    """Return the Cholesky factorisation for a graph with a given pattern."""
    return BlockCholesky(pattern, keyframes_of(graph, anchor(graph)), loose_keyframes(graph))
