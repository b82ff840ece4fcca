# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Slips that are found together: the steps that are off in the L1 map of the loops that agree.

In: a state of a robust solve. Out: the state without these steps. Of several slips one that is cut
alone explains little, and leaves a motion as no robot moves. But loops across the same slips agree
with each other, which false ones hardly do; and L1 leaves what does not fit on few factors.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.pairwise_consistency import agreement, asked
from l1slam_ros.core.robust.rounds.growth import NOISIER, Growth
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.exact import minimise_interior_point
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.seed import seed_poses

# So many steps slip at most.
_MOST = 6


def agreeing(growth: Growth) -> Indices:
    """Return the loops that are left out and that others bear out, hardly by chance, (k,)."""
    rows = asked(growth, np.concatenate((growth.undecided(), growth.joining())))
    one, _, log_ratio = agreement(growth, rows)
    m = max(len(rows), 1)
    agree: Indices = rows[
        np.bincount(one, log_ratio - np.log(m), len(rows)) > np.log(m / DOUBT)]
    return agree


def without_some(growth: Growth, agree: Indices, noisier: float) -> Growth | None:
    """
    Return the state after the rounds that follow if the steps are cut that are off in an L1 map.

    None: it explains less than half of the loops that agree, or by noisier odometry.

    agree : (k,) see `agreeing`; noisier : by so much the odometry varies more in the L1 map, since
    a step much surer than loops are is not off while these are few
    """
    if not len(agree):
        return None
    given = growth.given
    rows = np.union1d(np.flatnonzero(growth.accepted), agree)
    loops = given.is_loop[rows]
    graph = growth.uncut().subgraph(rows).subset(
        np.arange(len(rows)), np.where(loops, 1.0, noisier))
    cholesky = cholesky_of(graph)
    gate = given.gate(given.factors.freedom[rows])
    poses = seed_poses(graph, cholesky)
    # Nearly as many fit the seed already, which takes a moment.
    if not _explains(rows[_squares(graph, poses) < gate], agree):
        return None
    poses = minimise_interior_point(graph, poses, OptimiserOptions(), cholesky).poses
    square = _squares(graph, poses)
    fits = square < gate
    if not _explains(rows[fits], agree):
        return None
    state = growth.copy()
    state.accepted = ~given.is_loop | given.trusted
    state.accepted[rows[fits]] = True
    state.cut, state.poses = given.gap.copy(), poses
    state.drops[:] = 0
    off = np.flatnonzero(~fits & ~loops & ~given.gap[rows])
    for step in rows[off[np.argsort(-square[off], kind='stable')][:_MOST]]:
        state.cut[step] = True
        state.label_parts()
        # What alone leads from one part to another is off for no loop.
        state.cut[step] = not state.across()[step]
    state.label_parts()
    state.solve()
    state.accept_more()
    return state if state.noise.variance[0] < NOISIER * growth.noise.variance[0] else None


def _squares(graph: FactorGraph, poses: Array) -> Array:
    """Return the squared length of the whitened residual of each factor, (m,)."""
    rows = whitened_residual(graph, poses).reshape(len(graph.between), -1)
    square: Array = (rows**2).sum(axis=1)
    return square


def _explains(fitting: Indices, agree: Indices) -> bool:
    """Return whether half or more of the loops that agree are among those that fit."""
    return bool(2 * np.count_nonzero(np.isin(agree, fitting)) >= len(agree))
