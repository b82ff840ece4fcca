# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Minimum degree and dissection, against brute-force elimination and SciPy's MMD."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay
from systems import PLENTY, SHAPES

from l1slam_ros.core.kernels import dissection, ordering
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

NOTHING = np.zeros(0, np.int32), np.zeros(1, np.int64), np.zeros(0, np.int32)


def minimum_degree(start, adjacent, stage=None):
    """Return the order, and the rows of each column; nodes of lower stages come first."""
    stage = np.zeros(len(start) - 1, np.int32) if stage is None else stage
    return ordering.minimum_degree(start, adjacent, PLENTY, stage, *NOTHING)


def adjacency_of(pairs, n):
    """Return start and adjacent, as of `minimum_degree`, of the pairs between free nodes."""
    i, j = np.array([pair for pair in pairs if max(pair) < n], int).reshape(-1, 2).T
    matrix = coo_array((np.ones(2 * len(i)), (np.append(i, j), np.append(j, i))), shape=(n, n))
    matrix = matrix.tocsr()
    matrix.sum_duplicates()
    return matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)


def eliminate(start, adjacent, order):
    """Return the neighbours of each node when its turn comes, by joining them: a list of sets."""
    neighbours = [set(adjacent[start[k]:start[k + 1]].tolist()) for k in range(len(start) - 1)]
    columns = []
    for pivot in order.tolist():
        columns.append(neighbours[pivot])
        for k in neighbours[pivot]:
            neighbours[k] |= neighbours[pivot]
            neighbours[k] -= {k, pivot}
    return columns


def planar(n, rng):
    """Return the pairs of a triangulation of places anywhere in a square, most of them."""
    triangles = Delaunay(rng.random((n, 2))).simplices
    pairs = np.sort(np.concatenate((triangles[:, :2], triangles[:, 1:], triangles[:, ::2])))
    pairs = np.unique(pairs, axis=0)
    return pairs[rng.random(len(pairs)) < 0.8].tolist() + [(k, k + 1) for k in range(n - 1)]


@pytest.fixture(params=SHAPES + ['planar', 'dense', 'nothing'],
                ids=lambda shape: getattr(shape, '__name__', shape))
def graph(request, rng):
    """The start and adjacent of a graph of fifty nodes."""
    n = 50
    pairs = {'planar': lambda: planar(n, rng), 'nothing': lambda: [],
             'dense': lambda: [(i, j) for i in range(n) for j in range(i)]}
    return adjacency_of(pairs.get(request.param, lambda: request.param(n))(), n)


def test_the_columns_are_those_of_brute_force(graph):
    order, column, rows = minimum_degree(*graph)
    assert column[-1] == len(rows)
    found = [rows[column[k]:column[k + 1]].tolist() for k in range(50)]
    expected = eliminate(*graph, order)
    for ours, theirs in zip(found, expected, strict=True):
        assert set(ours) == theirs and len(ours) == len(theirs)


@pytest.mark.parametrize('seed', range(6))
def test_it_fills_hardly_more_than_scipys_mmd(seed):
    """A Laplacian that SciPy factors with its own order: splu.perm_c is where each column goes."""
    rng = np.random.default_rng(seed)
    n = 300
    start, adjacent = adjacency_of(planar(n, rng), n)
    degree = np.diff(start)
    row = np.repeat(np.arange(n), degree)
    laplacian = coo_array((-np.ones(len(row)), (row, adjacent)), shape=(n, n)).tocsc()
    laplacian += coo_array((degree + 1.0, (range(n), range(n))), shape=(n, n)).tocsc()
    splu_of = splu(laplacian, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                   options={'SymmetricMode': True})
    theirs = sum(map(len, eliminate(start, adjacent, np.argsort(splu_of.perm_c))))
    _, _, rows = minimum_degree(start, adjacent)
    natural = sum(map(len, eliminate(start, adjacent, np.arange(n))))
    assert len(rows) <= 1.3 * theirs < natural


# Dissection


def torus(side):
    """Return the pairs of a torus of side x side nodes: alike everywhere."""
    k = np.arange(side**2).reshape(side, side)
    return [pair for axis in range(2)
            for pair in zip(k.ravel().tolist(), np.roll(k, 1, axis).ravel().tolist(), strict=True)]


BOTH = pytest.mark.parametrize('dissect', [dissection.dissect, ordering.dissect],
                               ids=['separators', 'levels'])


@BOTH
def test_what_is_cut_leaves_small_parts_that_come_first(dissect):
    """Also of two tori that nothing joins; the cuts of a part come after those within it."""
    pairs = torus(30)
    graph = adjacency_of(pairs + [(a + 900, b + 900) for a, b in pairs], 1800)
    stage = dissect(*graph)
    whole = [(a, b) for a, b in pairs if not stage[a] and not stage[b]]
    labels = connected_components(coo_array((np.ones(len(whole)), np.transpose(whole)),
                                            shape=(900, 900)))[1]
    assert np.bincount(labels[stage[:900] == 0]).max() <= 120
    order, _, rows = minimum_degree(*graph, stage)
    assert_array_equal(np.sort(order), np.arange(1800))
    assert (np.diff(stage[order]) >= 0).all() and len(np.unique(stage)) > 3
    assert len(rows) == sum(map(len, eliminate(*graph, order)))


def tree(n, rng):
    return [(int(rng.integers(k)), k) for k in range(1, n)]


def scattered(n, rng):
    """Return the pairs of ten paths that nothing joins, and of nodes without any."""
    return [(k, k + 1) for k in range(n - 1) if k % (n // 10) and k % 7]


@BOTH
@pytest.mark.parametrize('shape', [tree, planar, scattered])
def test_every_graph_is_ordered_whole_and_its_parts_are_apart(dissect, shape, rng):
    graph = adjacency_of(shape(700, rng), 700)
    stage = dissect(*graph)
    order, _, rows = minimum_degree(*graph, stage)
    assert_array_equal(np.sort(order), np.arange(700))
    assert len(rows) == sum(map(len, eliminate(*graph, order)))
    assert_array_equal(stage, dissect(*graph))


def work(graph, stage):
    _, column, _ = minimum_degree(*graph, stage)
    return float(((np.diff(column) + 1.0)**2).sum() / 2)


def test_of_many_streets_separators_spare_a_third_of_the_work(rng):
    """Minimum degree and levels do 1.5 and 1.7 times as much; their separators promise as much."""
    n = 16_000
    factors = simulate_world(n, 2 * n, WorldOptions(), rng).graph.between
    graph = adjacency_of(np.stack((factors.i, factors.j), axis=1).tolist(), n)
    by_separators, by_levels = dissection.dissect(*graph), ordering.dissect(*graph)
    own = work(graph, by_separators)
    assert 1.4 * own < work(graph, np.zeros(n, np.int32))
    assert 1.5 * own < work(graph, by_levels)
    assert not dissection.is_promising([by_separators, by_levels])
    # Where levels are the better order, they promise to be.
    graph = adjacency_of([(k, k + step) for step in (1, 60) for k in range(3600 - step)], 3600)
    by_separators, by_levels = dissection.dissect(*graph), ordering.dissect(*graph)
    assert work(graph, by_levels) < work(graph, by_separators)
    assert dissection.is_promising([by_separators, by_levels])
    assert not dissection.is_promising([by_levels, by_separators])
