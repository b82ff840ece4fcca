# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: what their lines mean, and what is said of those that are damaged."""

import gzip

import numpy as np
import pytest

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.scans.carmen import read_carmen

LINE = 'FLASER 4 1 2 3 4 1.04 2 0 1 2 0 {stamp} host 0.1'


def log(path, *stamps):
    path.write_text('\n'.join(['# CARMEN Logfile', 'ODOM 0 0 0 0 0 0 1 host 0'] + [
        LINE.format(stamp=stamp) for stamp in stamps]))
    return path


def test_a_line_is_a_scan_and_where_the_wheels_had_the_robot(tmp_path):
    found = read_carmen(log(tmp_path / 'a.clf', 10.5, 11.25))
    assert [scan.stamp for scan in found.scans] == [10_500_000_000, 11_250_000_000]
    np.testing.assert_array_equal(found.scans[0].ranges, [1, 2, 3, 4])
    np.testing.assert_array_equal(found.wheels, [(1, 2, 0)] * 2)
    assert found.mount.x == pytest.approx(0.04) and not found.skipped
    # Four rays over half a turn: each in the middle of its part.
    assert found.scans[0].angle_increment == pytest.approx(np.pi / 4)
    assert found.scans[0].angle_min == pytest.approx(-3 * np.pi / 8)


def test_it_may_be_packed(tmp_path):
    plain = log(tmp_path / 'a.clf', 10.5)
    packed = tmp_path / 'a.log.gz'
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert read_carmen(packed).scans[0].stamp == 10_500_000_000


def test_scans_that_were_stamped_late_are_left_out_not_those_after_them(tmp_path):
    found = read_carmen(log(tmp_path / 'a.clf', 1, 2, 9, 3, 4, 5))
    assert [scan.stamp // 10**9 for scan in found.scans] == [1, 2, 3, 4, 5]
    assert found.skipped == (
        '1 scans left out: their stamps are not in the order of the file',)


@pytest.mark.parametrize('line', [
    'FLASER 4 1 2 3 1.0 2 0 1 2 0 5 host 0', 'FLASER four 1 2 3 4 1 2 0 1 2 0 5 host 0',
    'FLASER 4 1 2 nan 4 1 2 0 1 2 0 5 host 0', 'FLASER 99999999999 1 2', 'FLASER 0 1 2 0 1 2 0 5'])
def test_a_damaged_line_is_named(tmp_path, line):
    path = log(tmp_path / 'a.clf', 1)
    path.write_text(path.read_text() + f'\n{line}\n')
    with pytest.raises(FileError, match=r'a\.clf.*line 4: expected FLASER'):
        read_carmen(path)


def test_a_log_without_scans_or_cut_within_its_packing_is_refused(tmp_path):
    empty, cut = tmp_path / 'a.clf', tmp_path / 'a.clf.bz2'
    empty.write_text('ODOM 0 0 0 0 0 0 1 host 0\n')
    with pytest.raises(FileError, match='holds no FLASER line'):
        read_carmen(empty)
    cut.write_bytes(b'BZh9 no')
    with pytest.raises(FileError, match='cannot be read'):
        read_carmen(cut)
