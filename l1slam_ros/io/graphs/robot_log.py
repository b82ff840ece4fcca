# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The content of a log of several robots besides its graph; it is written back unchanged."""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask


@dataclass(frozen=True)
class RobotLog:
    """
    The names, stamps and flags of a log.

    name : of the log; robots : (r,) their character codes, in the order of the log; stamps : of
    each robot those of its entries, as they came; entries : (m, 2) of the factors, the place of
    the robot among `robots` and the number of its entry; doubtful : (m,) bool, the factors that
    the log says may be false, None: it does not say; false : (m,) bool, those that it says are,
    None: it does not say; true_ids, true_poses : (k,), (k, p) of the true poses, none: unknown.
    """

    name: str
    robots: tuple[int, ...]
    stamps: tuple[tuple[int, ...], ...]
    entries: Indices
    doubtful: Mask | None
    false: Mask | None
    true_ids: Indices
    true_poses: Array

    @property
    def known_false(self) -> Mask:
        """The factors that the log says are false, (m,) bool."""
        return np.zeros(len(self.entries), bool) if self.false is None else self.false
