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

import pytest
from command import run

SCAN = 'FLASER 4 1 2 3 4 {k}.04 2 0 {k} 2 0 {k} host 0.1\n'


def log(count):
    return ''.join(SCAN.format(k=k) for k in range(count)).encode()


def refused(capsys, *arguments):
    """Return the only line that a refused command prints."""
    out, err = run(capsys, *arguments, code=2)
    assert out == '' and err.count('\n') == 1 and err.startswith('l1slam: '), err
    return err


def test_a_packed_log_with_a_damaged_block_is_used_up_to_there(capsys, tmp_path):
    packed = bytearray(gzip.compress(log(2000), 1))
    packed[len(packed) // 2:len(packed) // 2 + 40] = b'\xff' * 40
    path = tmp_path / 'log.gz'
    path.write_bytes(packed)
    _, err = run(capsys, 'info', path, code=3)
    assert 'cannot be read beyond line' in err and err.count('\n') == 1
    path.write_bytes(packed[:12] + b'\xff' * 100)
    assert 'log.gz: cannot be read: ' in refused(capsys, 'info', path)


def test_a_packed_log_without_end_is_refused(capsys, tmp_path):
    path = tmp_path / 'log.gz'
    path.write_bytes(gzip.compress(b'PARAM ' * 2**20 + b'\n', 9) + gzip.compress(log(3)))
    assert 'bytes that unpack to more than a graph' in refused(capsys, 'info', path)
