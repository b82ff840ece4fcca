# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Of a database that is cut all rows are used that are there whole, whatever their size."""

import re
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from messages import TYPES, header, odometry, of_rosbags
from records import read
from rosbags.rosbag2 import StoragePlugin

from bags import rosbag2_directory

KIND = 'nav_msgs/msg/Odometry'
# [bytes] Frames so long that rows fit a page, fill it, or go on in some to many others.
SIZES = [1, 40, 430, 470, 480, 490, 900, 1000, 5_000, 30_000]


def recording(count):
    """Yield odometry that goes on by a metre each second, to a centimetre sideways."""
    for k in range(count):
        message = odometry(of_rosbags, header(of_rosbags, 1 + k, 0, 'o' * SIZES[k % len(SIZES)]),
                           position=(float(k), 0.01 * (k % 2), 0.0), covariance=np.zeros(36))
        yield '/odom', KIND, (1 + k) * 10**9, bytes(TYPES.serialize_cdr(message, KIND))


@pytest.mark.parametrize(('page_size', 'first'), [(512, 0.3), (65536, 0.8)])
def test_of_a_cut_database_the_rows_before_are_used(tmp_path, page_size, first):
    path = rosbag2_directory(tmp_path / 'a', recording(90), StoragePlugin.SQLITE3) / 'a.db3'
    with closing(sqlite3.connect(path)) as database:
        database.execute(f'PRAGMA page_size = {page_size}')
        database.execute('VACUUM')
    whole = path.read_bytes()
    assert int.from_bytes(whole[16:18], 'big') % 65535 == page_size % 65535
    expected = read(path).graph.between.measurement
    assert len(expected) == 89
    cut, counts = tmp_path / 'cut.db3', []
    for length in first * len(whole), 0.9 * len(whole), len(whole) - 1:
        cut.write_bytes(whole[:int(length)])
        record = read(cut)
        found = record.graph.between.measurement
        np.testing.assert_array_equal(found, expected[:len(found)])
        said, = (one for one in record.skipped if ' damaged' in one)
        assert f'it breaks off after {int(length):,} bytes; ' in said
        counts.append(len(found) + 1)
        assert int(re.search('; ([0-9,]+) messages before', said)[1]) == counts[-1]
    assert counts == sorted(counts) and counts[0] < 70 and counts[-1] >= 80
