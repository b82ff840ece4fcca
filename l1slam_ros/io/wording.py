# SPDX-License-Identifier: Apache-2.0
"""Numbers in sentences."""


def counted(count: int, noun: str, plural: str = '') -> str:
    """Return e.g. `1 loop`, `1,837 loops`; plural : where it is not the noun and an s."""
    return f'{count:,} {noun if count == 1 else plural or noun + "s"}'
