# SPDX-License-Identifier: Apache-2.0
"""
Graphs with lies in them: false loops, and odometry that slips or is worse than it was.

In: a folder of public graphs. Out: `FalseCase`, a graph and which of its loops are false. All is
drawn by a seed, false loops by the package's own `false_loops`.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from robust_kinds import CLEAN, DEGREES, HEADING, KINDS, METRES, NOISIER, OWN_SHARE, TENTH

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS, insert_loops
from l1slam_ros.io.graphs.graph_file import read_graph_file

_KEPT_TRUE = 0.1
_SLIP_TRANSLATION, _SLIP_ROTATION = 5.0, math.pi / 2
_HEADING_SIGMA = math.radians(1)
# A slip is not in the first tenth of the way, nor in the last.
_EDGE = 0.1


@dataclass(frozen=True)
class Place:
    """
    A graph without lies.

    stored : (n, p) poses of its file; best : (n, p) its L2 map; truth : (n, k) positions [m], None
    where nobody knows them; maps : what solvers made of the graph, by the solver's name.
    """

    name: str
    graph: FactorGraph
    stored: Array
    best: Array
    truth: Array | None
    maps: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FalseCase:
    """
    A graph with lies.

    graph : all of it; is_false : (m,) bool, its false loops; clean : the graph whose map is to be
    found; slip : row of the odometry factor that lies, -1: none does.
    """

    place: Place
    kind: str
    share: float
    seed: int
    graph: FactorGraph
    is_false: Mask
    clean: FactorGraph
    slip: int = -1


def public_place(datasets: Path, name: str) -> Place:
    """Return a graph of the folder, and the truth from NAME.truth.txt, `id x y theta`."""
    record = read_graph_file(datasets / f'{name}.g2o')
    assert record.poses is not None, name
    file = datasets / f'{name}.truth.txt'
    k = record.graph.manifold.TRANSLATION
    truth = np.loadtxt(file)[:, 1:][:, k] if file.exists() else None
    return place_of(name, record.graph, record.poses, truth)


def place_of(name: str, graph: FactorGraph, stored: Array, truth: Array | None) -> Place:
    """Return a place, its L2 map found from the seed."""
    cholesky = cholesky_of(graph)
    best = minimise_l2(graph, seed_poses(graph, cholesky), LeastSquaresOptions(), cholesky).poses
    return Place(name, graph, stored, best, truth)


def false_case(place: Place, kind: str, share: float, seed: int) -> FalseCase:
    """Return a graph of which `share` of all loops are false; count = true share / (1 - share)."""
    disturbance, lie, _ = OWN_SHARE.get(kind, ('', kind, share))
    rng = np.random.default_rng((seed, KINDS.index(kind), round(100 * share)))
    clean, step = _disturbed(place, disturbance, rng)
    target = place.graph if step >= 0 else clean
    if kind == CLEAN:
        return FalseCase(place, kind, share, seed, clean, np.zeros(len(clean.between), bool),
                         target)
    true = np.count_nonzero(~clean.between.is_odometry)
    lies = FALSE_LOOPS[lie](clean, place.best, round(true * share / (1 - share)), rng)
    graph = insert_loops(clean, lies)
    factors, n = graph.between, graph.n_poses
    is_false = np.isin(pair_key(factors.i, factors.j, n), pair_key(lies.i, lies.j, n))
    low = np.where(factors.is_odometry, np.minimum(factors.i, factors.j), -1)
    slip = int(np.argmax(low == step)) if step >= 0 else -1
    return FalseCase(place, kind, share, seed, graph, is_false, target, slip)


def _disturbed(
    place: Place, disturbance: str, rng: np.random.Generator
) -> tuple[FactorGraph, int]:
    """Return the graph before false loops, and the step at which its odometry slips, or -1."""
    graph, factors = place.graph, place.graph.between
    if disturbance == TENTH:
        loops = np.flatnonzero(~factors.is_odometry)
        kept = rng.choice(loops, round(len(loops) * _KEPT_TRUE), replace=False)
        left_out = ~factors.is_odometry
        left_out[kept] = False
        return graph.subset(~left_out), -1
    if disturbance == HEADING:
        return _with_heading_noise(graph, rng), -1
    if disturbance in NOISIER:
        return _simulated_anew(place, NOISIER[disturbance], rng), -1
    if disturbance in (METRES, DEGREES):
        rows = np.flatnonzero(factors.is_odometry)
        edge = int(len(rows) * _EDGE)
        row = rows[rng.integers(edge, len(rows) - edge)]
        slip = np.zeros((1, graph.manifold.TANGENT_SIZE))
        slip[0] = _slip(graph.manifold, disturbance == METRES, rng)
        moved = factors.measurement.copy()
        moved[row] = graph.manifold.retract(moved[row][None], slip)[0]
        step = int(min(factors.i[row], factors.j[row]))
        return _with_measurements(graph, moved, _information(graph)), step
    return graph, -1


def _slip(manifold: Manifold, moves: bool, rng: np.random.Generator) -> Array:
    """Return a step (d,) of 5 m in some direction, or of 90 degrees about some axis."""
    step = np.zeros(manifold.TANGENT_SIZE)
    part = manifold.TRANSLATION if moves else manifold.ROTATION
    direction = rng.standard_normal(len(step[part]))
    size = _SLIP_TRANSLATION if moves else _SLIP_ROTATION
    step[part] = size * direction / np.linalg.norm(direction)
    return step


def _with_heading_noise(graph: FactorGraph, rng: np.random.Generator) -> FactorGraph:
    """Return the graph with 1 degree more noise in each odometry factor, which says so."""
    factors, manifold = graph.between, graph.manifold
    rows = np.flatnonzero(factors.is_odometry)
    step = np.zeros((len(rows), manifold.TANGENT_SIZE))
    turned = step[:, manifold.ROTATION]
    step[:, manifold.ROTATION] = _HEADING_SIGMA * rng.standard_normal(turned.shape)
    measurement, information = factors.measurement.copy(), _information(graph)
    measurement[rows] = manifold.retract(measurement[rows], step)
    more = np.zeros(manifold.TANGENT_SIZE)
    more[manifold.ROTATION] = _HEADING_SIGMA**2
    information[rows] = np.linalg.inv(np.linalg.inv(information[rows]) + np.diag(more))
    return _with_measurements(graph, measurement, information)


def _simulated_anew(place: Place, times: float, rng: np.random.Generator) -> FactorGraph:
    """Return the graph, its odometry that of the L2 map with so many times the stated noise."""
    factors, manifold = place.graph.between, place.graph.manifold
    rows = np.flatnonzero(factors.is_odometry)
    white = rng.standard_normal((len(rows), manifold.TANGENT_SIZE, 1))
    noise = times * np.linalg.solve(factors.sqrt_information[rows], white)[:, :, 0]
    measurement = factors.measurement.copy()
    true = manifold.between(place.best[factors.i[rows]], place.best[factors.j[rows]])
    measurement[rows] = manifold.retract(true, noise)
    return _with_measurements(place.graph, measurement, _information(place.graph))


def _with_measurements(
    graph: FactorGraph, measurement: Array, information: Array
) -> FactorGraph:
    new = FactorGraph(graph.manifold)
    new.add_poses(graph.n_poses)
    new.add_between(graph.between.i, graph.between.j, measurement, information)
    return new


def _information(graph: FactorGraph) -> Array:
    root = graph.between.sqrt_information
    product: Array = root.transpose(0, 2, 1) @ root
    return product
