# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How a solver of min |A x - b|_1 is brought to a mark: a cost at most so much above the optimum.

Nobody's own word is taken: the cost is that of the x which came back. A solver that stops by a
tolerance is given one after the other, loosest first, and the cheapest run that reaches the mark
is its own; one that yields its iterates is stopped at the first that does.
"""

import itertools
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from measuring import Answer, timed
from scipy.sparse import csr_array
from scipy.sparse.linalg import SuperLU, splu
from solvers.cases import InnerProblem

from l1slam_ros.core.geometry.manifold import Array

Setting = Hashable
# 1e-2 to 1e-8, two to a decade.
TOLERANCES = tuple(float(f'{10**(-k / 2):.0e}') for k in range(4, 17))
# Iterations between two looks at the cost, when it is not yet known how many are needed.
_LOOK_EVERY = 20


class LinearSolver(Protocol):
    """What a row of the table of inner problems is made with."""

    @property
    def name(self) -> str:
        """Of the row."""

    def reach(self, problem: InnerProblem, costs: Sequence[float],
              limit: float) -> list[Setting | None]:
        """Return the setting that reaches each cost the fastest; None: not in `limit` [s]."""

    def run(self, problem: InnerProblem, setting: Setting, limit: float) -> Answer:
        """Solve once, in at most about `limit` [s]."""


@dataclass(frozen=True)
class ByTolerance:
    """
    A solver that stops by itself.

    sweeps : settings to try, loosest first, of each form or method that it offers
    solve : problem, setting, time limit [s] -> x and the time it took
    """

    name: str
    sweeps: tuple[tuple[Setting, ...], ...]
    solve: Callable[[InnerProblem, Setting, float], Answer]

    def reach(self, problem: InnerProblem, costs: Sequence[float],
              limit: float) -> list[Setting | None]:
        """Try the settings of each sweep until one reaches the lowest cost or takes too long."""
        tried: list[tuple[float, float, Setting]] = []
        for sweep in self.sweeps:
            for setting in sweep:
                began = time.monotonic()
                answer = self.solve(problem, setting, limit)
                tried.append((answer.seconds, problem.cost(answer.x), setting))
                # By the wall, as the solvers know it.
                if tried[-1][1] <= min(costs) or time.monotonic() - began >= limit:
                    break
        best = [min((t for t in tried if t[0] < limit and t[1] <= cost), key=lambda t: t[0],
                    default=None) for cost in costs]
        return [t[2] if t else None for t in best]

    def run(self, problem: InnerProblem, setting: Setting, limit: float) -> Answer:
        """Solve once."""
        return self.solve(problem, setting, limit)


@dataclass(frozen=True)
class ByIterations:
    """A solver that yields its x after each iteration; a setting is how many there are."""

    name: str
    iterates: Callable[[InnerProblem], Iterator[Array]]

    def reach(self, problem: InnerProblem, costs: Sequence[float],
              limit: float) -> list[Setting | None]:
        """Iterate, and note when each cost is first reached."""
        needed: list[Setting | None] = [None] * len(costs)
        deadline = time.monotonic() + limit
        for k, x in enumerate(self.iterates(problem), 1):
            if k % _LOOK_EVERY:
                continue
            cost = problem.cost(x)
            needed = [k if n is None and cost <= c else n
                      for n, c in zip(needed, costs, strict=True)]
            if None not in needed or time.monotonic() > deadline:
                break
        return needed

    def run(self, problem: InnerProblem, setting: Setting, limit: float) -> Answer:
        """Iterate as often as the setting says, however long that takes."""
        assert isinstance(setting, int)
        return timed(lambda: next(itertools.islice(self.iterates(problem), setting - 1, setting)))


def normal_factor(A: csr_array) -> SuperLU:
    """Return SciPy's factor of A'A."""
    return splu((A.T @ A).tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                options={'SymmetricMode': True})


def least_squares_start(A: csr_array, b: Array) -> tuple[Array, Array]:
    """Return the least squares solution (columns,), and the dual (rows,) its residuals suggest."""
    x = normal_factor(A).solve(A.T @ b)
    r = A @ x - b
    return x, np.clip(r / np.abs(r).mean(), -1, 1)
