# SPDX-License-Identifier: Apache-2.0
"""
The paper's two trials: starts that are mostly noise (Figure 4), and loops that lie (Figure 6).

In: a graph and its stored poses. Out: what the methods make of each trial, how far off the map of
the untouched input that is, and which loops were refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, aligned_positions
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.robust_map import minimise_robustly
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_huber, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Solution
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.false_loops import Loops, identity_false_loops, insert_loops
from l1slam_ros.paper.experiments import Effort, printed_costs

START, L2, L1 = 'the start itself', 'L2', 'L1'
SEED, JOINT, ROBUST = 'seed alone', 'seed, then L1', 'loops doubted, then L1'
# Standard deviations of the noise on every stored pose, each [m] and [rad] alike.
NOISES = (0.25, 0.5, 1.0, 2.0)
# Where Huber turns linear [sigmas]; the narrower, the nearer to L1.
HUBER_OF_G2O = 1.0
HUBER_WIDTHS = (0.01, 0.1, HUBER_OF_G2O, 10.0)
# A map that is further off than this part of its diagonal looks bent to the eye.
_BENT = 0.02


@dataclass(frozen=True)
class Map:
    """positions : (n, k) [m], laid on the other map; error : RMSE off it [m]; cost : in L1."""

    positions: Array
    cost: float
    error: float


@dataclass(frozen=True)
class StartTrial:
    """What comes of one start; noise : one of `NOISES`; maps : by method, START among them."""

    noise: float
    maps: dict[str, Map]


@dataclass(frozen=True)
class StartTrials:
    """
    What comes of noisy starts.

    seed, solution : from no start at all; the trials are compared with the solution; l2 : the L2
    map from the seed; printed : (k,) costs of Algorithm 4 as printed, from the seed; trials : the
    draws of one noise after those of the other; loops : (m, 2); bent : [m] error from which on a
    map has lost its shape.
    """

    seed: Map
    solution: Map
    l2: Map
    printed: Array
    trials: Sequence[StartTrial]
    loops: Indices
    bent: float


@dataclass(frozen=True)
class LoopTrial:
    """
    What comes of one draw of false loops.

    maps : by method, each compared with its own of the clean graph; refused, kept : (k, 2) pairs
    that the false loops join, by what the robust method did; lost : (l, 2) those of the true
    factors that it refused.
    """

    maps: dict[str, Map]
    refused: Indices
    kept: Indices
    lost: Indices

    @property
    def false(self) -> Indices:
        """The pairs (k, 2) that all the false loops join."""
        return np.concatenate((self.refused, self.kept))


@dataclass(frozen=True)
class LoopTrials:
    """
    What comes of false loops.

    clean : by method, of the graph without; loops : (m, 2) its true ones; trials : one for each
    draw; bent : as of `StartTrials`, of the clean L1 map.
    """

    clean: dict[str, Map]
    loops: Indices
    trials: Sequence[LoopTrial]
    bent: float


def huber_name(width: float) -> str:
    """Return the method's name for one of `HUBER_WIDTHS`."""
    return f'Huber, width {width:g}'


def try_noisy_starts(
    graph: FactorGraph, stored: Array, effort: Effort, printed: Effort,
    rng: np.random.Generator, advance: Callable[[], None] = lambda: None,
) -> StartTrials:
    """
    Return what comes of the stored poses (n, p) under every noise, as often as `effort` says.

    printed : the effort of Algorithm 4 as printed; advance : called after each trial
    """
    cholesky = cholesky_of(graph)
    seed = seed_poses(graph, cholesky)
    solution = _minimise_l1(graph, seed).poses
    ours = graph.manifold.positions(solution)
    trials = []
    for noise in (noise for noise in NOISES for _ in range(effort.draws)):
        start = with_noise(graph, stored, noise, rng)
        maps = {START: start,
                L2: minimise_l2(graph, start, LeastSquaresOptions(), cholesky).poses,
                L1: _minimise_l1(graph, start).poses}
        trials.append(StartTrial(noise, {method: _compared(graph, poses, ours)
                                         for method, poses in maps.items()}))
        advance()
    l2 = minimise_l2(graph, seed, LeastSquaresOptions(), cholesky).poses
    return StartTrials(_compared(graph, seed, ours), _compared(graph, solution, ours),
                       _compared(graph, l2, ours), printed_costs(graph, seed, printed), trials,
                       _loops(graph), _bent(ours))


