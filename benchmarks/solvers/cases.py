# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What is measured: graphs with their starts, and the linear L1 problems inside them.

In: a folder of public graphs. Out: `Case` (a graph, poses to start from) and `InnerProblem`
(minimise |A x - b|_1). Worlds come from the package's own simulation, by a fixed seed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import LinearSystem, anchor, linearise
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import read_graph_file

GRAPHS = ('intel', 'manhattan3500', 'city10000')
# Poses and edges of the world that has many loops per pose.
DENSE_WORLD = (10_000, 64_000)
STARTS = ('stored', 'odometry', 'seed')
WORLD_SEED = 4
# [m, rad] How far, one sigma, a perturbed start lies from the stored one.
_PERTURBATION = (0.2, 0.05)


@dataclass(frozen=True)
class Case:
    """A graph and its stored poses (n, p)."""

    name: str
    graph: FactorGraph
    stored: Array

    @cached_property
    def starts(self) -> dict[str, Array]:
        """Poses (n, p) by the name of the start; the seed is not counted where it is one."""
        return {'stored': self.stored, 'odometry': odometry_poses(self.graph), 'seed': self.seed}

    @cached_property
    def seed(self) -> Array:
        """The poses of Algorithm 3, (n, p)."""
        return seed_of(self.graph)

    def perturbed(self, number: int) -> Array:
        """Return the stored poses, each but the first moved by noise of its own, (n, p)."""
        manifold = self.graph.manifold
        sigma = np.empty(manifold.TANGENT_SIZE)
        sigma[manifold.TRANSLATION], sigma[manifold.ROTATION] = _PERTURBATION
        rng = np.random.default_rng((WORLD_SEED, number))
        step = sigma * rng.standard_normal((self.graph.n_poses, manifold.TANGENT_SIZE))
        step[0] = 0.0
        return manifold.retract(self.stored, step)


@dataclass(frozen=True)
class InnerProblem:
    """
    Minimise |A x - b|_1.

    graph : whose factors it is made of; system : A and b in blocks. A is there as a sparse matrix
    too, made before any clock starts.
    """

    name: str
    graph: FactorGraph
    system: LinearSystem

    @cached_property
    def A(self) -> csr_array:
        """(rows, columns)."""
        return self.system.A

    @property
    def b(self) -> Array:
        """(rows,)."""
        return self.system.b

    def cost(self, x: Array) -> float:
        """Return |A x - b|_1, the only word that is taken for how good an x is."""
        return float(np.abs(self.A @ x - self.b).sum())


def seed_of(graph: FactorGraph) -> Array:
    """Return the poses of Algorithm 3, (n, p), found as the package finds them by default."""
    return seed_poses(graph, choose(AUTO, graph).cholesky)


def public_case(datasets: Path, name: str) -> Case:
    """Return one of `GRAPHS`."""
    record = read_graph_file(datasets / f'{name}.g2o')
    assert record.poses is not None, name
    return Case(name, record.graph, record.poses)


def simulated_case(n_poses: int, n_edges: int) -> Case:
    """Return a world; what it stores is the odometry chain."""
    world = simulate_world(n_poses, n_edges, WorldOptions(), np.random.default_rng(WORLD_SEED))
    return Case(f'world {n_poses} / {n_edges}', world.graph, world.odometry)


def inner_problems(case: Case) -> Iterator[InnerProblem]:
    """
    Yield the angle and the translation problem of Algorithm 3 and the global step at the seed.

    All three at the seed. Unknowns of the first two are measured from the odometry chain, as
    Algorithm 3 meets them: measured from the seed, the answer would be zero.
    """
    graph, manifold = case.graph, case.graph.manifold
    system = linearise(graph, case.seed)
    chain = manifold.local(case.seed, odometry_poses(graph))[anchor(graph):]
    for name, entries in (('angle', manifold.ROTATION), ('translation', manifold.TRANSLATION)):
        part = system.part(entries)
        shifted = replace(part, b=part.b - part.times(chain[:, entries].ravel()))
        yield InnerProblem(f'{case.name}: {name}', graph, shifted)
    yield InnerProblem(f'{case.name}: global', graph, system)
