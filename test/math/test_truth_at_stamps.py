# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Poses at stamps between others: interpolated, neither beyond these nor across a hole."""

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import poses_at


def test_nothing_is_extrapolated_nor_bridged():
    times, poses = np.array([10, 20, 30, 90, 100]), np.arange(15.0).reshape(5, 3) / 10
    at = np.array([8, 9, 10, 25, 30, 31, 32, 60, 88, 89, 90, 95, 100, 101, 102])
    rows, found = poses_at(se2, times, poses, at, 20, 1)
    assert at[rows].tolist() == [9, 10, 25, 30, 31, 89, 90, 95, 100, 101]
    # What lies beyond the end by rounding alone is at the end.
    np.testing.assert_allclose(found[[0, -1]], poses[[0, -1]], atol=1e-12)
