# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The measures of the scan front end tell which scan of a log a corrected pose is of."""

import bz2
import importlib
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / 'benchmarks'))
scans = importlib.import_module('scans')


def test_a_corrected_pose_is_of_the_one_scan_that_was_written_at_its_time(tmp_path):
    """Two scans within the logger's six digits are not told apart; the log begins at 500 s."""
    log = tmp_path / 'log.clf.bz2'
    written = np.array([10.12344, 10.92344, 1234.561, 1234.564, 2001.37])
    stamps = np.array([600.1, 600.9, 1824.4, 1824.6, 2591.3])
    lines = ['ODOM 0 0 0 0 0 0 600.1 host 10.1234', *(
        f'FLASER 2 1.0 2.0 0 0 0 0 0 0 {stamp:.6f} host {at:.6f}'
        for stamp, at in zip(stamps, written, strict=True))]
    log.write_bytes(bz2.compress('\n'.join(lines).encode()))
    times = np.round((500 + np.array([10.1234, 10.9234, 1234.56, 2001.37, 2002.0])) * 1e9)
    rows, found = scans.scans_of(log, times.astype(np.int64))
    assert rows.tolist() == [0, 1, 3]
    np.testing.assert_array_equal(found, np.round(stamps[[0, 1, 4]] * 1e9))
