# SPDX-License-Identifier: Apache-2.0
"""Arguments that more than one suite takes: lists with commas."""

import argparse


def words_of(text: str) -> tuple[str, ...]:
    """Return the words of a list."""
    return tuple(text.split(','))


def shares_of(text: str) -> tuple[float, ...]:
    """Return the shares of a list, each of all loops; raise where one is none."""
    shares = tuple(float(word) for word in words_of(text))
    if not all(0 < share < 1 for share in shares):
        raise argparse.ArgumentTypeError(f'{text!r}, expected shares between 0 and 1')
    return shares
