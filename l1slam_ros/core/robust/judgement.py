# SPDX-License-Identifier: Apache-2.0
"""
What is believed of the factors of a graph while it grows.

In: the belief of the last update and the graph as it is now. Out: the belief after new evidence.
The rounds are those of the batch solve (`batch`), from the state that is there.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import outlook, reconsidered, rounds
from l1slam_ros.core.robust.rounds import Growth


@dataclass(frozen=True)
class Belief:
    """
    A judgement on the first m between factors of a graph.

    accepted, suspect : (m,) bool, a loop that is neither is rejected; sigmas : (m,), see
    `RobustSolution`, NaN before a loop was looked at; variance : (2,) of odometry and loops;
    settled : no more is to be found out from the factors that are there.
    """

    accepted: Mask
    suspect: Mask
    sigmas: Array
    variance: Array
    settled: bool = True

    @staticmethod
    def nothing() -> 'Belief':
        """Return the belief before there are factors."""
        none = np.zeros(0, bool)
        return Belief(none, none, np.zeros(0), np.ones(2))

    def extended(self, graph: FactorGraph, robust: bool) -> 'Belief':
        """
        Return the belief of all factors that the graph has by now.

        Of the new ones, odometry and what is trusted is believed; a loop is suspect until it was
        looked at, or where no loop is to be doubted, believed too.
        """
        factors, known = graph.between, len(self.accepted)
        if known == len(factors):
            return self
        sure = (factors.is_odometry | factors.trusted)[known:]
        new_loops = not sure.all()
        accepted = np.concatenate((self.accepted, sure | (not robust)))
        if not robust:
            accepted = np.ones(len(accepted), bool)
        suspect = np.concatenate((self.suspect, ~sure)) & ~accepted
        unknown = np.full(len(factors) - known, np.nan)
        return Belief(accepted, suspect, np.concatenate((self.sigmas, unknown)), self.variance,
                      not robust or (self.settled and not new_loops))


def judge(
    graph: FactorGraph, poses: Array, belief: Belief, deadline: float,
    check: Callable[[], None] = lambda: None,
) -> tuple[Belief, Array]:
    """
    Return what is to be believed, after looking again at all loops that are not, and its L2 map.

    A lie of the odometry is not looked for: that takes too long to do while driving.

    Parameters
    ----------
    poses : (n, p) the map of what was believed
    deadline : `time.monotonic()` [s] after which no second round begins
    check : called before long steps, raises where the work shall stop

    """
    first, settled = Growth(graph, check), True
    first.resume(poses, belief.accepted, belief.variance)
    growth = first
    for growth in rounds(first, lambda _: None):
        # The end is not put off once it is in sight, or short budgets would never get there.
        if time.monotonic() > deadline and not growth.takes_at_their_word:
            settled = False
            break
    square, suspect = outlook(growth)
    # What fits the map as it is may come in; what was believed stays until evidence is against it.
    accepted = growth.accepted | reconsidered(graph, growth.poses, growth.accepted)
    judged = Belief(accepted, suspect & ~accepted, np.sqrt(square), growth.variance, settled)
    return judged, growth.poses
