# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The next factors of a front, linearised together.

In: the keyframes that they name. Out: how many can be taken, and what the bordered systems append.
"""

from dataclasses import dataclass

from l1slam_ros.core.geometry.manifold import Array

# The keyframes i and j of a factor.
Pair = tuple[int, int]


@dataclass(frozen=True)
class Linearised:
    """
    New factors, whitened, in both maps.

    ends : of each what its keyframes are called in the bordered systems; blocks :
    (m, 2, 2, k, k) by map and side; residual : (m, 2, k) at no step
    """

    ends: list[Pair]
    blocks: Array
    residual: Array

    def of(self, which: int, at: int) -> tuple[Pair, Array, Array]:
        """Return the ends, blocks and residual of one of them, in one of the maps."""
        return self.ends[at], self.blocks[at, which], self.residual[at, which]


def in_order(pairs: list[Pair], keyframes: int) -> int:
    """Return how many factors, from the first on, name no keyframe before the one before it."""
    for count, pair in enumerate(pairs):
        if max(pair) > keyframes:
            return count
        keyframes = max(keyframes, max(pair) + 1)
    return len(pairs)
