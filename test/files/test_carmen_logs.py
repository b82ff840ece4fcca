# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: what their lines mean, and what is said of those that are damaged."""

import bz2
import gzip
import re

import numpy as np
import pytest
from command import run
from records import read

TENTHS = 1000 + np.arange(150) / 10
LATE = 'left out: their stamps are not in the order of the file'


def lines_of(stamps, ranges='1 nan inf 4'):
    """Return lines of a robot that has gone a metre from each scan to the next."""
    return [f'FLASER {len(ranges.split())} {ranges} {k}.04 2 0 {k} 2 0 {stamp} host 0.1'
            for k, stamp in enumerate(stamps)]


@pytest.fixture
def graph_of(capsys, tmp_path):
    """Return what gives stamps [ns] and poses of the keyframes of a log, and what is said."""
    def graph(path, lines=None, code=0):
        if lines is not None:
            begin = '# CARMEN Logfile', 'ODOM 0 0 0 0 0 0 1 host 0'
            path.write_text('\n'.join([*begin, *lines, '']))
        err = run(capsys, 'convert', path, tmp_path / 'out.g2o', code=code)[1]
        if code == 2:
            return err
        found = read(tmp_path / 'out.g2o')
        return found.stamps, found.poses, err
    return graph


@pytest.mark.parametrize('name, packed', [
    ('a.clf', bytes), ('a.log.gz', gzip.compress), ('a.clf.bz2', bz2.compress)])
def test_a_line_is_a_scan_and_where_the_wheels_had_the_robot(graph_of, tmp_path, name, packed):
    """A range may be no number; the file may be packed."""
    (tmp_path / name).write_bytes(packed('\n'.join(lines_of([10.5, 11.25, 13])).encode()))
    stamps, poses, said = graph_of(tmp_path / name)
    assert stamps.tolist() == [10_500_000_000, 11_250_000_000, 13_000_000_000]
    np.testing.assert_allclose(poses, [(0, 0, 0), (1, 0, 0), (2, 0, 0)], atol=1e-12)
    assert 'damaged' not in said and LATE not in said


@pytest.mark.parametrize('remissions', ['0', '2 17 18'])
def test_a_robotlaser_has_its_pose_behind_the_remissions(graph_of, tmp_path, remissions):
    stamps, poses, _ = graph_of(tmp_path / 'a.log', [
        f'ROBOTLASER1 0 -1.5 3 0.75 20 0.01 0 5 1 2 3 4 30 {remissions} {k + 0.2} 2.1 0.3 {k} 2 0 '
        f'0 0 0 0 0 {k + 10.5} host 0.1' for k in range(3)])
    assert stamps.tolist() == [10_500_000_000, 11_500_000_000, 12_500_000_000]
    np.testing.assert_allclose(poses[:, 0], [0, 1, 2], atol=1e-12)


@pytest.mark.parametrize('line', [
    'FLASER 4 1 2 3 1.0 2 0 1 2 0 5 host 0', 'FLASER four 1 2 3 4 1 2 0 1 2 0 5 host 0',
    'FLASER 4 1 2 3 4 1 2 nan 1 2 0 5 host 0', 'FLASER 99999999999 1 2', 'FLASER 0 1 2 0 1 2 0 5',
    'FLASER 4 1 2 3 4 1.04 2 0 1 2', 'FLASER', 'ROBOTLASER1 0 0 3.14 0.1 80 0 0 2 1 2 3 1 1 2'])
def test_a_damaged_line_is_named_and_left_out(graph_of, tmp_path, line):
    said = graph_of(tmp_path / 'a.clf', [*lines_of([1]), line], code=2)
    assert re.search(r'a\.clf.*line 4: expected (FLASER|ROBOTLASER1), ', said)
    stamps, _, said = graph_of(tmp_path / 'a.clf', [*lines_of([1, 2, 3]), line], code=3)
    assert len(stamps) == 3 and 'line 6: expected' in said


def test_where_the_laser_does_not_stay_on_the_robot_it_is_where_the_robot_is(graph_of, tmp_path):
    """As in a log whose laser poses were corrected."""
    said = graph_of(tmp_path / 'a.clf', [
        f'FLASER 2 1 2 {k} 0 0 0 {k} 0 {k} host 0' for k in range(1, 9)])[2]
    assert 'it is taken to be the pose of the robot' in said


def test_the_greatest_range_again_and_again_says_that_nothing_was_there(graph_of, tmp_path):
    seen = np.round(np.minimum(np.random.default_rng(0).exponential(4, (40, 50)), 8), 2)
    lines = [f'FLASER 50 {" ".join(map(str, ranges))} {k} 0 0 {k} 0 0 {k + 1} host 0'
             for k, ranges in enumerate(seen)]
    said = graph_of(tmp_path / 'a.clf', lines)[2]
    assert 'ranges of 7.84 m and more are taken to mean "nothing in range"' in said
    # Surfaces at all distances, and the farthest of them as often as others.
    lines = [line.replace(' 8.0 ', ' 1.0 ') for line in lines]
    assert 'nothing in range' not in graph_of(tmp_path / 'a.clf', lines)[2]


def test_a_log_without_scans_or_cut_within_its_packing_is_said(graph_of, tmp_path):
    assert 'holds no FLASER or ROBOTLASER1 line' in graph_of(tmp_path / 'a.clf', [], code=2)
    packed = tmp_path / 'a.clf.bz2'
    packed.write_bytes(b'BZh9 no')
    assert 'cannot be read' in graph_of(packed, code=2)


@pytest.mark.parametrize('off', [-1, 1, 40, -400])
def test_a_line_that_is_stamped_late_or_early_is_left_out(graph_of, tmp_path, off):
    spoilt = TENTHS + off * (np.arange(150) == 50)
    stamps, _, said = graph_of(tmp_path / 'a.clf', lines_of(spoilt))
    np.testing.assert_allclose(stamps / 1e9, np.delete(TENTHS, 50), atol=1e-6)
    assert f'1 scan {LATE}' in said and 'set back' not in said


@pytest.mark.parametrize('given, expected, more', [
    # By a clock that knows seconds, or none; one that is set back.
    (TENTHS // 1, TENTHS, ''), (np.zeros(5), np.arange(5) / 10, ''),
    (TENTHS - 60 * (np.arange(150) >= 60), TENTHS, 'set back by 60.0 s in all')])
def test_stamps_rise_whatever_the_clock_did(graph_of, tmp_path, given, expected, more):
    stamps, _, said = graph_of(tmp_path / 'a.clf', lines_of(given))
    np.testing.assert_allclose(stamps / 1e9, expected, atol=1e-6)
    assert LATE not in said and more in said
