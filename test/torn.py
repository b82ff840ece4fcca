# SPDX-License-Identifier: Apache-2.0
"""A graph that no map is made of: loops which must be refused say together that it is wrong."""

import numpy as np
from lies import careful_world, spoilt

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph


def torn_graph():
    """Return a graph with false loops and two slips, and the keyframes before these, (2,)."""
    graph, rng = spoilt(careful_world(400, 800), 'random', 170).graph, np.random.default_rng(5)
    factors = graph.between
    slips = np.sort(rng.choice(np.flatnonzero(factors.is_odometry), 2, replace=False))
    measurement, off = factors.measurement.copy(), rng.normal(size=(2, 3)) * [4, 4, 1.5]
    measurement[slips] = se2.retract(measurement[slips], off)
    torn = FactorGraph(se2)
    torn.add_poses(graph.n_poses)
    torn.add_between(factors.i, factors.j, measurement,
                     factors.sqrt_information.transpose(0, 2, 1) @ factors.sqrt_information)
    return torn, factors.i[slips]
