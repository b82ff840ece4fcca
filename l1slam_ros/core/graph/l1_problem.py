# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What the interior point minimises: the L1 norm of a residual over poses that move by steps.

In: a graph, or a linear system in the place of one. Out: its residual, linearisation, curvature.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import (
    LinearSystem,
    anchor,
    ends,
    keyframes_of,
    linearise,
    step_poses,
    whitened_residual,
)
from l1slam_ros.core.graph.spanning_tree import compose_tree


@dataclass(frozen=True)
class GraphProblem:
    """The poses of a graph (n, p)."""

    graph: FactorGraph

    @cached_property
    def _keyframe(self) -> Indices:
        return keyframes_of(self.graph, anchor(self.graph))

    def residual(self, poses: Array) -> Array:
        """Return the whitened residual, (rows,)."""
        return whitened_residual(self.graph, poses)

    def linearise(self, poses: Array, residual: Array) -> LinearSystem:
        """Return the linear system whose b is minus the residual."""
        return linearise(self.graph, poses, residual, keyframe=self._keyframe)

    def step(self, poses: Array, x: Array) -> Array:
        """Return the poses moved by x (columns,)."""
        return step_poses(self.graph, poses, x)

    def step_along(self, poses: Array, x: Array) -> Array:
        """
        Return the poses moved by x (columns,), each as seen from its predecessor.

        The same to first order; but where a long way turns as a whole, none of it is torn.
        """
        manifold = self.graph.manifold
        fixed = anchor(self.graph)
        step = np.zeros((len(poses), manifold.TANGENT_SIZE))
        step[fixed:] = x.reshape(-1, manifold.TANGENT_SIZE)
        parent = self.graph.parent
        child = np.flatnonzero(parent != np.arange(len(parent)))
        before = parent[child]
        relative = manifold.between(poses[before], poses[child])
        carried = manifold.adjoint(manifold.inverse(relative)) @ step[before, :, None]
        chain = manifold.retract(poses, step)
        chain[child] = manifold.retract(relative, step[child] - carried[..., 0])
        return compose_tree(parent, chain)

    def curvature(self, poses: Array, dual: Array) -> Array:
        """Return the Hessian of dual'e for each factor, (m, 2, r, 2 k), see `Manifold`."""
        manifold, factors = self.graph.manifold, self.graph.between
        # That of the residual before it is whitened: L y.
        dual = native.blocks.unwhiten_dual(
            factors.sqrt_information, dual.reshape(-1, manifold.TANGENT_SIZE))
        return manifold.residual_curvature(factors.measurement, *ends(self.graph, poses), dual)


@dataclass(frozen=True)
class LinearProblem:
    """A step x (columns,) in the place of poses: |A x - b|."""

    system: LinearSystem

    def residual(self, poses: Array) -> Array:
        """See `GraphProblem`."""
        return self.system.times(poses) - self.system.b

    def linearise(self, poses: Array, residual: Array) -> LinearSystem:
        """See `GraphProblem`."""
        return replace(self.system, b=-residual)

    def step(self, poses: Array, x: Array) -> Array:
        """See `GraphProblem`."""
        return poses + x

    step_along = step

    def curvature(self, poses: Array, dual: Array) -> None:
        """See `GraphProblem`."""


L1Problem = GraphProblem | LinearProblem
