# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The compiled products of blocks, and `LinearSystem` that uses them, against NumPy and CSR."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from systems import SHAPES, random_system

from l1slam_ros.core import native

pytestmark = pytest.mark.usefixtures('level')
SIZES = [1, 2, 3, 6]


@pytest.fixture(params=SIZES)
def k(request):
    return request.param


@pytest.fixture(params=SHAPES, ids=lambda shape: shape.__name__)
def system(request, k, rng):
    return random_system(request.param(9), 9, k, rng)


def test_the_matrix_has_the_blocks_in_their_places_and_products_are_its_own(system, k, rng):
    """But those of a keyframe that is held fixed: it has Jacobians, too, and no columns."""
    system.blocks[:] = rng.standard_normal(system.blocks.shape)
    dense = np.zeros((len(system.b), (system.size + 1) * k))
    for f, (i, j) in enumerate(system.keyframe):
        dense[f * k:(f + 1) * k, i * k:(i + 1) * k] += system.blocks[f, 0]
        dense[f * k:(f + 1) * k, j * k:(j + 1) * k] += system.blocks[f, 1]
    A = dense[:, :-k]
    x, y = rng.standard_normal(A.shape[1]), rng.standard_normal(len(A))
    assert_array_equal(system.A.toarray(), A)
    assert system.A.nnz == np.count_nonzero(A)
    assert_allclose(system.times(x), A @ x, atol=1e-12)
    assert_allclose(system.transposed_times(y), A.T @ y, atol=1e-12)


def test_vectors_and_jacobians_are_whitened(k, rng):
    roots, J = np.triu(rng.standard_normal((7, k, k))), rng.standard_normal((7, 2, k, k))
    e = rng.standard_normal((7, k))
    assert_allclose(native.blocks.whiten(roots, e), np.einsum('frc,fc->fr', roots, e),
                    atol=1e-12)
    assert_allclose(native.blocks.unwhiten_dual(roots, e),
                    np.einsum('fcr,fc->fr', roots, e), atol=1e-12)
    blocks = J.copy()
    native.blocks.whiten_blocks(roots, blocks)
    assert_allclose(blocks, roots[:, None] @ J, atol=1e-12)
