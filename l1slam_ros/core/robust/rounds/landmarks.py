# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Robust solves with landmarks: each sighting is a loop through its landmark.

In: a function that judges a graph of keyframes. Out: the same for graphs with landmarks. One
sighting places each landmark, which follows its keyframe as if by odometry. Any sighting may be an
outlier: the one is chosen that most others agree with, by the odometry between keyframes (pairwise
consistency).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import covariance_of
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.landmarks import along_the_way, by_first_sightings, sightings
from l1slam_ros.core.graph.parts import bridged
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.robust.as_measured import Believed, Judge, OnRound
from l1slam_ros.core.robust.judgement import Doubt, listed

# A sighting is compared with this many later ones of its landmark.
_COMPARED = 20


def with_landmarks(judge: Judge) -> Callable[..., Believed]:
    """Return a judge of graphs with landmarks."""
    @wraps(judge)
    def judged(graph: FactorGraph, report: OnRound = lambda round_, accepted: None,
               check: Callable[[], None] = lambda: None,
               known: Believed | None = None) -> Believed:
        if not graph.is_landmark.any():
            return judge(graph, report, check, known)
        return _judged(judge, graph, _Sightings(graph).likeliest(), report, check, known)

    return judged


def _judged(judge: Judge, graph: FactorGraph, placing: Indices, report: OnRound,
            check: Callable[[], None], known: Believed | None) -> Believed:
    """Return the judgement with landmarks placed by some sightings, rows (l,)."""
    way, number = along_the_way(graph, placing)
    order = np.argsort(number)
    judgement, poses = judge(way, report, check, known and (known[0], known[1][order]))
    noise = judgement.noise.copy()  # weighted as other loops
    noise[placing] = noise[~graph.between.is_odometry].min(initial=np.inf)
    doubts = tuple(_renumbered(doubt, order) for doubt in judgement.doubts)
    return replace(judgement, noise=noise, doubts=doubts), poses[number]


def _renumbered(doubt: Doubt, order: Indices) -> Doubt:
    """Return a doubt with keyframe k as order[k]; a slip is between the ends of its step."""
    first, last = np.sort(order[[doubt.first, doubt.last]]).tolist()
    pairs = order[np.array(doubt.pairs, np.int64).reshape(-1, 2)]
    return replace(doubt, first=first, last=last, pairs=listed(pairs))


class _Sightings:
    """
    Sightings of landmarks, and how well they agree by odometry.

    Attributes
    ----------
    rows, seen, keyframe : see `sightings`
    Z, C : (k, p), (k, d, d) landmark seen from the keyframe, and covariance
    X, spread : (k, p), (k, d, d) keyframe along the odometry, and covariance as steps at the
        origin
    chain : (k,) gapless piece of odometry of the keyframe

    """

    def __init__(self, graph: FactorGraph):
        self.rows, self.seen, self.keyframe = sightings(graph)
        manifold = self._manifold = graph.manifold
        backward = self.rows[graph.between.i[self.rows] == self.seen]
        factors = turned(graph, backward).between
        self._trusted = factors.trusted[self.rows]
        self.Z = factors.measurement[self.rows]
        root = factors.sqrt_information[self.rows]
        # Outliers are uniform over the extent of the sightings and all rotations.
        width = np.full(manifold.TANGENT_SIZE, np.pi**2 / 3)
        width[manifold.TRANSLATION] = 2 * (manifold.positions(self.Z)**2).mean()
        self._log_claim = float(np.log(width).sum())
        self.C = covariance_of(root)
        k, row = np.nonzero(~factors.speaks[self.rows])
        self.C[k, row, row] = width[row]
        chain, spread, piece = _odometry(graph)
        self.X, self.spread = chain[self.keyframe], spread[self.keyframe]
        self.chain = piece[self.keyframe]

    def likeliest(self) -> Indices:
        """
        Return the sighting of each landmark with the most support, rows (l,).

        By the sum of ln p(difference) / p(difference by chance) over those that agree; of equal
        ones the first.
        """
        score = np.where(self._trusted, np.inf, 0.0)
        for apart in range(1, min(_COMPARED, len(self.rows) - 1) + 1):
            a = np.flatnonzero((self.seen[:-apart] == self.seen[apart:])
                               & (self.chain[:-apart] == self.chain[apart:]))
            gain = np.maximum(self._log_ratio(a, a + apart), 0.0)
            score[a] += gain
            score[a + apart] += gain
        order = np.lexsort((np.arange(len(score)), -score, self.seen))
        return self.rows[order[np.unique(self.seen[order], return_index=True)[1]]]

    def _log_ratio(self, a: Indices, b: Indices) -> Array:
        """Return ln p(difference) / p(difference by chance) of pairs of sightings, (pairs,)."""
        manifold = self._manifold
        way = manifold.compose(manifold.between(self.X[a], self.X[b]), self.Z[b])
        e = manifold.local(self.Z[a], way)
        Ad = manifold.adjoint(manifold.inverse(manifold.compose(self.X[b], self.Z[b])))
        C = self.C[a] + self.C[b] + Ad @ (self.spread[b] - self.spread[a]) @ Ad.transpose(0, 2, 1)
        square = (e * np.linalg.solve(C, e[:, :, None])[:, :, 0]).sum(axis=1)
        ratio: Array = (self._log_claim - np.linalg.slogdet(C)[1] - square) / 2
        return ratio


def _odometry(graph: FactorGraph) -> tuple[Array, Array, Indices]:
    """
    Return poses (n, p), covariances (n, d, d), and pieces (n,) along the odometry.

    Covariances are of steps at the origin, from the left, and add up.
    """
    manifold = graph.manifold
    way, number = by_first_sightings(graph)
    whole = bridged(way)
    poses = odometry_poses(whole)
    step = way.between.step_to
    known = (step >= 0) & ~way.is_landmark
    factors = turned(way, way.between.i > way.between.j).between
    own = np.zeros((len(poses), manifold.TANGENT_SIZE, manifold.TANGENT_SIZE))
    Ad = manifold.adjoint(poses[known])
    own[known] = Ad @ covariance_of(factors.sqrt_information[step[known]]) @ Ad.transpose(0, 2, 1)
    order = np.lexsort((np.arange(len(poses)), way.robot))
    spread, piece = np.empty_like(own), np.empty(len(poses), np.int64)
    spread[order] = np.cumsum(own[order], axis=0)
    piece[order] = np.cumsum(~known[order])
    return poses[number], spread[number], piece[number]
