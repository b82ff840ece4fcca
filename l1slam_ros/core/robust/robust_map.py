# SPDX-License-Identifier: Apache-2.0
"""
A robust map in the norm that was asked for.

In: a graph and a solver. Out: the solver's map of the loops that are accepted, and which these
are. The loops are judged in L2, which spreads a doubt over all factors near it, where L1 leaves it
on a few.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.parts import tied
from l1slam_ros.core.robust.batch import Report, robust_solve
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import l2_map
from l1slam_ros.core.solvers.nonlinear import Solution


@dataclass(frozen=True)
class RobustMap:
    """The map of the accepted factors, the L2 map (n, p) it began with, the judgement on all."""

    solution: Solution
    seed: Array
    judgement: Judgement


def minimise_robustly(
    graph: FactorGraph, minimise: Callable[[FactorGraph, Array], Solution],
    report: Report = lambda round_, accepted: None, check: Callable[[], None] = lambda: None,
) -> RobustMap:
    """
    Return the map that `minimise` makes of the factors that are accepted.

    minimise : from a graph and poses (n, p) to its solution; report, check : see `robust_solve`
    """
    judgement, poses = robust_solve(graph, report, check)
    accepted = graph.subset(judgement.accepted)
    whole = tied(accepted, poses)
    seed = l2_map(whole, poses, cholesky_of(whole), lambda *_: check())
    solution = minimise(whole, seed)
    rows = len(accepted.between) * graph.manifold.TANGENT_SIZE
    return RobustMap(replace(solution, dual=solution.dual[:rows]), seed, judgement)
