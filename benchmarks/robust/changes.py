# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What is made wrong in a graph before false loops come in: loops, odometry, noise, sessions.

Each change takes a place, a random generator and its amounts, and returns `Changed`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from robust.aliasing import aliased_loops, outnumbers
from robust.places import Place

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels

_SLIP_TRANSLATION, _SLIP_ROTATION = 5.0, math.pi / 2
_HEADING_SIGMA = math.radians(1)
# A slip is not in the first tenth of the way, nor in the last.
_EDGE = 0.1
_NO_INDEX = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Changed:
    """
    A changed graph.

    graph : its odometry whole and its loops true, but for what `lies` adds to it; clean : the
    graph whose map is to be found; lies : further factors, None without; steps : the keyframes
    at which the odometry slips; cut : the keyframe before which there is no odometry, 0 without;
    joined : by loops, where it is cut; outnumbered : more places lie than speak against them.
    """

    graph: FactorGraph
    clean: FactorGraph
    lies: Any = None
    steps: Indices = field(default_factory=lambda: _NO_INDEX)
    cut: int = 0
    joined: bool = True
    outnumbered: bool = False


def changed(place: Place, change: str, amounts: tuple[Any, ...],
            rng: np.random.Generator) -> Changed:
    """Return the graph of a place with one of `CHANGES`; '' is none."""
    if not change:
        return Changed(place.graph, place.graph)
    return CHANGES[change](place, rng, *amounts)


def _true(graph: FactorGraph) -> Changed:
    return Changed(graph, graph)


def _part_of_loops(place: Place, part: float, rng: np.random.Generator) -> FactorGraph:
    is_loop = ~place.graph.between.is_odometry
    loops = np.flatnonzero(is_loop)
    keep = ~is_loop
    keep[rng.choice(loops, round(len(loops) * part), replace=False)] = True
    return place.graph.subset(keep)


def _aliased(place: Place, rng: np.random.Generator, streets: int, whose: str,
             part: float = 1.0) -> Changed:
    graph = _part_of_loops(place, part, rng)
    lies = aliased_loops(graph, place.best, streets, whose == 'same', rng)
    return Changed(graph, graph, lies, outnumbered=outnumbers(graph, lies, streets, whose))


