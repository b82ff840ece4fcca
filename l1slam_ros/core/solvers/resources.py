# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What a solve by factorisations takes, and what the machine has.

In: a graph and how many blocks its factor has. Out: bytes and seconds, predicted before the work
begins. How much memory is free stands in files, which the core does not read: who can, says how
(`measure_by`).
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

from l1slam_ros.core.graph.factor_graph import FactorGraph

# Bytes of a number, and of all that is kept of a factor for each entry of one of its Jacobians:
# measured, 1.7 kB of a factor in the plane, most of it in lengths of the interior point.
_NUMBER, _BYTES_PER_ENTRY = 8, 190
# Seconds that steps take of a factor for each entry of a Jacobian, and multiplications of a second
# of factorisation, as often as a map and its seed need one: as measured from 25,000 poses to
# 1,000,000 on one core of the machine of doc/performance.md.
_SECONDS_PER_ENTRY, _RATE, _FACTORISATIONS = 6e-6, 1e10, 45
# A process needs some room beside what is predicted.
_SHARE = 0.9


@dataclass(frozen=True)
class Needs:
    """What a solve takes: memory [B], processor time [s]."""

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
    """Let the free memory be what a function returns [B]; before, it is all that is built in."""
    global _reader  # noqa: PLW0603 - there is one machine
    _reader = reader


def free() -> float:
    """Return the memory that a solve may take [B]."""
    return _SHARE * _reader()


def in_gigabytes(size: float) -> str:
    """Return a number of bytes as people read it."""
    return f'{size / 1e9:.3g} GB'


def bytes_of_block(graph: FactorGraph) -> int:
    """Return what a block of the factor takes [B]: of whole poses, and of the seed's parts."""
    manifold = graph.manifold
    k = manifold.TANGENT_SIZE
    parts = {len(range(*part.indices(k))) for part in (manifold.TRANSLATION, manifold.ROTATION)}
    # The chordal relaxation of the seed has blocks of a rotation matrix.
    parts |= {k, manifold.rotation(manifold.identity(1)).shape[-1]}
    return _NUMBER * sum(size * size for size in parts)


def bytes_beside(graph: FactorGraph) -> float:
    """Return what a solve takes besides the blocks of its factor [B]."""
    return float(_BYTES_PER_ENTRY * graph.manifold.TANGENT_SIZE**2 * len(graph.between))


def most_blocks(graph: FactorGraph) -> int:
    """Return how many blocks a factor of the graph may have."""
    n = graph.n_poses
    left = min((free() - bytes_beside(graph)) / bytes_of_block(graph), n * (n + 1.0))
    return max(int(left), 0)


def needs(graph: FactorGraph, blocks: float, work: float) -> Needs:
    """Predict the needs; blocks : of the factor; work : see `block_cholesky.Pattern`."""
    k = graph.manifold.TANGENT_SIZE
    return Needs(blocks * bytes_of_block(graph) + bytes_beside(graph),
                 _SECONDS_PER_ENTRY * k**2 * len(graph.between)
                 + _FACTORISATIONS * work * k**3 / _RATE)
