# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The fast primal-dual method: restarted, reflected Halpern steps on preconditioned blocks.

In: a `LinearSystem` and where to start. Out: as of Algorithm 2, the step x and its dual y.

Scaling. Each keyframe's columns are multiplied by R_v^-1, R_v'R_v = 2 sum_f A_fv'A_fv over its
factors. A factor joins two keyframes, |A_i x_i + A_j x_j|^2 <= 2 |A_i x_i|^2 + 2 |A_j x_j|^2, so
the scaled A has a norm of at most 1, and both step sizes can be 1: this is Algorithm 2 with blocks
in place of the diagonal T, and Sigma = 1. Below, A and x are the scaled ones.

Iteration. With w the primal weight, k iterations after a restart at (0, y0):

    d     = A'y / w
    y_bar = clip(y + w (A (x - 2 d) - b), -1, 1)
    a     = (k + 1) / (k + 2)
    x     <- a (x - 2 d)
    y     <- a (2 y_bar - y) + (1 - a) y0

(x - d, y_bar) is where a step of Algorithm 2 leads, and what is returned; its distance from (x, y)
in the norm w |x|^2 + |y|^2 / w + 2 y'A x, the fixed-point residual, says when to restart.

Single precision halves what an iteration has to read, and that is its time. The digits lost are
won back at each restart: b becomes b - A x in double precision, and x counts from 0 again.

Source: Lu and Yang, "Restarted Halpern PDHG for linear programming" (2024); for the weight and the
restarts Applegate et al. (2021), see `primal_dual`. Scaling and refinement are ours.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.linear_system import LinearSystem
from l1slam_ros.core.graph.tiles import LANES, Tiles
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.primal_dual import CHECK_EVERY, PrimalDualOptions, PrimalDualSolution

# Restart when the residual fell to this part of what it was at the first look, ...
_ENOUGH = 0.2
# ... or to this part and it rises again, ...
_SOME = 0.8
# ... or when this part of all iterations has been since the last restart.
_LONG = 0.36
# The weight that balances primal and dual, times the mean |A x - b|. Sparse graphs with a good
# start do not feel it from .15 to .5; dense worlds from a poor one need half the iterations at .1.
_BALANCE = 0.1
# How far the weight may go from there, either way. At ten times it drifts: on Manhattan 1e-4 then
# takes over 8,000 iterations in place of 5,400.
_WEIGHT_RANGE = 3.0
# [sigma] A mean |A x - b| below is as good as none; the weight must stay finite.
_EXACT = 1e-6


def scaled_system(system: LinearSystem) -> tuple[LinearSystem, Array]:
    """
    Return the system in scaled unknowns, |A| <= 1, and the R_v^-1, (size, k, k).

    x = R_v^-1 x_scaled of each keyframe; one without factors keeps its own scale.
    """
    scaled, inverse = native.halpern.scale(system.keyframe, system.blocks, system.size)
    return replace(system, blocks=scaled), inverse


def minimise_l1_halpern(
    system: LinearSystem,
    x: Array,
    y: Array,
    options: PrimalDualOptions,
    weight: float | None = None,
    deadline: float = np.inf,
) -> PrimalDualSolution:
    """
    Minimise |A x - b|_1 from (x, y).

    It stops when the duality gap is below `options.tolerance` of the cost: the gap to the best x'
    that is, in each scaled unknown, at most a typical residual farther from the start than x,
    `|x'_j - start_j| <= |x_j - start_j| + 1 / w`. (In a box of |x_j - start_j| alone every start
    would be optimal.)

    Parameters
    ----------
    system : A and b
    x, y : (columns,), (rows,), where to start; never written to
    options : see `PrimalDualOptions`
    weight : of an earlier solution nearby
    deadline : `time.monotonic()` [s] after which to stop at the next look

    """
    if not len(system.b) or not system.size:
        cost = float(np.abs(system.b).sum())
        return PrimalDualSolution(x, -np.sign(system.b), cost, 0.0, Status.CONVERGED, 0,
                                  np.array([(0.0, cost)]), weight or 1.0)
    run = _Run(system, x, y, weight)
    history = [(0.0, run.cost)]
    done = 0
    status = Status.ITERATION_LIMIT
    while done < options.iterations and status is Status.ITERATION_LIMIT:
        count = min(CHECK_EVERY, options.iterations - done)
        done += count
        residual, cost, gap = run.advance(count)
        history.append((done, cost))
        if gap <= options.tolerance * cost:
            status = Status.CONVERGED
        elif time.monotonic() > deadline:
            status = Status.OUT_OF_TIME
        elif run.restart_is_due(residual, done):
            run.restart(cost)
    x, y = run.candidate()
    history[-1] = (done, l1_cost(system.times(x) - system.b))
    return PrimalDualSolution(x, y, history[-1][1], gap, status, done, np.array(history),
                              run.weight)


