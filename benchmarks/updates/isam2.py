# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""gtsam's ISAM2, in a process of its own: the peer of our updates."""

import importlib
import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.paper.updates import Peer

# [m or rad] It linearises again what has moved by more, after each pose.
_RELINEARISE = 0.1


class _Isam2:
    """
    The peer: L2, every loop of the graph believed.

    Parameters
    ----------
    graph : what it is fed with
    patience : [s] of its updates in all; then it is left behind

    """

    def __init__(self, graph: FactorGraph, patience: float = float('inf')):
        gtsam: Any = importlib.import_module('gtsam')
        self._gtsam = gtsam
        self._factors = graph.between
        self._k = graph.manifold.TANGENT_SIZE
        self._Pose, self._Between, self._Prior = (
            (gtsam.Pose2, gtsam.BetweenFactorPose2, gtsam.PriorFactorPose2) if self._k == 3 else
            (gtsam.Pose3, gtsam.BetweenFactorPose3, gtsam.PriorFactorPose3))
        options = gtsam.ISAM2Params()
        options.setRelinearizeThreshold(_RELINEARISE)
        options.relinearizeSkip = 1
        self._isam, self._at = gtsam.ISAM2(options), self._Pose()
        ends = np.maximum(self._factors.i, self._factors.j)
        self._rows = np.split(np.argsort(ends, kind='stable'),
                              np.searchsorted(np.sort(ends), np.arange(1, graph.n_poses)))
        self._odometry = self._factors.is_odometry
        self._left = patience

    def update(self, k: int) -> list[float]:
        """Add keyframe k and its factors; return the seconds, [] once its time was up."""
        if self._left <= 0:
            return []
        gtsam = self._gtsam
        new = self._gtsam.NonlinearFactorGraph()
        values = self._gtsam.Values()
        step = self._Pose()
        if k == 0:
            new.add(self._Prior(0, step, gtsam.noiseModel.Constrained.All(self._k)))
        for row in self._rows[k]:
            i, j = int(self._factors.i[row]), int(self._factors.j[row])
            Z = self._pose(self._factors.measurement[row])
            # In space gtsam's rotations come first.
            root = np.roll(self._factors.sqrt_information[row], self._k // 6 * 3, axis=1)
            new.add(self._Between(i, j, Z, gtsam.noiseModel.Gaussian.SqrtInformation(root)))
            if self._odometry[row]:
                step = Z if j == k else Z.inverse()
        values.insert(k, self._at.compose(step))
        began = time.thread_time()
        self._isam.update(new, values)
        estimate = (self._isam.calculateEstimatePose2 if self._k == 3 else
                    self._isam.calculateEstimatePose3)
        self._at = estimate(k)
        seconds = time.thread_time() - began
        self._left -= seconds
        return [seconds]

    def _pose(self, pose: Array) -> Any:
        if self._k == 3:
            return self._Pose(*pose)
        x, y, z, w = pose[3:]
        return self._Pose(self._gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


@contextmanager
def isam2(graph_of: Callable[[], FactorGraph], patience: float = float('inf')) -> Iterator[Peer]:
    """
    Give ISAM2 in a process of its own, as two back ends would run.

    In this one it would hold the interpreter's lock for all of an update, so that our threads
    stood still meanwhile, and its memory would count as ours. graph_of : called there.
    """
    context = multiprocessing.get_context('fork')
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, graph_of, patience), daemon=True)
    process.start()
    there.close()

    def update(k: int) -> list[float]:
        here.send(k)
        seconds: list[float] = here.recv()
        return seconds

    here.recv()
    yield update
    here.send(None)
    process.join()


def _serve(asked: Connection, graph_of: Callable[[], FactorGraph], patience: float) -> None:
    peer = _Isam2(graph_of(), patience)
    asked.send('ready')
    for k in iter(asked.recv, None):
        asked.send(peer.update(k))
