# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Damaged inputs that benchmarks/mutated_inputs.py once found to end in disorder."""

import gzip
import tracemalloc

import numpy as np
import pytest
from command import run, solve_json

SCAN = 'FLASER 4 1 2 3 4 {k}.04 2 0 {k} 2 0 {k} host 0.1\n'


def log(count):
    return ''.join(SCAN.format(k=k) for k in range(count)).encode()


def refused(capsys, *arguments):
    """Return the only line that a refused command prints."""
    out, err = run(capsys, *arguments, code=2)
    assert out == '' and err.count('\n') == 1 and err.startswith('l1slam: '), err
    return err


def test_a_packed_log_with_a_damaged_block_is_used_up_to_there(capsys, tmp_path):
    packed = bytearray(gzip.compress(log(600), 1))
    packed[len(packed) // 2:len(packed) // 2 + 40] = b'\xff' * 40
    path = tmp_path / 'log.gz'
    path.write_bytes(packed)
    _, err = run(capsys, 'info', path, code=3)
    assert 'cannot be read beyond line' in err and err.count('\n') == 1
    path.write_bytes(packed[:12] + b'\xff' * 100)
    assert 'log.gz: cannot be read: ' in refused(capsys, 'info', path)


@pytest.mark.parametrize('stamp', ['1e300', '1e11', '9223372037', 'nan'])
def test_a_scan_of_a_stamp_that_no_clock_has_is_left_out(capsys, tmp_path, stamp):
    path = tmp_path / 'log.clf'
    path.write_bytes(log(40) + SCAN.format(k=7).replace(' 7 host', f' {stamp} host').encode())
    _, err = run(capsys, 'info', path, code=3)
    assert 'line 41: expected FLASER' in err and err.count('\n') == 1


@pytest.mark.parametrize('information', ['1e-30', '1e30'])
def test_any_information_that_is_read_can_be_given(capsys, tmp_path, information):
    path = tmp_path / 'bare.g2o'
    ends = [(k, k + 1) for k in range(39)] + [(k, k + 20) for k in range(0, 19, 3)]
    path.write_text(''.join(
        f'EDGE_SE2 {i} {j} {int(j - i == 1)} 0 {1.5708 if j - i == 1 and i % 5 == 4 else 0}\n'
        for i, j in ends))
    assert solve_json(capsys, path, '--information', information, code=None)['poses'] == 40


def drive_that_goes_on_far_off(path, metres):
    """Write a log of scans with too few points to tell where the robot is."""
    along = np.deg2rad(np.arange(24) * 7.5 - 86.25)
    ranges = ' '.join(map(str, 2 / np.maximum(np.cos(along), abs(np.sin(along)))))
    poses = [f'{k * 0.6 + metres * (k > 5)} {0.01 * metres * (k > 5)} 0' for k in range(12)]
    path.write_text(''.join(
        f'FLASER 24 {ranges} {pose} {pose} {k + 10**6 * (k > 5)} host 0\n'
        for k, pose in enumerate(poses)))
    return path


def most_memory(work):
    """Return the most memory that some work takes [bytes]."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_drive_that_goes_on_far_off_takes_no_memory_for_what_is_between(capsys, tmp_path):
    path = drive_that_goes_on_far_off(tmp_path / 'log.clf', 50_000)
    assert most_memory(lambda: run(capsys, 'info', path)) < 2**27


def test_a_grid_takes_a_few_bytes_a_cell(capsys, tmp_path):
    path, grid = drive_that_goes_on_far_off(tmp_path / 'log.clf', 6000), tmp_path / 'map.pgm'
    memory = most_memory(lambda: run(
        capsys, 'solve', path, '--quiet', '--grid', grid, code=None))
    assert grid.stat().st_size > 2**26
    assert memory < 9 * grid.stat().st_size
