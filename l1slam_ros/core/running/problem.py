# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The problem to minimise: a graph, the judgement of its factors, and a warm start.

In: the graph of a back end at one moment. Out: a connected graph without the loops that a person
struck out, as judge and solvers need it, see `as_one`. `Improvement.of_all` turns a result for
that graph into one for all factors of the back end; `on_ties` puts its parts where they belong.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask, sigmas
from l1slam_ros.core.graph.factor_graph import (
    FactorGraph,
    component_labels,
    lowest_of_components,
)
from l1slam_ros.core.graph.parts import ends_before, give_to
from l1slam_ros.core.graph.spanning_tree import tree_poses
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.solvers.block_cholesky import Pattern
from l1slam_ros.core.solvers.solve import AUTO, PRIMAL_DUAL, Method, choose

# [rad] Of the heading of a part: that it is not known. Its place is, to the extent of the map.
_HEADING = 1.0


@dataclass(frozen=True)
class Problem:
    """
    A graph to optimise, with a warm start.

    map : names the map that it is of, another after `Backend.reset` and `Backend.restore`; graph :
    all factors; starts : poses (n, p) to start from, `poses` the first; dual : (rows,) to start
    from; judgement : of all factors; robust : loops may be doubted; last_cost : the cost that the
    last update left, for as many factors as there are now; solved : (n, p) the last map that was
    solved for, the other keyframes as they follow it; ties : so many of the last factors tie parts
    together, see `as_one`; pattern : of the last factorisation, None: there was none.
    """

    map: int
    graph: FactorGraph
    starts: list[Array]
    dual: Array
    judgement: Judgement
    robust: bool
    last_cost: float
    solved: Array
    ties: int = 0
    pattern: Pattern | None = None

    @property
    def poses(self) -> Array:
        """Where the keyframes are, (n, p)."""
        return self.starts[0]

    @cached_property
    def part(self) -> FactorGraph:
        """The factors that are believed."""
        return self.judgement.believed(self.graph)

    @cached_property
    def method(self) -> Method:
        """The solver for these factors."""
        return choose(AUTO, self.part, before=self.pattern)

    @property
    def is_sparse(self) -> bool:
        """Whether that solver uses factorisations."""
        return self.method.solver != PRIMAL_DUAL


def as_one(problem: Problem) -> Problem:
    """
    Return the problem with a connected graph, without the loops that a person struck out.

    Each part of the map is tied to the end of the one of its robot before, the first one of a
    robot to any keyframe: so weakly that whatever else joins them decides. A tie says how they
    stood in the last map that was solved for: what came since may have bent them.
    """
    graph, judgement = problem.graph, problem.judgement
    rows = graph.not_struck
    d = graph.manifold.TANGENT_SIZE
    firsts = graph.firsts
    g = len(firsts)
    if not g and len(rows) == len(graph.between):
        return problem
    return replace(
        problem, graph=_tied(graph.subset(rows), problem.solved, firsts), ties=g,
        dual=np.append(problem.dual.reshape(-1, d)[rows].ravel(), np.zeros(g * d)),
        judgement=replace(
            judgement, accepted=np.append(judgement.accepted[rows], np.ones(g, bool)),
            suspect=np.append(judgement.suspect[rows], np.zeros(g, bool)),
            sigmas=np.append(judgement.sigmas[rows], np.zeros(g)),
            noise=np.append(judgement.noise[rows], np.ones(g))))


