# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Cells without repetition are those that NumPy finds."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.robust.places import _cells


@pytest.mark.parametrize('count', [1, 2, 300])
def test_cells_are_those_of_numpy_in_its_order(count):
    corners = np.random.default_rng(1).integers(-1, 3, (count, 4)) * -1.0  # some are -0.0
    cells, cell = _cells(corners)
    expected, inverse = np.unique(corners, axis=0, return_inverse=True)
    assert_array_equal(cells, expected)
    assert_array_equal(cell, inverse.ravel())


def test_no_corners_make_no_cells():
    cells, cell = _cells(np.zeros((0, 4)))
    assert cells.shape == (0, 4) and not len(cell)
