# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Linear systems in blocks: hand-made, random, and of graphs of every shape."""

import numpy as np

from l1slam_ros.core.graph.linear_system import LinearSystem
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky, find_pattern

PLENTY = 10**6  # blocks that a factor of these small systems never needs


def system_of(A, b):
    """Return the system, in blocks of one, of a matrix (m, n) with at most two entries a row."""
    A, (m, n) = A.toarray(), A.shape
    keyframe, blocks = np.full((m, 2), n), np.zeros((m, 2, 1, 1))
    for row, entries in enumerate(A):
        columns = np.flatnonzero(entries)
        keyframe[row, : len(columns)] = columns
        blocks[row, : len(columns), 0, 0] = entries[columns]
    return LinearSystem(keyframe, blocks, b, n)


def random_system(pairs, size, k, rng, scale=0.0):
    """
    Return a system of random blocks (k, k) and b.

    pairs : (m, 2) as `LinearSystem.keyframe`; scale : rows differ by up to 10^scale either way.
    """
    keyframe = np.array(pairs, np.int64).reshape(-1, 2)
    blocks = rng.standard_normal((len(keyframe), 2, k, k))
    blocks *= 10 ** rng.uniform(-scale, scale, (len(keyframe), 1, k, 1))
    # As those of a graph: no step of a keyframe that is not there.
    blocks[keyframe == size] = 0.0
    return LinearSystem(keyframe, blocks, rng.standard_normal(len(keyframe) * k), size)


def cholesky_of_system(system):
    """Return what factors a system."""
    return BlockCholesky(find_pattern(system.keyframe, system.size, PLENTY), system.keyframe)


def chain(n):
    """Return the pairs of a chain whose first keyframe is tied to one held fixed."""
    return [(n, 0)] + [(k, k + 1) for k in range(n - 1)]


def star(n):
    """Return the pairs of a hub in the middle of the numbers and all others."""
    hub = n // 2
    return [(hub, n)] + [(hub, k) if k % 2 else (k, hub) for k in range(n) if k != hub]


def grid(n):
    """Return the pairs of a square grid of at most n keyframes, the rest a chain from there."""
    side = int(np.sqrt(n))
    here = np.arange(side * side).reshape(side, side)
    across = np.column_stack((here[:, :-1].ravel(), here[:, 1:].ravel()))
    down = np.column_stack((here[1:].ravel(), here[:-1].ravel()))
    rest = [(k - 1, k) for k in range(side * side, n)]
    return [(n, 0), *map(tuple, across), *map(tuple, down), *rest]


def parallel(n):
    """Return the pairs of a chain, each twice more, the third time the other way round."""
    return [(0, n)] + [pair for k in range(n - 1) for pair in ((k, k + 1), (k, k + 1), (k + 1, k))]


def tied_down(n):
    """Return the pairs of keyframes tied to the world, no two of them joined, but the last two."""
    return [(k, n) for k in range(n)] + [(n - 2, n - 1)]


def random_loops(n):
    """Return the pairs of a chain with as many loops anywhere, one either way round."""
    rng = np.random.default_rng(n)
    first, last = rng.integers(0, n, (2, 4 * n))
    loops = [(i, j) for i, j in zip(first, last, strict=True) if i != j][:n]
    return chain(n) + [(int(i), int(j)) for i, j in loops]


def two_parts(n):
    """Return the pairs of two chains, each tied to what is held fixed."""
    half = n // 2
    return ([(n, 0), (half, n)] + [(k, k + 1) for k in range(half - 1)]
            + [(k, k + 1) for k in range(half, n - 1)])


SHAPES = [chain, star, grid, parallel, tied_down, random_loops, two_parts]