def with_noise(
    graph: FactorGraph, poses: Array, sigma: float, rng: np.random.Generator
) -> Array:
    """Return the poses (n, p), each moved at random by sigma [m] and [rad] in its own axes."""
    size = graph.manifold.TANGENT_SIZE
    return graph.manifold.retract(poses, sigma * rng.standard_normal((len(poses), size)))


def try_false_loops(
    graph: FactorGraph, stored: Array, count: int, effort: Effort,
    rng: np.random.Generator, advance: Callable[[], None] = lambda: None,
) -> LoopTrials:
    """
    Return what comes of `count` loops between far poses that measure no motion at all.

    stored : (n, p) where Huber starts, the other methods read no start; advance : called after
    each draw, and once for the clean graph

    Raises
    ------
    GraphError : too few far pairs are free, or the graph is no chain of odometry with loops.

    """
    poses, _ = _maps(graph, stored)
    reference = graph.manifold.positions(poses[JOINT])
    clean = {method: _compared(graph, p, reference) for method, p in poses.items()}
    advance()
    trials = []
    for _ in range(effort.draws):
        loops = identity_false_loops(graph, poses[JOINT], count, rng)
        trials.append(_try_loops(graph, stored, loops, clean))
        advance()
    return LoopTrials(clean, _loops(graph), trials, _bent(reference))


def _try_loops(
    graph: FactorGraph, stored: Array, loops: Loops, clean: dict[str, Map]
) -> LoopTrial:
    lying = insert_loops(graph, loops)
    maps, accepted = _maps(lying, stored)
    factors, n = lying.between, graph.n_poses
    false = np.isin(pair_key(factors.i, factors.j, n), pair_key(loops.i, loops.j, n))
    compared = {method: _compared(lying, poses, clean[method].positions)
                for method, poses in maps.items()}
    pairs = lying.between.pairs
    return LoopTrial(compared, refused=pairs[false & ~accepted], kept=pairs[false & accepted],
                     lost=pairs[~false & ~accepted])


def _maps(graph: FactorGraph, stored: Array) -> tuple[dict[str, Array], Mask]:
    """Return the poses by every method, and which factors the robust one accepted."""
    cholesky = cholesky_of(graph)
    seed, robust = seed_poses(graph, cholesky), minimise_robustly(graph, _minimise_l1)
    hubers = {huber_name(width): minimise_huber(
        graph, stored, LeastSquaresOptions(huber_delta=width), cholesky).poses
        for width in HUBER_WIDTHS}
    return {SEED: seed, JOINT: _minimise_l1(graph, seed).poses, **hubers,
            ROBUST: robust.solution.poses}, robust.judgement.accepted


def _loops(graph: FactorGraph) -> Indices:
    loops: Indices = graph.between.pairs[~graph.between.is_odometry]
    return loops


def _minimise_l1(graph: FactorGraph, poses: Array) -> Solution:
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0]


def _compared(graph: FactorGraph, poses: Array, reference: Array) -> Map:
    """Return the map of poses (n, p), laid on the positions (n, k) of the reference."""
    positions = graph.manifold.positions(poses)
    return Map(aligned_positions(positions, reference), l1_cost(whitened_residual(graph, poses)),
               absolute_trajectory_error(positions, reference))


def _bent(positions: Array) -> float:
    return float(_BENT * np.linalg.norm(np.ptp(positions, axis=0)))
