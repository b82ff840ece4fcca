# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Chance that belongs to a factor: the same in whatever order factors came, and however often asked.

In: the keyframes that factors tie. Out: numbers that look drawn, and are worked out of these. A
graph that grew on a robot and the same graph from a file draw alike then, and so does one that was
looked at twice.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.graph.spanning_tree import pair_key

# More keyframes than any graph has: what belongs to a pair stays while the graph grows.
_MANY = 2**32
_MIXED = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_STEP = np.uint64(0x9E3779B97F4A7C15)


def keys(one: Indices, other: Indices) -> np.ndarray:
    """
    Return a number of 64 bits for each factor, (m,) uint64, from the keyframes it ties, (m,) each.

    Factors of the same two keyframes are told apart by which comes first.
    """
    pair = _mixed(pair_key(one, other, _MANY).astype(np.uint64))
    order = np.argsort(pair, kind='stable')
    first = np.concatenate(([True], pair[order][1:] != pair[order][:-1]))[: len(pair)]
    place = np.arange(len(pair))
    which = np.zeros(len(pair), np.uint64)
    which[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return _mixed(pair + which)


def signs(key: np.ndarray, k: int, q: int) -> np.ndarray:
    """Return -1 or 1, as likely, (m, k, q) int8 with q <= 64, of factors with these keys (m,)."""
    words = _mixed(key[:, None] + np.arange(1, k + 1, dtype=np.uint64) * _STEP)
    bits = np.unpackbits(words[:, :, None].view(np.uint8), axis=2, count=q)
    return 2 * bits.view(np.int8) - np.int8(1)


def _mixed(number: np.ndarray) -> np.ndarray:
    """Return the steps of splitmix64 (G. L. Steele, D. Lea, C. H. Flood, OOPSLA 2014), (...)."""
    number = number + _STEP
    number = (number ^ (number >> np.uint64(30))) * _MIXED[0]
    number = (number ^ (number >> np.uint64(27))) * _MIXED[1]
    return number ^ (number >> np.uint64(31))
