# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How much memory a solve may take.

It stands in files, which the core does not read: who can, says how (`measure_by`).
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

# A process needs some room beside what is predicted.
_SHARE = 0.9


@dataclass(frozen=True)
class Needs:
    """What an exact L1 map takes: memory [B], processor time [s]."""

    memory: float
    seconds: float


def _physical() -> float:
    """Return the memory of the machine [B], infinite where it does not tell."""
    try:
        return float(os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE'))
    except (AttributeError, ValueError, OSError):
        return float('inf')


_reader: Callable[[], float] = _physical


def measure_by(reader: Callable[[], float]) -> None:
    """Let what is free be what a function returns [B]; before, it is all that is built in."""
    global _reader  # noqa: PLW0603 - there is one machine
    _reader = reader


def free() -> float:
    """Return the memory that a solve may take [B]."""
    return _SHARE * _reader()


def in_gigabytes(size: float) -> str:
    """Return a number of bytes as people read it."""
    return f'{size / 1e9:.3g} GB'
