# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What hangs on points of a border, each on one before it; see `border`."""

from l1slam_ros.core.kernels.compiled import loop


@loop('(i8[::1], f8[:, :, ::1], f8[:, ::1])')
def pull_parents(parent, turn, gradient):
    """Let what pulls at points, (t, k), pull at what they hang on, too."""
    for s in range(len(parent) - 1, -1, -1):
        if parent[s] >= 0:
            for r in range(gradient.shape[1]):
                for c in range(gradient.shape[1]):
                    gradient[parent[s], c] += turn[s, r, c] * gradient[s, r]


@loop('(i8[::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1])')
def move_children(parent, turn, noise, gradient, moved):
    """Write how far from their means points are that hang on others, (t, k)."""
    k = moved.shape[1]
    for s in range(len(parent)):
        for r in range(k):
            for c in range(k):
                moved[s, r] += noise[s, r, c] * gradient[s, c]
                if parent[s] >= 0:
                    moved[s, r] += turn[s, r, c] * moved[parent[s], c]
