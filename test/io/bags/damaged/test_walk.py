# SPDX-License-Identifier: Apache-2.0
"""A chunk is decoded up to where its data are damaged, but for little."""

import bz2

import lz4.frame
import numpy as np
import pytest
import zstandard

from l1slam_ros.io.bags.damaged.walk import uncompressed

COMPRESS = {
    'zstd': zstandard.compress,
    'lz4': lambda data: lz4.frame.compress(data, block_linked=False, block_checksum=True),
    'bz2': lambda data: bz2.compress(data, 1)}


@pytest.mark.parametrize('kind', COMPRESS)
def test_damaged_data_are_decoded_as_far_as_they_go(rng, kind):
    data = bytes(rng.integers(0, 40, 500_000, dtype='u1'))
    whole = COMPRESS[kind](data)
    assert uncompressed(whole, kind) == uncompressed(whole + b'more', kind) == data
    assert uncompressed(b'', kind) == b''
    for at in np.linspace(0, len(whole), 9, dtype=int)[:-1]:
        cut, broken = whole[:at], whole[:at] + b'\xff' * 8 + whole[at + 8:]
        found = uncompressed(cut, kind)
        assert found == data[:len(found)]
        # Decoders work block by block, of 128 kB at most.
        assert len(found) >= len(data) * at / len(whole) - 2**17
        assert uncompressed(broken, kind)[:len(found)] == found
