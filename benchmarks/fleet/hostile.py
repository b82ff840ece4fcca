# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Files that call themselves recordings and are none: each must cost a sentence, and no more."""

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

_MAGIC = b'\x89MCAP0\r\n'
# [bytes] What a few kilobytes claim to be, packed.
_BOMB = 8 * 10**9


def _prose(path: Path) -> None:
    path.with_suffix('.g2o').write_text('Once upon a time there was a robot.\n')


def _empty(path: Path) -> None:
    path.with_suffix('.mcap').touch()


def _not_a_number(path: Path) -> None:
    path.with_suffix('.g2o').write_text('EDGE_SE2 0 1 1 nan 0 1 0 0 1 0 1\n')


def _unknown_vertices(path: Path) -> None:
    path.with_suffix('.g2o').write_text('VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 7 1 0 0 1 0 0 1 0 1\n')


def _one_long_line(path: Path) -> None:
    path.with_suffix('.g2o').write_bytes(b'EDGE_SE2 ' + b'0' * 10**6)


def _cut(path: Path) -> None:
    path.with_suffix('.mcap').write_bytes(_MAGIC + b'\x01' + struct.pack('<Q', 22) + b'\x04')


def _packed_chunk(path: Path) -> None:
    """Write a chunk of an mcap, a few kilobytes of zstd, that unpacks to gigabytes."""
    import zstandard

    packer = zstandard.ZstdCompressor().compressobj(size=_BOMB)
    block = bytes(10**7)
    packed = b''.join(packer.compress(block) for _ in range(_BOMB // len(block))) + packer.flush()
    chunk = (struct.pack('<QQQI', 0, 1, _BOMB, 0) + struct.pack('<I', 4) + b'zstd'
             + struct.pack('<Q', len(packed)) + packed)
    header = struct.pack('<I', 4) + b'ros2' + struct.pack('<I', 0)
    path.with_suffix('.mcap').write_bytes(
        _MAGIC + b'\x01' + struct.pack('<Q', len(header)) + header
        + b'\x06' + struct.pack('<Q', len(chunk)) + chunk + _MAGIC)


def _nested_metadata(path: Path) -> None:
    path.mkdir()
    (path / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information: {"[" * 100_000}{"]" * 100_000}\n')


def _packed_log(path: Path) -> None:
    with gzip.open(path.with_suffix('.gz'), 'wb', 1) as file:
        for _ in range(300):
            file.write(bytes(10**7))


def _noise(path: Path) -> None:
    path.with_suffix('.db3').write_bytes(bytes(range(256)) * 100)


# Each takes a path without suffix.
HOSTILE: tuple[Callable[[Path], None], ...] = (
    _prose, _empty, _not_a_number, _unknown_vertices, _one_long_line, _cut, _packed_chunk,
    _nested_metadata, _packed_log, _noise)
