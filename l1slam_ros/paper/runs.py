# SPDX-License-Identifier: Apache-2.0
"""
The paper's two repeated runs: starts that are mostly noise (Figure 4), loops that lie (Figure 6).

In: a graph and its stored poses. Out: what the methods make of each draw, how far off the map of
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
from l1slam_ros.core.robust.batch import minimise_robustly
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, gauss_newton, minimise_l2
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions, Solution
from l1slam_ros.core.solvers.optimality import Huber, l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.false_loops import Loops, identity_false_loops, insert_loops
from l1slam_ros.paper.experiments import Effort, printed_costs

START, L2, L1 = 'the start itself', 'L2', 'L1'
SEED, JOINT, ROBUST = 'seed alone', 'seed, then L1', 'loops doubted, then L1'
# Standard deviations of the noise on every stored pose, each [m] and [rad] alike.
NOISES = (0.25, 0.5, 1.0, 2.0)
# Where Huber turns linear [sigmas], by name of the method; the narrower, the nearer to L1.
HUBERS = {f'Huber, width {width:g}': width for width in (0.01, 0.1, 1.0, 10.0)}
HUBER_OF_G2O = 'Huber, width 1'
# A map that is further off than this part of its diagonal looks bent to the eye.
_BENT = 0.02


@dataclass(frozen=True)
class Map:
    """positions : (n, k) [m], laid on the other map; error : RMSE off it [m]; cost : in L1."""

    positions: Array
    cost: float
    error: float


# By method.
Maps = dict[str, Map]


@dataclass(frozen=True)
class StartRuns:
    """
    What comes of noisy starts.

    from_seed : of no start at all, the seed as START; its L1 map is what all are compared with;
    noisy : by noise, of each draw; printed : (k,) costs of Algorithm 4 as printed, from the seed;
    bent : [m] error from which on a map has lost its shape.
    """

    from_seed: Maps
    noisy: dict[float, Sequence[Maps]]
    printed: Array
    bent: float


@dataclass(frozen=True)
class LoopRun:
    """
    What comes of one draw of false loops.

    maps : each compared with its method's own of the clean graph; refused, kept : (k, 2) pairs
    that the false loops join, by what the robust method did; lost : (l, 2) those of the true
    factors that it refused.
    """

    maps: Maps
    refused: Indices
    kept: Indices
    lost: Indices


@dataclass(frozen=True)
class LoopRuns:
    """
    What comes of false loops.

    clean : of the graph without; loops : (m, 2) its true ones; runs : one for each draw; bent : as
    of `StartRuns`, of the clean L1 map.
    """

    clean: Maps
    loops: Indices
    runs: Sequence[LoopRun]
    bent: float


def run_noisy_starts(graph: FactorGraph, stored: Array, effort: Effort, printed: Effort,
                     rng: np.random.Generator,
                     advance: Callable[[], None] = lambda: None) -> StartRuns:
    """
    Return what comes of the stored poses (n, p) under every noise, as often as `effort` says.

    printed : the effort of Algorithm 4 as printed; advance : called after each draw
    """
    cholesky = cholesky_of(graph)
    seed = seed_poses(graph, cholesky)
    ours = _minimise_l1(graph, seed).poses

    def maps(start: Array, l1: Array) -> Maps:
        l2 = minimise_l2(graph, start, LeastSquaresOptions(), cholesky).poses
        return _compared(graph, {START: start, L2: l2, L1: l1}, graph.manifold.positions(ours))

    noisy: dict[float, list[Maps]] = {noise: [] for noise in NOISES}
    for noise in (noise for noise in NOISES for _ in range(effort.draws)):
        start = with_noise(graph, stored, noise, rng)
        noisy[noise].append(maps(start, _minimise_l1(graph, start).poses))
        advance()
    return StartRuns(maps(seed, ours), dict(noisy), printed_costs(graph, seed, printed),
                     _bent(graph, ours))


def with_noise(graph: FactorGraph, poses: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Return the poses (n, p), each moved at random by sigma [m] and [rad] in its own axes."""
    size = graph.manifold.TANGENT_SIZE
    return graph.manifold.retract(poses, sigma * rng.standard_normal((len(poses), size)))


def run_false_loops(graph: FactorGraph, stored: Array, count: int, effort: Effort,
                    rng: np.random.Generator,
                    advance: Callable[[], None] = lambda: None) -> LoopRuns:
    """
    Return what comes of `count` loops between far poses that measure no motion at all.

    stored : (n, p) where Huber starts, the other methods read no start; advance : called after
    each draw, and once for the clean graph

    Raises
    ------
    GraphError : too few far pairs are free, or the graph is no chain of odometry with loops.

    """
    poses, _ = _poses(graph, stored)
    clean = _compared(graph, poses, graph.manifold.positions(poses[JOINT]))
    advance()
    runs = []
    for _ in range(effort.draws):
        loops = identity_false_loops(graph, poses[JOINT], count, rng)
        runs.append(_run_loops(graph, stored, loops, clean))
        advance()
    return LoopRuns(clean, loops_of(graph), runs, _bent(graph, poses[JOINT]))


def _run_loops(graph: FactorGraph, stored: Array, loops: Loops, clean: Maps) -> LoopRun:
    lying = insert_loops(graph, loops)
    poses, accepted = _poses(lying, stored)
    maps: Maps = {}
    for method, found in poses.items():
        maps |= _compared(lying, {method: found}, clean[method].positions)
    factors, n = lying.between, graph.n_poses
    false = np.isin(pair_key(factors.i, factors.j, n), pair_key(loops.i, loops.j, n))
    return LoopRun(maps, refused=factors.pairs[false & ~accepted],
                   kept=factors.pairs[false & accepted], lost=factors.pairs[~false & ~accepted])


def _poses(graph: FactorGraph, stored: Array) -> tuple[dict[str, Array], Mask]:
    """Return the poses by every method, and which factors the robust one accepted."""
    cholesky = cholesky_of(graph)
    seed, robust = seed_poses(graph, cholesky), minimise_robustly(graph, _minimise_l1)
    hubers = {name: gauss_newton(graph, stored, Huber(graph.manifold.TANGENT_SIZE, width),
                                 LeastSquaresOptions(), cholesky).poses
              for name, width in HUBERS.items()}
    return {SEED: seed, JOINT: _minimise_l1(graph, seed).poses, **hubers,
            ROBUST: robust.solution.poses}, robust.judgement.accepted


def loops_of(graph: FactorGraph) -> Indices:
    """Return the pairs that the loops of a graph join, (m, 2)."""
    loops: Indices = graph.between.pairs[~graph.between.is_odometry]
    return loops


def _minimise_l1(graph: FactorGraph, poses: Array) -> Solution:
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0]


def _compared(graph: FactorGraph, poses: dict[str, Array], reference: Array) -> Maps:
    """Return the maps of poses (n, p), laid on the positions (n, k) of the reference."""
    maps = {}
    for method, found in poses.items():
        positions = graph.manifold.positions(found)
        maps[method] = Map(aligned_positions(positions, reference),
                           l1_cost(whitened_residual(graph, found)),
                           absolute_trajectory_error(positions, reference))
    return maps


def _bent(graph: FactorGraph, poses: Array) -> float:
    return float(_BENT * np.linalg.norm(np.ptp(graph.manifold.positions(poses), axis=0)))
