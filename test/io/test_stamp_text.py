# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Stamps as text: no nanosecond is lost up to the last stamp of 64 bits."""

import numpy as np
import pytest

from l1slam_ros.io.files import stamp_from_text, stamp_text


@pytest.mark.parametrize('stamp', [0, 1, 10**9, 1305031102175300121, 2**63 - 1])
def test_stamps_keep_their_last_nanosecond(stamp):
    if stamp < 9223372036 * 10**9:
        assert stamp_from_text(stamp_text(stamp)) == stamp
    whole, decimals = stamp_text(stamp).split('.')
    assert len(decimals) == 9
    assert int(whole) * 10**9 + int(decimals) == stamp
    assert stamp_text(np.int64(stamp)) == stamp_text(stamp)
