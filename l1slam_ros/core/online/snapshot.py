# SPDX-License-Identifier: Apache-2.0
"""
The back end at one moment: taken in a moment, and read at leisure while the back end goes on.

In: references to arrays that are never written to again. Out: what is worked out of them, the
problem of the next update first of all.
"""

from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.online.loop_states import (
    ACCEPTED,
    EXPIRED,
    REJECTED,
    SUSPECT,
    WAITING,
    LoopStates,
)
from l1slam_ros.core.robust.judgement import Belief


@dataclass(frozen=True)
class Problem:
    """
    A snapshot to improve: graph, poses (n, p), dual (rows,) and the cost the last update left.

    belief : of all factors; robust : loops may be doubted; settled : nothing has come since an
    update that converged.
    """

    graph: FactorGraph
    poses: Array
    dual: Array
    belief: Belief
    robust: bool
    last_cost: float
    settled: bool


@dataclass(frozen=True)
class Snapshot:
    """
    What a back end knows.

    version : see `Backend.version`; graph : the factors so far; stamps (n,) [ns] and odometry
    (n, p) of the keyframes; map_to_odom : (1, p); loop_rows, loop_stamps : see `GraphBuilder`;
    optimised (k, p), dual, belief and last_cost : as the last update left them, for the first
    keyframes and factors; robust : loops may be doubted; at_rest : more updates of the same
    factors would hardly change the map.
    """

    version: tuple[int, int, int]
    graph: FactorGraph
    stamps: Indices
    odometry: Array
    map_to_odom: Array
    loop_rows: Indices
    loop_stamps: tuple[Indices, Indices, Indices]
    optimised: Array
    dual: Array
    belief: Belief
    robust: bool
    last_cost: float
    at_rest: bool

    @property
    def poses(self) -> Array:
        """All keyframes in the map frame, (n, p): the optimised ones, then odometry from there."""
        known, manifold = len(self.optimised), self.graph.manifold
        new = self.odometry[known:]
        if known and len(new):
            start = np.broadcast_to(self.odometry[known - 1], new.shape)
            last = np.broadcast_to(self.optimised[-1], new.shape)
            new = manifold.compose(last, manifold.between(start, new))
        return np.concatenate((self.optimised, new))

    def problem(self) -> Problem:
        """Return what an update begins with: the graph, and the warm start for all of it."""
        rows = len(self.graph.between) * self.graph.manifold.TANGENT_SIZE
        # Rows are only ever appended, so the dual of the old ones stays; new ones start at zero.
        dual = np.concatenate((self.dual, np.zeros(rows - len(self.dual))))
        belief = self.belief.extended(self.graph, self.robust)
        grown = len(self.optimised) < self.graph.n_poses or len(self.dual) < rows
        settled = not grown and belief.settled and self.at_rest
        return Problem(self.graph, self.poses, dual, belief, self.robust, self.last_cost, settled)

    def loop_states(self) -> LoopStates:
        """Return what has become of each loop, those of the graph first, in its order."""
        in_graph, waiting, expired = self.loop_stamps
        belief, rows = self.belief.extended(self.graph, self.robust), self.loop_rows
        state = np.where(belief.accepted[rows], ACCEPTED,
                         np.where(belief.suspect[rows], SUSPECT, REJECTED))
        others = np.repeat([WAITING, EXPIRED], [len(waiting), len(expired)])
        sigmas = np.concatenate((belief.sigmas[rows], np.full(len(others), np.nan)))
        return LoopStates(rows, np.concatenate((in_graph, waiting, expired)),
                          np.concatenate((state, others)), sigmas)
