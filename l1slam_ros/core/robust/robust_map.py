# SPDX-License-Identifier: Apache-2.0
"""
A robust map in the norm that was asked for.

In: a graph and a solver. Out: the solver's map of the loops that may be believed, and which these
are. The loops are chosen in L2, which spreads a doubt over all factors near it, where L1 leaves it
on a few; L2 map and choice follow each other until nothing changes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.batch import (
    Report,
    minimise_accepted,
    mostly_refused,
    reconsidered,
    robust_solve,
)
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.nonlinear import Solution

# Measured: one or two until the choice stands; this ends one that swings.
_MOST_ROUNDS = 10


@dataclass(frozen=True)
class RobustMap:
    """The map of the believed factors, the L2 map (n, p) it began with, the judgement on all."""

    solution: Solution
    seed: Array
    judgement: Judgement


def minimise_robustly(
    graph: FactorGraph, minimise: Callable[[FactorGraph, Array], Solution],
    report: Report = lambda round_, accepted: None, check: Callable[[], None] = lambda: None,
) -> RobustMap:
    """
    Return the map that `minimise` makes of the factors that may be believed.

    minimise : from a graph and poses (n, p) to its solution; report, check : see `robust_solve`
    """
    found, poses = robust_solve(graph, report, check)
    accepted = found.accepted
    for _ in range(_MOST_ROUNDS):
        poses, before = minimise_accepted(graph, poses, accepted, check), accepted
        accepted = reconsidered(graph, poses, before)
        if (accepted == before).all():
            break
    solution = minimise(graph.subset(before), poses)
    doubt = found.doubt or mostly_refused(graph, before)
    return RobustMap(solution, poses, replace(
        found, accepted=before, suspect=found.suspect & ~before, doubt=doubt))
