# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Stamps of logs whose clocks were rounded, set back, or late for a line."""

import numpy as np
import pytest

from l1slam_ros.io.scans.log_stamps import rising

SECOND = 10**9
TENTHS = 1000 * SECOND + SECOND // 10 * np.arange(300)


def test_stamps_that_rise_stay():
    stamps, rows, back = rising(TENTHS)
    np.testing.assert_array_equal(stamps, TENTHS)
    np.testing.assert_array_equal(rows, np.arange(300))
    assert back == 0


@pytest.mark.parametrize('off', [-SECOND, SECOND, 40 * SECOND, -400 * SECOND])
def test_a_line_that_is_stamped_late_or_early_is_left_out(off):
    spoilt = TENTHS.copy()
    spoilt[100] += off
    stamps, rows, back = rising(spoilt)
    np.testing.assert_array_equal(rows, np.delete(np.arange(300), 100))
    np.testing.assert_array_equal(stamps, np.delete(TENTHS, 100))
    assert back == 0


def test_rounded_stamps_are_spread_over_the_time_to_the_next():
    """Of ten scans a second, by a clock that knows seconds."""
    stamps, rows, _ = rising(TENTHS // SECOND * SECOND)
    np.testing.assert_array_equal(rows, np.arange(300))
    np.testing.assert_array_equal(stamps, TENTHS)


def test_a_log_without_a_clock_goes_on_at_ten_scans_a_second():
    stamps, _, _ = rising(np.zeros(5, np.int64))
    np.testing.assert_array_equal(stamps, SECOND // 10 * np.arange(5))


def test_a_clock_that_is_set_back_goes_on():
    spoilt = TENTHS.copy()
    spoilt[120:] -= 60 * SECOND
    stamps, rows, back = rising(spoilt)
    np.testing.assert_array_equal(rows, np.arange(300))
    np.testing.assert_array_equal(stamps, TENTHS)
    assert back == 60 * SECOND
