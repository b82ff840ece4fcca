# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""An array that grows: views stay valid, copies part ways, the cost stays linear."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from l1slam_ros.core.graph.growable_array import GrowingArray, few_rows


def rows(first, count):
    return np.arange(2 * first, 2 * (first + count), dtype=float).reshape(count, 2)


def test_rows_that_there_is_room_for_move_none():
    array = GrowingArray((2,), room=100)
    home = array.view().__array_interface__['data'][0]
    assert len(array) == 0
    for k in range(100):
        array.extend(rows(k, 1))
    assert array.view().__array_interface__['data'][0] == home
    array.extend(rows(100, 1))
    assert (array.view() == rows(0, 101)).all()


@pytest.mark.skipif(not Path('/proc/self/smaps').exists(), reason='asks Linux for its pages')
def test_rows_come_into_small_pages():
    """A huge one may take milliseconds to be had."""
    array = GrowingArray((2,), room=10**6)
    home = array.view().__array_interface__['data'][0]
    maps = re.split(r'\n(?=[0-9a-f]+-)', Path('/proc/self/smaps').read_text())
    own = next(text for text in maps if int(text.split('-')[0], 16) <= home
               < int(re.split('[- ]', text, maxsplit=2)[1], 16))
    assert re.search(r'VmFlags:.* nh', own) or 'VmFlags' not in own


def test_appending_moves_the_rows_only_now_and_then():
    array = GrowingArray((2,))
    moves, home = 0, None
    for k in range(4096):
        array.extend(rows(k, 1))
        address = array.view().__array_interface__['data'][0]
        moves, home = moves + (address != home), address
    assert moves < 12


def test_rows_that_are_many_are_moved_once_more():
    """Of 16,384 factors on it took a message 40 ms to have its own appended."""
    array, moves, home = GrowingArray((2,)), 0, None
    for k in range(200):
        array.extend(rows(1000 * k, 1000))
        address = array.view().__array_interface__['data'][0]
        moves, home = moves + (k >= 20 and address != home), address
    assert moves == 0
    assert (array.view() == rows(0, 200_000)).all()
    stored = pickle.dumps(array)
    assert len(stored) < 1.01 * array.view().nbytes
    again = pickle.loads(stored)
    again.append(rows(200_000, 1)[0])
    assert (again.view() == rows(0, 200_001)).all() and len(array) == 200_000


def test_one_row_is_appended_as_several_are_and_the_last_ones_are_taken_back():
    array, seen = GrowingArray((2,)), []
    for k in range(40):
        array.append(rows(k, 1)[0])
        seen.append(array.view())
    assert all((view == rows(0, k + 1)).all() for k, view in enumerate(seen))
    array.shorten(17)
    assert (array.view() == rows(0, 17)).all()
    array.append(rows(30, 1)[0])
    assert (array.view() == np.concatenate((rows(0, 17), rows(30, 1)))).all()


@pytest.mark.parametrize('wanted', [[0, 8, 3, 3], [-1], []])
@pytest.mark.parametrize('array', [rows(0, 9), np.arange(9), np.arange(9) > 4],
                         ids=['rows', 'numbers', 'mask'])
def test_few_rows_are_those_that_numpy_finds(array, wanted):
    wanted = np.array(wanted, np.int64)
    found = few_rows(array, wanted)
    np.testing.assert_array_equal(found, array[wanted])
    assert found.dtype == array.dtype and not np.shares_memory(found, array)
