# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Problems whose answer is known: hand-solved LPs, random systems, tiny graphs, messages."""

from dataclasses import dataclass

import numpy as np
from heard import PERIOD, covariance6, hear, loop, odometry, seconds, straight  # noqa: F401
from scipy.optimize import linprog
from scipy.sparse import csr_array
from worlds import between, compose

import l1slam_ros as l1

PLANE = l1.Backend().manifold
WORLD = -1  # as an end of a factor


@dataclass(frozen=True)
class LinearProblem:
    """Minimise |A x - b|_1; x and y are the only primal and a dual optimum, |y| <= 1, A'y = 0."""

    A: csr_array
    b: np.ndarray
    x: np.ndarray
    y: np.ndarray
    optimum: float


def problem(A, b, x, y, optimum):
    return LinearProblem(csr_array(np.array(A, float)), *(np.array(v, float) for v in (b, x, y)),
                         optimum)


def median():
    """
    Minimise |x| + |x - 1| + |x - 5|: the median, x = 1, at a cost of 1 + 0 + 4 = 5.

    Dual: y1 = sign(1 - 0) = 1 and y3 = sign(1 - 5) = -1, so A'y = 0 leaves y2 = 0;
    -b'y = -(0 + 0 - 5) = 5.
    """
    return problem([[1], [1], [1]], [0, 1, 5], [1], [1, 0, -1], 5.0)


def weighted_median():
    """
    Minimise 3 |x| + |x - 1| + |x - 5|: the heavy row wins, x = 0, at a cost of 0 + 1 + 5 = 6.

    Dual: y2 = y3 = -1, and 3 y1 - 1 - 1 = 0 gives y1 = 2/3; -b'y = 1 + 5 = 6.
    """
    return problem([[3], [1], [1]], [0, 1, 5], [0], [2 / 3, -1, -1], 6.0)


def line_with_outlier():
    """
    Fit c + m t to (0, 0), (1, 1), (2, 2), (3, 3), (4, 10): c = 0, m = 1, cost |4 - 10| = 6.

    Dual: y5 = -1; A'y = 0 asks y1 + y2 + y3 + y4 = 1 and y2 + 2 y3 + 3 y4 = 4, which
    (-1/2, 0, 1/2, 1) does; -b'y = -(0 + 0 + 1 + 3 - 10) = 6.
    """
    return problem([[1, t] for t in range(5)], [0, 1, 2, 3, 10], [0, 1], [-0.5, 0, 0.5, 1, -1],
                   6.0)


def light_false_loop():
    """
    Minimise |x1 - 1| + |x2 - x1 - 1| + .5 |x2 - 5|: a chain of two and a loop of half its weight.

    The loop gives way: x = (1, 2), cost .5 * 3. Dual: y3 = sign(2 - 5) = -1; A'y = 0 asks
    y1 = y2 and y2 = 1/2; -b'y = -(1/2 + 1/2 - 5/2) = 3/2.
    """
    return problem([[1, 0], [-1, 1], [0, 0.5]], [1, 1, 2.5], [1, 2], [0.5, 0.5, -1], 1.5)


def consistent():
    """Minimise |x1 - 3| + |x1 + x2 - 4| + |x2 - 1|: x = (3, 1) fits all; cost 0, dual 0."""
    return problem([[1, 0], [1, 1], [0, 1]], [3, 4, 1], [3, 1], [0, 0, 0], 0.0)


HAND_SOLVED = [median, weighted_median, line_with_outlier, light_false_loop, consistent]
RANDOM_SYSTEMS = ['dense', 'sparse', 'scaled rows', 'empty row and column']


def random_system(kind, rng):
    """Return A (rows, columns) and b (rows,) of one of `RANDOM_SYSTEMS`."""
    if kind == 'dense':
        A = rng.standard_normal((30, 8))
    else:
        kept = rng.random((50, 15)) < 0.2
        kept[np.arange(50), rng.integers(15, size=50)] = True
        A = rng.standard_normal((50, 15)) * kept
    if kind == 'scaled rows':
        A *= 10 ** rng.uniform(-1.5, 1.5, (len(A), 1))
    if kind == 'empty row and column':
        A[[4, -1]] = 0.0
        A[:, [3, -1]] = 0.0
    return csr_array(A), rng.standard_normal(len(A))


def linprog_l1(A, b, box=np.inf):
    """Return the optimum of |A x - b|_1 with |x_j| <= box_j, and a minimiser, by HiGHS."""
    A = A.toarray()
    rows, columns = A.shape
    bound = np.broadcast_to(box, columns)
    solution = linprog(
        np.concatenate((np.zeros(columns), np.ones(rows))),
        A_ub=np.block([[A, -np.eye(rows)], [-A, -np.eye(rows)]]), b_ub=np.concatenate((b, -b)),
        bounds=[*zip(-bound, bound, strict=True), *[(0, None)] * rows], method='highs')
    assert solution.status == 0, solution.message
    return solution.fun, solution.x[:columns]


def random_poses(n, rng, spread=3.0):
    """Return n poses anywhere in SE(2), (n, 3)."""
    return np.concatenate((spread * rng.standard_normal((n, 2)),
                           rng.uniform(-np.pi, np.pi, (n, 1))), axis=1)


def random_information(n, rng):
    """Return n information matrices with every entry non-zero, (n, 3, 3)."""
    root = rng.standard_normal((n, 3, 3))
    return root @ root.transpose(0, 2, 1) + 0.5 * np.eye(3)


def drive(n, rng):
    """Return n poses of a robot that moves about a metre ahead and turns at will, (n, 3)."""
    poses = np.zeros((n, 3))
    for k in range(1, n):
        step = np.array([[1.0, 0.0, 0.0]]) + [0.2, 0.1, 0.6] * rng.standard_normal((1, 3))
        poses[k] = compose(poses[k - 1 : k], step)[0]
    return poses


# The information that factors state where nothing else is said.
USUAL = np.diag([100.0, 100.0, 400.0])


def chain_of(n):
    """Return the pairs of a chain, (n - 1, 2)."""
    return np.column_stack((np.arange(n - 1), np.arange(1, n)))


def graph_of(truth, pairs, noise=0.0, information=USUAL):
    """
    Return the graph that measures the pairs (m, 2) of the poses `truth` (n, 3).

    noise : (m, 3) steps applied to the measurements; information : (m, 3, 3); or one for all
    """
    graph, (i, j) = l1.FactorGraph(PLANE, len(truth)), np.array(pairs).T
    exact = between(truth[i], truth[j])
    graph.add_between(i, j, PLANE.retract(exact, np.broadcast_to(noise, exact.shape)),
                      np.broadcast_to(information, (*exact.shape, 3)))
    return graph


def add_absolute(graph, k, measurement, information):
    """Append absolute factors of keyframes k (m,)."""
    graph.add_between(np.full_like(k, WORLD), k, measurement, information)


def chain_and_loops(n, n_loops, rng):
    """Return the pairs of a chain of n and of as many loops, (n - 1 + n_loops, 2)."""
    first = rng.integers(n - 2, size=n_loops)
    last = rng.integers(first + 2, n)
    return [(k, k + 1) for k in range(n - 1)] + list(zip(first, last, strict=True))


def noisy_graph(n, n_loops, rng, sigma=(0.1, 0.1, 0.05)):
    """Return a graph with Gaussian noise and the truth (n, 3) it measures."""
    truth = drive(n, rng)
    pairs = chain_and_loops(n, n_loops, rng)
    noise = np.array(sigma) * rng.standard_normal((len(pairs), 3))
    return graph_of(truth, pairs, noise), truth
