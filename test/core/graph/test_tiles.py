# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Factors in tiles: there and back, sorted by keyframe, filled up with what does nothing."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from l1slam_ros.core.graph.tiles import Tiles


@pytest.mark.parametrize('m', [0, 1, 15, 16, 17, 100])
def test_values_come_back_in_the_order_of_the_system(m, rng):
    keyframe = rng.integers(0, 10, (m, 2))
    values = rng.integers(-99, 99, (m, 5)).astype(float)
    tiles = Tiles(keyframe, 10, 16)
    packed = tiles.pack(values)
    assert packed.shape == (-(-m // 16), 5, 16) and packed.dtype == np.float32
    assert_array_equal(tiles.unpack(packed), values)


def test_factors_are_sorted_by_keyframe_and_padded_with_the_scratch_slot(rng):
    keyframe = rng.integers(0, 10, (20, 2))
    tiles = Tiles(keyframe, 10, 16)
    first, second = tiles.keyframes.reshape(2, 2, 16).transpose(1, 0, 2).reshape(2, 32)
    assert_array_equal(np.stack((first, second), axis=1)[:20],
                       keyframe[np.lexsort((keyframe[:, 1], keyframe[:, 0]))])
    assert_array_equal(first[20:], 10)
    assert_array_equal(second[20:], 10)
