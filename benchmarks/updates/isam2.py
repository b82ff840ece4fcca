# SPDX-License-Identifier: Apache-2.0
"""gtsam's ISAM2, fed with a graph keyframe by keyframe."""

import importlib
import time
from typing import Any

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph

# [m or rad] It linearises again what has moved by more, after each pose.
_RELINEARISE = 0.1


class Isam2:
    """
    The peer: L2, every loop of the graph believed.

    Parameters
    ----------
    graph : what it is fed with
    patience : [s] of its updates in all; then it is left behind

    """

    def __init__(self, graph: FactorGraph, patience: float = float('inf')):
        gtsam: Any = importlib.import_module('gtsam')
        self._gtsam, self._factors, self._k = gtsam, graph.between, graph.manifold.TANGENT_SIZE
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
        self._odometry, self._left = self._factors.is_odometry, patience

    def update(self, k: int) -> list[float]:
        """Add keyframe k and its factors; return the seconds, [] once its time was up."""
        if self._left <= 0:
            return []
        gtsam, new, values, step = self._gtsam, self._gtsam.NonlinearFactorGraph(), \
            self._gtsam.Values(), self._Pose()
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
