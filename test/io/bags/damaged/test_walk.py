# SPDX-License-Identifier: Apache-2.0
"""A decoder gives all that comes before its data are damaged, to the byte."""

import bz2

import lz4.frame
import pytest
import zstandard

from l1slam_ros.io.bags.damaged.walk import decoded, lz4_decoder, zstd_decoder

KINDS = {
    'zstd': (zstandard.compress, zstd_decoder),
    'lz4': (lambda data: lz4.frame.compress(data, block_linked=False, block_checksum=True),
            lz4_decoder),
    'bz2': (bz2.compress, bz2.BZ2Decompressor),
}


@pytest.fixture
def data(rng):
    """Return half a megabyte that compresses a little."""
    return bytes(rng.integers(0, 40, 500_000, dtype='u1'))


def byte_by_byte(make_decoder, data):
    decoder, parts = make_decoder(), []
    for k in range(len(data)):
        try:
            parts.append(decoder.decompress(data[k:k + 1]))
        except Exception:
            break
    return b''.join(parts)


@pytest.mark.parametrize('kind', KINDS)
def test_whole_data(data, kind):
    compress, make_decoder = KINDS[kind]
    assert decoded(make_decoder, compress(data)) == data
    assert decoded(make_decoder, b'') == b''
    assert decoded(make_decoder, compress(data) + b'more') == data


@pytest.mark.parametrize('kind', KINDS)
def test_damaged_data_as_far_as_they_go(data, kind, rng):
    compress, make_decoder = KINDS[kind]
    whole = compress(data)
    for at in [*rng.integers(0, len(whole), 2), len(whole) // 2]:
        broken = bytearray(whole)
        broken[at:at + 8] = b'\xff' * 8
        expected = byte_by_byte(make_decoder, bytes(broken))
        assert decoded(make_decoder, bytes(broken)) == expected
        cut = decoded(make_decoder, whole[:at])
        assert cut == data[:len(cut)] == byte_by_byte(make_decoder, whole[:at])
