# SPDX-License-Identifier: Apache-2.0
"""
Which factors of a graph to accept while it grows.

In: the judgement of the last update and the graph as it is now. Out: the judgement after new
evidence. The rounds are those of the batch solve (`batch`), from the state that is there.
"""

import time
from collections.abc import Callable

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import judgement_of, rounds
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.robust.rounds import Growth


def judge(
    graph: FactorGraph, poses: Array, known: Judgement, deadline: float,
    check: Callable[[], None] = lambda: None,
) -> tuple[Judgement, Array]:
    """
    Return what is to be accepted, after looking again at all loops that are not, and its L2 map.

    A slip of the odometry is not looked for: that takes too long to do while driving.

    Parameters
    ----------
    poses : (n, p) the map of what was accepted
    deadline : `time.monotonic()` [s] after which no second round begins
    check : called before long steps, raises where the work shall stop

    """
    growth, settled = Growth(graph, check), True
    growth.resume(poses, known.accepted, known.variance)
    for growth in rounds(growth, lambda _: None):
        # The end is not put off once it is in sight, or short budgets would never get there.
        if time.monotonic() > deadline and not growth.takes_at_their_word:
            settled = False
            break
    return judgement_of(growth, settled=settled), growth.poses