def by_robot(problem: Problem) -> tuple[Problem, Indices]:
    """
    Return the problem with its keyframes sorted by robot, and the order (n,) of that.

    Then keyframes that are near along the way have near numbers, as the judge expects. The order
    has the number that each keyframe had before.
    """
    graph = problem.graph
    order = np.argsort(graph.robot, kind='stable')
    if (np.diff(order) == 1).all():
        return problem, order
    place = np.argsort(order)
    whole = FactorGraph(graph.manifold, len(order))
    factors = graph.between
    give_to(whole, graph.robot[order])
    before = graph.predecessor[order]
    whole.follow(np.arange(len(order)), np.where(before < 0, before, place[before]))
    whole.append_between(
        np.where(factors.is_absolute, factors.i, place[factors.i]), place[factors.j],
        factors.measurement, factors.sqrt_information, factors.trusted, factors.struck)
    return replace(problem, graph=whole, starts=[poses[order] for poses in problem.starts],
                   solved=problem.solved[order], pattern=None), order


def as_numbered(order: Indices, judgement: Judgement, poses: Array) -> tuple[Judgement, Array]:
    """Return judgement and poses of a problem `by_robot`, by the keyframes' former numbers."""
    return judgement.renumbered(order), poses[np.argsort(order)]


def on_ties(problem: Problem, judgement: Judgement, poses: Array) -> Array:
    """
    Return poses (n, p) of a problem `as_one`, each component moved as a whole onto its tie.

    A component is what accepted factors other than the ties join. A tie is weak, so a solver stops
    before it has moved a component there; and where ties close a cycle, as many of them may give
    way. Here a tie within a robot counts before one between robots, and of those within a robot
    the ones nearest to the first keyframe, or to the world where a factor names it. Where a step
    of odometry is refused that alone joins two components, none is moved.
    """
    graph, g = problem.graph, problem.ties
    factors = graph.between
    manifold = graph.manifold
    n = graph.n_poses
    if not g:
        return poses
    known = np.flatnonzero(judgement.accepted[:len(factors) - g])
    lowest = lowest_of_components(factors.i[known], factors.j[known], n + 1)
    names, component = np.unique(lowest[:-1], return_inverse=True)
    root = int(np.searchsorted(names, lowest[-1])) % len(names)
    rows = len(factors) - g + _tree_of_ties(
        component[factors.i[-g:]], component[factors.j[-g:]],
        graph.robot[factors.i[-g:]] == graph.robot[factors.j[-g:]], len(names))
    if not len(rows):
        return poses
    i, j = factors.i[rows], factors.j[rows]
    # T_i x_i Z = T_j x_j, where T are the motions of the components.
    moves = manifold.compose(
        manifold.compose(poses[i], factors.measurement[rows]), manifold.inverse(poses[j]))
    tree = FactorGraph(manifold, len(names))
    tree.append_between(component[i], component[j], moves, factors.sqrt_information[rows])
    if component_labels(tree).any():
        return poses
    motions = tree_poses(tree, root)
    motions = manifold.between(np.broadcast_to(motions[root], motions.shape), motions)
    return manifold.compose(motions[component], poses)


def _tree_of_ties(i: Indices, j: Indices, within: Mask, n: int) -> Indices:
    """Return which ties between n components i, j (g,) count; within : one robot, (g,) bool."""
    chosen = np.flatnonzero(within & (i != j))
    joined = lowest_of_components(i[chosen], j[chosen], n)
    between = []
    for tie in np.flatnonzero(~within).tolist():  # one for each robot
        one, other = joined[i[tie]], joined[j[tie]]
        if one != other:
            joined[joined == other] = one
            between.append(tie)
    return np.append(chosen, np.array(between, np.int64))


def _tied(graph: FactorGraph, poses: Array, firsts: Indices) -> FactorGraph:
    """Return the graph with the first keyframes of parts tied to others; poses : (n, p)."""
    manifold = graph.manifold
    d = graph.manifold.TANGENT_SIZE
    extent = float(np.ptp(manifold.positions(poses), axis=0).max()) if len(poses) else 0.0
    sigma = sigmas(manifold, 1.0 + extent, _HEADING)
    others = ends_before(graph)
    graph.follow(firsts, others)
    graph.append_between(
        others, firsts, manifold.between(poses[others], poses[firsts]),
        np.broadcast_to(np.diag(1 / sigma), (len(firsts), d, d)))
    return graph
