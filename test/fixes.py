# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Worlds without loops, whose keyframes are seen by GPS now and then."""

from dataclasses import dataclass

import numpy as np
from worlds import compose

import l1slam_ros as l1

# Where the map frame is to the first keyframe: far off, and turned.
FRAME = (100.0, -40.0, 2.0)


@dataclass(frozen=True)
class SeenWorld:
    """
    The odometry of a graph and one position without a heading every so many keyframes.

    truth : (n, 3) in the map frame; false : the keyframes whose positions are far off, ascending.
    """

    graph: l1.FactorGraph
    truth: np.ndarray
    false: np.ndarray

    def error(self, poses):
        """Return the RMSE of the positions [m], nothing aligned."""
        apart = (poses - self.truth)[:, :2]
        return float(np.sqrt((apart**2).sum(axis=1).mean()))


def seen(graph, truth, every, rng, part_false=0.0, sigma=1.0, off=50.0):
    """Return the odometry of a graph, seen from above; sigma [m] of x and of y."""
    truth = compose(np.array(FRAME), truth)
    graph = graph.subset(graph.between.is_odometry)
    k = np.arange(0, graph.n_poses, every)
    position = truth[k, :2] + sigma * rng.standard_normal((len(k), 2))
    bad = np.sort(rng.permutation(len(k))[:round(part_false * len(k))])
    angle = rng.uniform(0, 2 * np.pi, len(bad))
    position[bad] += off * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    graph.add_between(np.full_like(k, -1), k, np.insert(position, 2, 0.0, axis=1),
                      np.tile(np.diag([sigma**-2, sigma**-2, 0]), (len(k), 1, 1)))
    return SeenWorld(graph, truth, k[bad])