class _Arrays:
    """The arrays of the compiled loop, in single precision, and calls of it."""

    def __init__(self, system: LinearSystem, scaled: LinearSystem, y: Array):
        self._size, k = system.block_size, system.block_size
        self._layout = Tiles(system.keyframe, system.size)
        columns = scaled.blocks.reshape(-1, 2 * k * k)
        dual = np.clip(y, -1, 1).reshape(-1, k)
        self._tiles = self._layout.pack(np.concatenate((columns, dual, dual, dual), axis=1))
        self.b, self.y, self._y0 = (
            self._tiles[:, row: row + k] for row in range(2 * k * k, 2 * k * k + 3 * k, k))
        self.x, self._z, self._g, self.x_bar, self.g_bar = np.zeros(
            (5, system.size + 1, k), np.float32)
        self.y_bar = np.empty((len(self._tiles), k, LANES), np.float32)
        self._g[:-1] = scaled.transposed_times(dual.ravel()).reshape(-1, k)

    def set_origin(self, residual: Array) -> None:
        """Let x count from where A x - b is `residual`, (rows,)."""
        self.b[:] = self._layout.pack(-residual.reshape(-1, self._size))
        self.x[:] = 0

    def iterate(self, weight: float, since: int, count: int) -> None:
        """Do `count` iterations; since : those since the restart."""
        native.halpern.iterate(self._tiles, self._layout.keyframe, self.x, self._z, self._g,
                               weight, since, count)

    def look(self, weight: float) -> tuple[float, float, float]:
        """Set the candidate; return the squared fixed-point residual, its cost and dual value."""
        return native.halpern.look(self._tiles, self._layout.keyframe, self.x, self._g, weight,
                                   self.x_bar, self.g_bar, self.y_bar)

    def movement(self) -> tuple[Any, Any]:
        """Return how far the candidate is from the last restart: primal and dual."""
        return np.linalg.norm(self.x_bar), np.linalg.norm(self.y_bar - self._y0)

    def restart(self) -> None:
        """Go on from the candidate, which is the origin of x now."""
        self.y[:] = self._y0[:] = self.y_bar
        self._g[:] = self.g_bar
        self.x_bar[:] = 0

    def dual(self) -> Array:
        """Return y of the candidate, (rows,)."""
        return self._layout.unpack(self.y_bar).ravel()


class _Run:
    """One solve: where in the problem the origin of the loop is, and when it restarts."""

    def __init__(self, system: LinearSystem, x: Array, y: Array, weight: float | None):
        self._system = system
        scaled, self._inverse = scaled_system(system)
        self._arrays = _Arrays(system, scaled, y)
        # Iterations since the restart, and the residuals of its first and its latest look.
        self._since = 0
        self._residuals: tuple[float, ...] = ()
        # The origin of the loop's x, and how far, scaled, it has come from the start.
        self._origin = np.array(x, float)
        self._offset = np.zeros((system.size, system.block_size))
        self.cost = self._set_origin()
        self.weight = weight or self._typical_weight(self.cost)

    def advance(self, count: int) -> tuple[float, float, float]:
        """Return the fixed-point residual, the cost and the gap after `count` more iterations."""
        self._arrays.iterate(self.weight, self._since, count)
        self._since += count
        squared, cost, dual = self._arrays.look(self.weight)
        box = np.abs(self._offset + self._arrays.x_bar[:-1]) + 1 / self.weight
        g = self._arrays.g_bar[:-1]
        gap = cost - dual + (g * self._offset).sum() + (np.abs(g) * box).sum()
        return float(np.sqrt(max(squared, 0.0))), cost, float(gap)

    def restart_is_due(self, residual: float, done: int) -> bool:
        """Tell whether to restart; residual : of this look; done : iterations of the solve."""
        if not self._residuals:
            self._residuals = (residual, residual)
            return False
        first, last = self._residuals
        self._residuals = (first, residual)
        return (residual <= _ENOUGH * first or last < residual <= _SOME * first
                or self._since >= _LONG * done)

    def restart(self, cost: float) -> None:
        """Go on from the candidate; cost : its |A x - b|_1."""
        moved, turned = self._arrays.movement()
        if moved > 0 and turned > 0:
            typical = self._typical_weight(cost)
            self.weight = float(np.clip(np.sqrt(self.weight * turned / moved),
                                        typical / _WEIGHT_RANGE, typical * _WEIGHT_RANGE))
        self._origin = self.candidate()[0]
        self._offset += self._arrays.x_bar[:-1]
        self._set_origin()
        self._arrays.restart()

    def candidate(self) -> tuple[Array, Array]:
        """Return x (columns,) and y (rows,) as of the last look."""
        step = self._inverse @ self._arrays.x_bar[:-1, :, None].astype(float)
        return self._origin + step.ravel(), self._arrays.dual()

    def _set_origin(self) -> float:
        """Let x of the loop count from the origin; return the cost there."""
        residual = self._system.times(self._origin) - self._system.b
        self._arrays.set_origin(residual)
        self._since = 0
        self._residuals = ()
        return l1_cost(residual)

    def _typical_weight(self, cost: float) -> float:
        return _BALANCE / max(cost / len(self._system.b), _EXACT)
