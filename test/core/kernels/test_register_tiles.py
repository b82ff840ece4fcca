# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The tiles of the Cholesky factorisation: dense panels of every width and height."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from l1slam_ros.core import kernels

GAP = 3  # numbers between rows
MARK = 7.0


def factorised(panels, columns, rows, stride):
    """Factor one panel of so many columns and rows, the second of nothing; blocks of one."""
    first = np.array([0, columns, max(rows, columns)], np.int32)[:3 if rows > columns else 2]
    count = len(first) - 1
    below = rows - columns
    start = np.array([0, rows, rows + below])[:count + 1]
    pattern = np.concatenate((np.arange(rows), np.arange(columns, rows))).astype(np.int32)
    owner = np.repeat(np.arange(count, dtype=np.int32), np.diff(first))
    offset = np.array([0, rows * stride, len(panels)])[:count + 1]
    return kernels.cholesky.factorise(
        panels, first, start, pattern, offset, np.array([stride, below + GAP])[:count], owner,
        np.zeros(count, np.int8), 0, np.full((2, count), -1, np.int32), np.zeros(count, np.int64),
        1)


@pytest.mark.parametrize('below', [0, 1, 5, 6, 7, 13, 40])
@pytest.mark.parametrize('columns', [1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 13, 16, 21, 40])
def test_panels_of_every_size(columns, below, rng):
    rows, stride = columns + below, columns + GAP
    half = rng.standard_normal((rows, 2 * rows))
    matrix = half @ half.T
    panels = np.full(rows * stride + below * (below + GAP), MARK)
    upper = panels[:rows * stride].reshape(rows, stride)
    lower = panels[rows * stride:].reshape(below, below + GAP)
    upper[:, :columns] = np.tril(matrix)[:, :columns]
    lower[:, :below] = np.tril(matrix)[columns:, columns:]
    assert factorised(panels, columns, rows, stride) == rows
    expected = np.linalg.cholesky(matrix)
    assert_allclose(np.tril(upper[:, :columns]), expected[:, :columns], rtol=1e-10, atol=1e-10)
    assert_allclose(np.tril(lower[:, :below]), expected[columns:, columns:], rtol=1e-10,
                    atol=1e-10)
    # What lies beside the columns is another panel's, maybe another thread's.
    assert_array_equal(upper[:, columns:], MARK)
    assert_array_equal(lower[:, below:], MARK)


@pytest.mark.parametrize('bad', [0, 1, 7, 8, 15, 20])
def test_the_first_bad_pivot_is_told(bad, rng):
    half = rng.standard_normal((21, 42))
    matrix = half @ half.T
    matrix[bad, bad] = -1.0
    panels = np.tril(matrix).ravel()
    assert factorised(panels, 21, 21, 21) == bad
