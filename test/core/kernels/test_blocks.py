# SPDX-License-Identifier: Apache-2.0
"""The compiled products of blocks, and `LinearSystem` that uses them, against NumPy and CSR."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from systems import SHAPES, random_system

from l1slam_ros.core.kernels import blocks as kernels
from l1slam_ros.core.kernels import cholesky

SIZES = [1, 2, 3, 6]


@pytest.fixture(params=SIZES)
def k(request):
    return request.param


@pytest.fixture(params=SHAPES, ids=lambda shape: shape.__name__)
def system(request, k, rng):
    return random_system(request.param(9), 9, k, rng)


def test_the_matrix_has_the_blocks_in_their_places(system, k):
    dense = np.zeros((len(system.b), (system.size + 1) * k))
    for f, (i, j) in enumerate(system.keyframe):
        dense[f * k:(f + 1) * k, i * k:(i + 1) * k] += system.blocks[f, 0]
        dense[f * k:(f + 1) * k, j * k:(j + 1) * k] += system.blocks[f, 1]
    assert_array_equal(system.A.toarray(), dense[:, :-k])
    assert system.A.nnz == np.count_nonzero(dense)


def test_blocks_of_what_is_held_fixed_are_no_columns(k, rng):
    """A graph's anchor has Jacobians too: those are left out of the matrix."""
    system = random_system(SHAPES[0](5), 5, k, rng)
    system.blocks[:] = rng.standard_normal(system.blocks.shape)
    x, y = rng.standard_normal(5 * k), rng.standard_normal(len(system.b))
    assert system.A.shape == (5 * k, 5 * k)
    assert_allclose(system.times(x), system.A @ x, atol=1e-12)
    assert_allclose(system.transposed_times(y), system.A.T @ y, atol=1e-12)


def test_products_equal_those_of_the_matrix(system, rng):
    x, y = rng.standard_normal(system.A.shape[1]), rng.standard_normal(len(system.b))
    assert_allclose(system.times(x), system.A @ x, atol=1e-12)
    assert_allclose(system.transposed_times(y), system.A.T @ y, atol=1e-12)


@pytest.mark.parametrize('entries', [slice(0, 2), slice(2, 3)])
def test_a_part_is_its_rows_and_columns(entries, rng):
    system = random_system(SHAPES[-2](9), 9, 3, rng)
    part = system.part(entries)
    rows, columns = (np.arange(size).reshape(-1, 3)[:, entries].ravel()
                     for size in system.A.shape)
    assert_array_equal(part.A.toarray(), system.A.toarray()[np.ix_(rows, columns)])
    assert_array_equal(part.b, system.b[rows])
    assert part.block_size == len(range(3)[entries])


def test_vectors_duals_and_jacobians_are_whitened(k, rng):
    roots, J = rng.standard_normal((2, 7, k, k))
    e = rng.standard_normal((7, k))
    assert_allclose(kernels.whiten(roots, e, (0,) * k), np.einsum('frc,fc->fr', roots, e),
                    atol=1e-12)
    assert_allclose(kernels.unwhiten(roots, e, (0,) * k), np.einsum('frc,fr->fc', roots, e),
                    atol=1e-12)
    blocks = np.full((7, 2, k, k), np.pi)
    for side in range(2):
        written = blocks.copy()
        kernels.whiten_blocks(roots, J, side, written, (0,) * k)
        assert_allclose(written[:, side], roots @ J, atol=1e-12)
        assert_array_equal(written[:, 1 - side], np.pi)


class Dense:
    """A lower triangle of blocks as one panel of full width: where the places are is plain."""

    def __init__(self, system, k):
        n, (i, j) = system.size, system.keyframe.T
        self.n, self.k, self.turned = n, k, i > j
        self.panels = np.full((n * k) ** 2, np.pi)  # to be written over
        row, col = np.maximum(i, j), np.minimum(i, j)
        self.address = np.column_stack((self.at(i, i), self.at(j, j), self.at(row, col)))
        self.address[i == n, 0] = self.address[j == n, 1] = -1
        self.address[(i == n) | (j == n), 2] = -1
        self.width = np.full((len(i), 3), n * k)
        self.corner, self.stride = self.at(np.arange(n), np.arange(n)), np.full(n, n * k)

    def at(self, row, col):
        return (row * self.n * self.k + col) * self.k

    @property
    def places(self):
        return self.address, self.width, self.turned, self.corner, self.stride

    @property
    def lower(self):
        """The blocks on and below the diagonal, the rest zero."""
        blocks = np.kron(np.tri(self.n), np.ones((self.k, self.k)))
        return blocks * self.panels.reshape(self.n * self.k, -1)


def lower_blocks(matrix, k):
    return np.kron(np.tri(len(matrix) // k), np.ones((k, k))) * matrix


@pytest.mark.parametrize('as_tuple', [True, False])
def test_a_matrix_is_assembled(system, k, as_tuple, rng):
    """J'WJ + D + 0.7 C, C of the first factors alone."""
    weights, diagonal = rng.uniform(0.1, 3, len(system.b)), rng.uniform(0, 1, (system.size, k))
    m = len(system.keyframe) - 2
    curvature = rng.standard_normal((m, 2 * k, 2 * k))
    curvature += curvature.transpose(0, 2, 1)
    C = np.zeros(((system.size + 1) * k,) * 2)
    for f in range(m):
        rows = (system.keyframe[f][:, None] * k + np.arange(k)).ravel()
        np.add.at(C, np.ix_(rows, rows), curvature[f])
    dense, A = Dense(system, k), system.A.toarray()
    cholesky.assemble(dense.panels, *dense.places, system.blocks, weights.reshape(-1, k), diagonal,
                      curvature, 0.7, (0,) * k if as_tuple else np.zeros(k))
    expected = A.T @ (weights[:, None] * A) + np.diag(diagonal.ravel()) + 0.7 * C[:-k, :-k]
    assert_allclose(dense.lower, lower_blocks(expected, k), atol=1e-11)
    assert_allclose(dense.panels.reshape(expected.shape), dense.lower)