def _half_aliased(place: Place, rng: np.random.Generator, count: int) -> Changed:
    """Add loops that say with one voice that the second half of the way is elsewhere."""
    lies = aliased_loops(place.graph, place.best, count // 6, True, rng, length=6)
    return Changed(place.graph, place.graph, lies)


def _slip(place: Place, rng: np.random.Generator, what: str, count: int) -> Changed:
    """
    Move odometry factors by 5 m in some direction, or by 90 degrees about some axis.

    What they measured is gone, so the map to be found is that of all the others, which leave no
    part on its own.
    """
    graph = place.graph
    manifold = place.graph.manifold
    factors = place.graph.between
    steps = np.flatnonzero(factors.is_odometry)
    edge = int(len(steps) * _EDGE)
    others = FactorGraph(manifold)
    while others.n_poses == 0 or component_labels(others).any():
        rows = rng.choice(steps[edge:-edge], count, replace=False)
        others = graph.subset(np.delete(np.arange(len(factors)), rows))
    slips = np.stack([_wrong_step(manifold, what == 'translation', rng) for _ in rows])
    moved = factors.measurement.copy()
    moved[rows] = manifold.retract(moved[rows], slips)
    return Changed(_with(graph, measurement=moved), others,
                   steps=np.minimum(factors.i[rows], factors.j[rows]))


def _wrong_step(manifold: Manifold, moves: bool, rng: np.random.Generator) -> Array:
    step = np.zeros(manifold.TANGENT_SIZE)
    part = manifold.TRANSLATION if moves else manifold.ROTATION
    direction = rng.standard_normal(len(step[part]))
    step[part] = direction / np.linalg.norm(direction) * (
        _SLIP_TRANSLATION if moves else _SLIP_ROTATION)
    return step


def _heading(place: Place, rng: np.random.Generator) -> Changed:
    """Add 1 degree of noise to each odometry factor, which says so."""
    factors, manifold = place.graph.between, place.graph.manifold
    rows = np.flatnonzero(factors.is_odometry)
    step = np.zeros((len(rows), manifold.TANGENT_SIZE))
    turned = step[:, manifold.ROTATION]
    step[:, manifold.ROTATION] = _HEADING_SIGMA * rng.standard_normal(turned.shape)
    measurement, information = factors.measurement.copy(), information_of(place.graph)
    measurement[rows] = manifold.retract(measurement[rows], step)
    more = np.zeros(manifold.TANGENT_SIZE)
    more[manifold.ROTATION] = _HEADING_SIGMA**2
    information[rows] = np.linalg.inv(np.linalg.inv(information[rows]) + np.diag(more))
    return _true(_with(place.graph, measurement, information))


def _odometry(place: Place, rng: np.random.Generator, times: float) -> Changed:
    """Draw the odometry of the L2 map anew, with so many times the stated noise."""
    factors, manifold = place.graph.between, place.graph.manifold
    rows = np.flatnonzero(factors.is_odometry)
    white = rng.standard_normal((len(rows), manifold.TANGENT_SIZE, 1))
    noise = times * np.linalg.solve(factors.sqrt_information[rows], white)[:, :, 0]
    measurement = factors.measurement.copy()
    true = manifold.between(place.best[factors.i[rows]], place.best[factors.j[rows]])
    measurement[rows] = manifold.retract(true, noise)
    return _true(_with(place.graph, measurement))


def _drift(place: Place, rng: np.random.Generator, drift: float) -> Changed:
    """Let the odometry turn by so much more on each metre [rad/m]; the map is that without."""
    factors, measurement = place.graph.between, place.graph.between.measurement.copy()
    rows = factors.is_odometry
    measurement[rows, 2] += drift * np.linalg.norm(measurement[rows, :2], axis=1)
    return Changed(_with(place.graph, measurement), place.graph)


def _information(place: Place, rng: np.random.Generator, part: str, times: float) -> Changed:
    """State the noise of the odometry, or that of the loops, wrong."""
    is_odometry = place.graph.between.is_odometry
    rows = is_odometry if part == 'odometry' else ~is_odometry
    information = information_of(place.graph)
    information[rows] *= times
    return _true(_with(place.graph, information=information))


def _noise_free(place: Place, rng: np.random.Generator) -> Changed:
    """Let each loop measure exactly what the L2 map says."""
    factors, manifold = place.graph.between, place.graph.manifold
    exact = manifold.between(place.best[factors.i], place.best[factors.j])
    is_odometry = factors.is_odometry[:, None]
    return _true(_with(place.graph, np.where(is_odometry, factors.measurement, exact)))


def _sessions(place: Place, rng: np.random.Generator) -> Changed:
    return Changed(place.graph, place.graph, cut=place.graph.n_poses // 2)


def _apart(place: Place, rng: np.random.Generator) -> Changed:
    """Leave out all loops between the halves."""
    cut, factors = place.graph.n_poses // 2, place.graph.between
    across = ((factors.i < cut) != (factors.j < cut)) & ~factors.is_odometry
    graph = place.graph.subset(~across)
    return Changed(graph, graph, cut=cut, joined=False)


CHANGES: dict[str, Callable[..., Changed]] = {
    'thinned': lambda place, rng, part: _true(_part_of_loops(place, part, rng)),
    'heading': _heading, 'odometry': _odometry, 'drift': _drift, 'slip': _slip,
    'aliased': _aliased,
    'aliased half': lambda place, rng, *amounts: _aliased(place, rng, *amounts, part=0.5),
    'half aliased': _half_aliased,
    'information': _information, 'noise-free': _noise_free,
    'sessions': _sessions, 'apart': _apart,
}


def _with(graph: FactorGraph, measurement: Array | None = None,
          information: Array | None = None) -> FactorGraph:
    factors = graph.between
    new = FactorGraph(graph.manifold, graph.n_poses)
    new.add_between(factors.i, factors.j, factors.measurement if measurement is None
                    else measurement, information_of(graph) if information is None
                    else information)
    return new


def information_of(graph: FactorGraph) -> Array:
    """Return the information of each between factor, (m, d, d)."""
    root = graph.between.sqrt_information
    product: Array = root.transpose(0, 2, 1) @ root
    return product
