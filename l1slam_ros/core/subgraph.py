# SPDX-License-Identifier: Apache-2.0
"""
Some factors of a graph, with more or less trust in them than they ask for.

In: a graph, which of its between factors, the variance that each one's noise has in the units of
its information. Out: a graph that solvers take like any other. Nothing is checked or copied twice.
"""

import numpy as np

from l1slam_ros.core.graph import BetweenFactors, FactorGraph
from l1slam_ros.core.manifold import Array, Indices


class SubGraph(FactorGraph):
    """
    All keyframes and priors of a graph, and some of its between factors.

    Parameters
    ----------
    graph : of the whole
    rows : (k,) the between factors
    variance : (k,) by which the covariance of each is multiplied

    """

    def __init__(self, graph: FactorGraph, rows: Indices, variance: Array):
        super().__init__(graph.manifold)
        factors = graph.between
        self.n_poses = graph.n_poses
        self._prior = graph._prior
        self._chosen = BetweenFactors(
            factors.i[rows], factors.j[rows], factors.measurement[rows],
            factors.sqrt_information[rows] / np.sqrt(variance)[:, None, None],
            factors.trusted[rows])

    @property
    def between(self) -> BetweenFactors:
        """The chosen factors; it does not grow."""
        return self._chosen
