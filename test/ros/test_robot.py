# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How far ahead transforms are stamped."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from l1slam_ros.ros.robot import Horizon

TOLERANCE = 0.1  # [s]
N = 1000


def regular(rate):
    return lambda rng: np.full(N, 1 / rate)


PATTERNS = {
    **{f'{rate} Hz': regular(rate) for rate in (1, 5, 10, 20, 50, 200)},
    '10 Hz, intervals vary by half': lambda rng: rng.uniform(0.05, 0.15, N),
    '10 Hz, stamps vary by half': lambda rng: 0.1 + np.diff(rng.uniform(-0.05, 0.05, N + 1)),
    '20 Hz, a tenth is lost': lambda rng: 0.05 * rng.geometric(0.9, N),
    'two at a time': lambda rng: np.tile([0.01, 0.39], N // 2),
    'it becomes four times as slow': lambda rng: np.repeat([0.05, 0.2], N // 2),
    'it pauses now and then': lambda rng: np.where(np.arange(N) % 200 == 100, 5.0, 0.1),
}


@pytest.mark.parametrize('name', PATTERNS)
def test_what_is_out_reaches_to_the_next_message(name, rng):
    stamps = 10**18 + np.cumsum(1e9 * PATTERNS[name](rng)).astype(np.int64)
    horizon = Horizon()
    out = 0
    late = 0
    ahead = []
    for k, stamp in enumerate(stamps.tolist()):
        late += k > 0 and stamp > out
        horizon.note(stamp)
        ahead.append(horizon.ahead(TOLERANCE))
        out = max(out, stamp + ahead[-1])
    assert late <= 0.01 * N, name
    # No further than there is need to: so old a transform has its part in what is found.
    assert min(ahead) >= 1e8 and np.median(ahead) <= max(
        1e8, 1.5 * np.diff(stamps)[np.diff(stamps) < 4e9].max())


def test_the_tolerance_is_the_least_and_time_that_goes_back_begins_anew():
    horizon = Horizon()
    for stamp in range(10**9, 21 * 10**9, 10**9):
        horizon.note(stamp)
    assert horizon.ahead(0.1) == 15 * 10**8 and horizon.ahead(3.0) == 3 * 10**9
    horizon.note(10**9)
    assert horizon.ahead(0.1) == 3 * 10**8
    # Never further than this, unless the tolerance is.
    for stamp in range(10**9, 10**12, 10**11):
        horizon.note(stamp)
    assert horizon.ahead(0.1) == 2 * 10**9
