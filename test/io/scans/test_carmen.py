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
from l1slam_ros.core.scans.points import Mount
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
        '1 scan left out: their stamps are not in the order of the file',)


@pytest.mark.parametrize('line', [
    'FLASER 4 1 2 3 1.0 2 0 1 2 0 5 host 0', 'FLASER four 1 2 3 4 1 2 0 1 2 0 5 host 0',
    'FLASER 4 1 2 3 4 1 2 nan 1 2 0 5 host 0', 'FLASER 99999999999 1 2', 'FLASER 0 1 2 0 1 2 0 5',
    'FLASER 4 1 2 3 4 1.04 2 0 1 2', 'FLASER', 'ROBOTLASER1 0 0 3.14 0.1 80 0 0 2 1 2 3 1 1 2'])
def test_a_damaged_line_is_named_and_left_out(tmp_path, line):
    path = log(tmp_path / 'a.clf', 1)
    path.write_text(path.read_text() + f'\n{line}\n')
    with pytest.raises(FileError, match=r'a\.clf.*line 4: expected (FLASER|ROBOTLASER1), '):
        read_carmen(path)
    path = log(tmp_path / 'b.clf', 1, 2, 3)
    path.write_text(path.read_text() + f'\n{line}\n')
    found = read_carmen(path)
    assert len(found.scans) == 3 and 'line 6: expected' in found.damage


def test_a_range_may_be_no_number(tmp_path):
    path = tmp_path / 'a.clf'
    path.write_text('FLASER 4 1 nan inf 0 1 2 0 1 2 0 5 host 0\n')
    np.testing.assert_array_equal(read_carmen(path).scans[0].ranges, [1, np.nan, np.inf, 0])


ROBOTLASER = ('ROBOTLASER1 0 -1.5 3 0.75 {farthest} 0.01 0 5 1 2 3 4 30 {remissions} '
              '1.2 2.1 0.3 1 2 0 0 0 0 0 0 {stamp} host 0.1')


@pytest.mark.parametrize('remissions', ['0', '2 17 18'])
def test_a_robotlaser_says_where_its_rays_are_and_how_far_they_go(tmp_path, remissions):
    path = tmp_path / 'a.log'
    path.write_text('\n'.join(
        ROBOTLASER.format(farthest=farthest, remissions=remissions, stamp=stamp)
        for farthest, stamp in ((20, 10.5), (0, 11))))
    found = read_carmen(path)
    first, second = found.scans
    np.testing.assert_array_equal(first.ranges, [1, 2, 3, 4, 30])
    assert (first.stamp, first.angle_min, first.angle_increment) == (10_500_000_000, -1.5, 0.75)
    assert (first.range_max, second.range_max) == (20, 80)
    np.testing.assert_array_equal(found.wheels, [(1, 2, 0)] * 2)
    mount = found.mount
    assert (mount.x, mount.y, mount.yaw) == pytest.approx((0.2, 0.1, 0.3))


def test_where_the_laser_does_not_stay_on_the_robot_it_is_where_the_robot_is(tmp_path):
    """As in a log whose laser poses were corrected."""
    path = tmp_path / 'a.clf'
    path.write_text('\n'.join(f'FLASER 2 1 2 {k} 0 0 0 {k} 0 {k} host 0' for k in range(9)))
    found = read_carmen(path)
    assert found.mount == Mount() and 'it is taken to be the pose of the robot' in found.skipped[0]


def test_the_greatest_range_again_and_again_says_that_nothing_was_there(tmp_path):
    rng = np.random.default_rng(0)
    seen = np.round(np.minimum(rng.exponential(4, (40, 50)), 8), 2)
    path = tmp_path / 'a.clf'
    path.write_text('\n'.join(
        f'FLASER 50 {" ".join(map(str, ranges))} 0 0 0 0 0 0 {k} host 0'
        for k, ranges in enumerate(seen)))
    found = read_carmen(path)
    assert 7.8 < found.scans[0].range_max < 8
    assert 'nothing in range' in found.skipped[0]
    # Surfaces at all distances, and the farthest of them as often as others.
    path.write_text(path.read_text().replace(' 8.0 ', ' 1.0 '))
    assert read_carmen(path).scans[0].range_max == 80


def test_a_log_without_scans_or_cut_within_its_packing_is_refused(tmp_path):
    empty, cut = tmp_path / 'a.clf', tmp_path / 'a.clf.bz2'
    empty.write_text('ODOM 0 0 0 0 0 0 1 host 0\n')
    with pytest.raises(FileError, match='holds no FLASER or ROBOTLASER1 line'):
        read_carmen(empty)
    cut.write_bytes(b'BZh9 no')
    with pytest.raises(FileError, match='cannot be read'):
        read_carmen(cut)


def test_of_a_log_cut_within_its_packing_what_is_before_is_read(tmp_path):
    plain = log(tmp_path / 'a.clf', *range(1, 2000))
    packed = tmp_path / 'b.clf.gz'
    whole = gzip.compress(plain.read_bytes())
    packed.write_bytes(whole[: len(whole) // 2])
    found = read_carmen(packed)
    assert 100 < len(found.scans) < 1999
    assert 'cannot be read beyond line' in found.damage
