# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Minimum degree, dissection and layouts, against plain elimination and SciPy's MMD."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay
from systems import SHAPES, grid

from l1slam_ros.core.native import dissection, ordering, symbolic
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world


def minimum_degree(start, adjacent, stage=None):
    """Return the order; nodes of lower stages come first."""
    return ordering.minimum_degree(
        start, adjacent, np.zeros(len(start) - 1, np.int32) if stage is None else stage)[0]


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


def work_of(columns):
    return sum((len(column) + 1.0)**2 for column in columns) / 2


def test_an_order_has_each_node_once_and_tells_its_work(graph, rng):
    """Also by stages of any kind, here one for each tenth node."""
    for stage in np.zeros(50, np.int32), rng.integers(5, size=50, dtype=np.int32):
        order, work = ordering.minimum_degree(*graph, stage)
        assert_array_equal(np.sort(order), np.arange(50))
        assert work == work_of(eliminate(*graph, order))


def test_the_layout_of_any_order_holds_what_elimination_fills_in(graph, rng):
    for order in minimum_degree(*graph), rng.permutation(50).astype(np.int32):
        position, first, start, rows, _, work = symbolic.lay_out(*graph, order)
        assert work == work_of(eliminate(*graph, order))
        again = np.argsort(position)
        expected = [{k, *position[list(column)].tolist()}
                    for k, column in enumerate(eliminate(*graph, again))]
        assert sum(map(len, expected)) == sum(map(len, eliminate(*graph, order))) + 50
        for s, (low, high) in enumerate(zip(first[:-1], first[1:], strict=True)):
            panel = rows[start[s]:start[s + 1]].tolist()
            # Its own columns, then the rows of the last, sorted; each other has no more.
            assert panel[:high - low] == list(range(low, high))
            assert panel[high - low - 1:] == sorted(expected[high - 1])
            for k in range(low, high):
                assert expected[k] <= set(panel)


def test_what_no_new_factor_joins_stays_in_a_graph_that_grows(rng):
    """A grid, to whose last rows a tenth comes: the order is whole, and as good as one anew."""
    pairs = grid(900)
    before, after = (adjacency_of([p for p in pairs if max(p) < n], n) for n in (810, 900))
    layout = symbolic.lay_out(*before, minimum_degree(*before))
    resumed, anew = ordering.resume(*after, *layout[:4]), minimum_degree(*after)
    assert_array_equal(np.sort(resumed), np.arange(900))
    works = [symbolic.lay_out(*after, order)[-1] for order in (resumed, anew)]
    assert works[0] < 1.3 * works[1] and works[0] == work_of(eliminate(*after, resumed))
    kept = np.argsort(layout[0])
    staying = sum(np.isin(resumed[k - 1:k + 1], kept[:300]).all() for k in range(1, 900))
    assert staying > 150
    # Nothing new: all stays, in the same order.
    assert_array_equal(ordering.resume(*before, *layout[:4]), kept)


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
    ours = sum(map(len, eliminate(start, adjacent, minimum_degree(start, adjacent))))
    natural = sum(map(len, eliminate(start, adjacent, np.arange(n))))
    assert ours <= 1.1 * theirs < natural


# Dissection


def torus(side):
    """Return the pairs of a torus of side x side nodes: alike everywhere."""
    k = np.arange(side**2).reshape(side, side)
    return [pair for axis in range(2)
            for pair in zip(k.ravel().tolist(), np.roll(k, 1, axis).ravel().tolist(), strict=True)]


BOTH = pytest.mark.parametrize('dissect', [dissection.dissect, ordering.levels],
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
    order = minimum_degree(*graph, stage)
    assert_array_equal(np.sort(order), np.arange(1800))
    assert len(np.unique(stage)) > 3
    # But for the few that nothing fills in for.
    lowest_to_come = np.minimum.accumulate(stage[order][::-1])[::-1]
    assert (stage[order] > lowest_to_come).mean() < 0.05


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
    order, work = ordering.minimum_degree(*graph, stage)
    assert_array_equal(np.sort(order), np.arange(700))
    assert work == work_of(eliminate(*graph, order))
    assert_array_equal(stage, dissect(*graph))


def work(graph, stage):
    return ordering.minimum_degree(*graph, stage)[1]


def test_of_many_streets_separators_spare_a_fifth_of_the_work(rng):
    """Minimum degree and levels do 1.3 and 1.57 times as much."""
    n = 16_000
    factors = simulate_world(n, 2 * n, WorldOptions(), rng).graph.between
    graph = symbolic.neighbours(np.stack((factors.i, factors.j), axis=1), n)
    own = work(graph, dissection.dissect(*graph))
    assert 1.25 * own < work(graph, np.zeros(n, np.int32))
    assert 1.5 * own < work(graph, ordering.levels(*graph))
    # Levels are the better order where all is alike.
    graph = adjacency_of([(k, k + step) for step in (1, 60) for k in range(3600 - step)], 3600)
    assert 1.3 * work(graph, ordering.levels(*graph)) < work(graph, dissection.dissect(*graph))


# What does not fit together


def test_arguments_that_do_not_fit_are_named():
    start, adjacent = adjacency_of([(0, 1), (1, 2)], 3)
    stage = order = np.arange(3, dtype=np.int32)
    layout = symbolic.lay_out(start, adjacent, order)[:4]
    keyframe = np.array([(0, 1), (1, 2)])
    panels = len(layout[1]) - 1
    offset, stride = np.arange(panels + 1), np.ones(panels, np.int64)
    addresses = symbolic.block_addresses
    for expected, function, *arguments in (
            ('stage', ordering.minimum_degree, start, adjacent, stage[:2]),
            ('start', ordering.minimum_degree, start[::-1].copy(), adjacent, stage),
            ('start', ordering.levels, start[:0], adjacent),
            ('adjacent', dissection.dissect, start, adjacent + 1),
            ('order', symbolic.lay_out, start, adjacent, order[:2]),
            ('order', symbolic.lay_out, start, adjacent, order // 2),
            ('order', symbolic.lay_out, start, adjacent, order + 1),
            ('position', ordering.resume, start[:2], adjacent[:1] * 0, *layout),
            ('keyframe', symbolic.neighbours, -keyframe, 3),
            ('keyframe', symbolic.neighbours, keyframe[:, :1].copy(), 3),
            ('size and the rows of keyframe', symbolic.neighbours, keyframe, -1),
            ('offset and stride', addresses, keyframe, *layout, stride, stride, 1),
            ('rows', addresses, keyframe, *layout[:3], layout[3] * 0, offset, stride, 1)):
        with pytest.raises(TypeError, match=f'{function.__name__}: {expected} must'):
            function(*arguments)
