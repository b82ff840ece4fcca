# SPDX-License-Identifier: Apache-2.0
"""An array that grows: views stay valid, copies part ways, the cost stays linear."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.graph.growable_array import GrowingArray


def rows(first, count):
    return np.arange(2 * first, 2 * (first + count), dtype=float).reshape(count, 2)


def test_it_holds_what_was_appended():
    array = GrowingArray((2,))
    expected = np.zeros((0, 2))
    for count in (0, 1, 3, 40, 0, 1000):
        new = rows(len(expected), count)
        array.extend(new)
        expected = np.concatenate((expected, new))
        assert len(array) == len(expected)
        assert_array_equal(array.view(), expected)


@pytest.mark.parametrize('shape, dtype', [((), np.int64), ((3,), np.float64), ((2, 2), bool)])
def test_rows_keep_shape_and_type(shape, dtype):
    array = GrowingArray(shape, dtype)
    array.extend(np.ones((5, *shape), dtype))
    assert array.view().shape == (5, *shape)
    assert array.view().dtype == array.copy().view().dtype == dtype


def test_views_stay_as_they_were():
    array = GrowingArray((2,))
    views = []
    for k in range(200):
        views.append(array.view())
        array.extend(rows(k, 1))
    for k, view in enumerate(views):
        assert_array_equal(view, rows(0, k))


def test_a_copy_and_its_original_grow_apart():
    original = GrowingArray((2,))
    original.extend(rows(0, 20))
    original.extend(rows(20, 1))  # now there is room to spare behind the rows
    copy = original.copy()
    copy.extend(rows(100, 1))
    original.extend(rows(200, 1))
    second = copy.copy()
    second.extend(rows(300, 1))
    assert_array_equal(original.view(), np.concatenate((rows(0, 21), rows(200, 1))))
    assert_array_equal(copy.view(), np.concatenate((rows(0, 21), rows(100, 1))))
    assert_array_equal(second.view(), np.concatenate((copy.view(), rows(300, 1))))


def test_appending_moves_the_rows_only_now_and_then():
    array = GrowingArray((2,))
    moves, home = 0, None
    for k in range(4096):
        array.extend(rows(k, 1))
        address = array.view().__array_interface__['data'][0]
        moves, home = moves + (address != home), address
    assert moves < 12
