# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Part `iteration`: one iteration, beside the time that its bytes need at the measured bandwidth.

The bandwidth is that of a triad `a = b + s c`, counted as 24 bytes per element: over arrays far
larger than the second-level cache, and over arrays that together are as large as what the
iteration works on.
"""

import statistics
from collections.abc import Callable, Iterable

import numpy as np
from measuring import Measured, Row, clock, report_progress, row
from solvers.cases import Case, InnerProblem, inner_problems
from solvers.ours import ITERATIONS, Iteration

from l1slam_ros.core.geometry.manifold import Array

REFERENCE = ITERATIONS[0].name
_ITERATIONS = 400
_TRIAD_BYTES = 24
# Three arrays of this many elements: 600 MB, more than any second-level cache.
_LARGE = 25_000_000
# [s] A triad is repeated until it took this long.
_TRIAD_TIME = 0.2


def measure(cases: Iterable[Case], repeats: int, limit: float) -> list[Row]:
    """Return a row for each global problem and method; the limit is of no use here."""
    triad = compiled_triad()
    rows: list[Row] = []
    for case in cases:
        *_, problem = inner_problems(case)
        report_progress(f'iteration: {problem.name}')
        rows.extend(_rows(problem, case, triad, repeats))
    return rows


def _rows(problem: InnerProblem, case: Case, triad: Callable[..., None],
          repeats: int) -> list[Row]:
    edges = len(case.graph.between)
    sizes = {method.name: method.bytes_per_edge(problem) if method.bytes_per_edge else None
             for method in ITERATIONS}
    seconds: dict[str, list[float]] = {name: [] for name in sizes}
    bandwidths: dict[str, list[float]] = {name: [] for name in sizes}
    large: list[float] = []
    for method in ITERATIONS:
        method.run(problem, 1)
    for _ in range(repeats):
        large.append(bandwidth(triad, _LARGE))
        for method in ITERATIONS:
            seconds[method.name].append(_one(method, problem))
            if size := sizes[method.name]:
                elements = int(size * edges / _TRIAD_BYTES)
                bandwidths[method.name].append(bandwidth(triad, elements))
    numbers = {'edges': edges, 'bandwidth_large': statistics.median(large)}
    return [row(problem.name, 'one iteration', method.name, True,
                Measured(tuple(seconds[method.name]), np.zeros(0)),
                **numbers, **_needed(sizes[method.name], edges, bandwidths[method.name]))
            for method in ITERATIONS]


def _one(method: Iteration, problem: InnerProblem) -> float:
    """Return the time [s] of one iteration, without what comes before the first."""
    ends = []
    for count in (_ITERATIONS, 3 * _ITERATIONS):
        began = clock()
        method.run(problem, count)
        ends.append(clock() - began)
    return (ends[1] - ends[0]) / (2 * _ITERATIONS)


def _needed(size: float | None, edges: int, bandwidths: list[float]) -> dict[str, float]:
    """Return the bytes of an iteration, the bandwidth [B/s] at that size, and their time [s]."""
    if not size:
        return {}
    speed = statistics.median(bandwidths)
    return {'bytes_per_edge': size, 'bandwidth': speed, 'needed': size * edges / speed}


def bandwidth(triad: Callable[..., None], elements: int) -> float:
    """Return how many bytes a second a sum of two arrays of three moves [B/s]."""
    a = np.zeros(elements)
    b = np.ones(elements)
    c = np.ones(elements)
    triad(a, b, c, 0.5, 1)
    count = 1
    while True:
        began = clock()
        triad(a, b, c, 0.5, count)
        seconds = clock() - began
        if seconds > _TRIAD_TIME:
            return _TRIAD_BYTES * elements * count / seconds
        count *= 2


def compiled_triad() -> Callable[..., None]:
    """Return `a += s b`, so many times over, by BLAS; c is there for its bytes alone."""
    from scipy.linalg.blas import daxpy

    def triad(a: Array, b: Array, c: Array, s: float, count: int) -> None:
        for k in range(count):
            daxpy(b if k % 2 else c, a, a=s + k)

    return triad
