# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam_ros.solve`: the map of a graph, and its inlier loops."""

from dataclasses import dataclass
from weakref import ReferenceType, WeakKeyDictionary, ref

import numpy as np

from l1slam_ros.core.errors import GraphError, OptionError, require
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import as_poses
from l1slam_ros.core.names import NORMS, SAME
from l1slam_ros.core.robust import batch_map

# The last solution of each graph: its poses, inliers and drift, for writers of these poses.
_LAST: WeakKeyDictionary[FactorGraph, tuple[ReferenceType[Array], Mask, float]] = (
    WeakKeyDictionary())


@dataclass(frozen=True)
class Solution:
    """
    A solved graph.

    Attributes
    ----------
    poses : (n, p) [m, rad], the first keyframe where the start had it
    cost : in the norm, over the inliers
    status : converged, iteration_limit, stalled, or doubtful: the best map found, but inliers and
        outliers could not be separated
    inliers : (m,) bool of the between factors

    """

    poses: Array
    cost: float
    status: str
    inliers: Mask


def solve(graph: FactorGraph, *, norm: str = 'l1', robust: bool = True,
          start: Array | None = None, loop_norm: str = SAME) -> Solution:
    """
    Return the map of a graph.

    Parameters
    ----------
    graph : as of `read_graph`
    norm : l1, the sum of absolute whitened residuals; group-l1, of their lengths; l2, of their
        squares; huber
    robust : reject outlier loops; False: accept all
    start : (n, p) initial poses; None: a seed computed from the graph alone, as always if robust
    loop_norm : of loops and absolute poses; same: as `norm`

    Raises
    ------
    GraphError : the graph is not connected, its odometry has a gap where loops are to be judged,
        or `start` has another shape or is not finite.
    OptionError : there is no such norm, or an argument is of another kind.

    """
    require(FactorGraph, 'graph', graph, 'a FactorGraph, as read_graph returns first')
    require((bool, np.bool_), 'robust', robust, 'True or False')
    if norm not in NORMS:
        raise OptionError(f'norm is {norm!r}, expected one of {", ".join(NORMS)}')
    if loop_norm not in (SAME, *NORMS):
        raise OptionError(f'loop_norm is {loop_norm!r}, expected one of '
                          f'{", ".join((SAME, *NORMS))}')
    if start is not None:
        start = as_poses(graph, start, 'start has')
        # A quaternion may have another norm, an angle be of several turns.
        with np.errstate(all='ignore'):
            start = graph.manifold.compose(graph.manifold.identity(graph.n_poses), start)
        if not (finite := np.isfinite(start).all(axis=1)).all():
            raise GraphError(f'start of keyframe {int(np.argmin(finite))} is no pose; expected '
                             'finite numbers')
    asked = batch_map.SolveOptions('seed' if start is None else 'file', norm, loop_norm,
                                   robust=bool(robust))
    outcome = batch_map.solve(graph, start, asked)
    judgement = outcome.judgement
    status = outcome.solution.status.value
    if judgement is None:
        inliers = ~graph.between.struck
        drift = 0.0
    else:
        inliers, drift = judgement.accepted, judgement.drift
        status = 'doubtful' if judgement.doubt else status
    _LAST[graph] = ref(outcome.solution.poses), inliers, drift
    return Solution(outcome.solution.poses, outcome.solution.cost, status, inliers)


def believed(graph: FactorGraph, poses: Array) -> tuple[Mask | None, float]:
    """
    Return the inliers (m,) of the last solution of a graph and the drift [rad/m] of its odometry.

    None, 0 for other poses.
    """
    if graph in _LAST:
        made_of, inliers, drift = _LAST[graph]
        if made_of() is poses and len(graph.between) == len(inliers):
            return inliers, drift
    return None, 0.0
