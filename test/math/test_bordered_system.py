# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A bordered system against the same least squares problem solved as a whole."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from systems import SHAPES, cholesky_of_system, random_system

from l1slam_ros.core.bordered.bordered_system import BorderedSystem

FIXED = -1  # in the place of a keyframe
OLD, NEW = 14, 6
CASES = [pytest.param(shape, k, id=f'{shape.__name__} {k}')
         for shape in SHAPES for k in ([3, 6] if shape is SHAPES[-1] else [3])]


class Whole:
    """All keyframes and all factors in one dense system."""

    def __init__(self, system, weights, k):
        self.k, columns = k, (OLD + NEW) * k
        A = np.zeros((len(system.b), columns))
        A[:, :OLD * k] = system.A.toarray()
        self.H = A.T @ (weights[:, None] * A)
        self.right = np.zeros(columns)

    def row(self, ends, blocks):
        J = np.zeros((self.k, OLD + NEW, self.k))
        for end, block in zip(ends, blocks, strict=True):
            if end != FIXED:
                J[:, end] += block
        return J.reshape(self.k, -1)

    def add(self, ends, blocks, noise, residual):
        J = self.row(ends, blocks)
        self.H += J.T @ (J / noise[:, None])
        self.right -= J.T @ (residual / noise)

    def covariance(self, ends, blocks, count):
        J, used = self.row(ends, blocks), count * self.k
        return J[:, :used] @ np.linalg.solve(self.H[:used, :used], J[:, :used].T)

    def steps(self, count):
        """Return the steps of the first keyframes, and zeros for all others, (n + 1, k)."""
        used, steps = count * self.k, np.zeros((OLD + NEW + 1, self.k))
        found = np.linalg.solve(self.H[:used, :used], self.right[:used])
        steps[:count] = found.reshape(count, self.k)
        return steps


@pytest.mark.parametrize('shape, k', CASES)
def test_a_border_is_the_whole_problem(k, shape, rng):
    """Old, new and fixed keyframes in all mixtures: steps, and what is predicted, are exact."""
    def factor(*count):
        """Return J_i and J_j, (2, ..., k, k), a residual and a noise, as those of graphs."""
        sign = np.array([-1.0, 1.0]).reshape(2, *(1,) * len(count), 1, 1)
        return (sign * np.eye(k) + 0.1 / k * rng.standard_normal((2, *count, k, k)),
                rng.standard_normal(k), rng.uniform(0.5, 2, k))

    system = random_system(shape(OLD), OLD, k, rng)
    system.blocks[:] = factor(len(system.blocks))[0].swapaxes(0, 1)
    system.blocks[system.keyframe == OLD] = 0.0
    cholesky, weights = cholesky_of_system(system), rng.uniform(0.5, 2.0, len(system.b))
    assert cholesky.factorise(system, weights)
    whole, border = Whole(system, weights, k), BorderedSystem(cholesky, OLD, k)
    for count in range(OLD, OLD + NEW):
        last = count - 1 if count % 5 else 3
        ends = (last, count) if count % 2 else (count, last)
        blocks, residual, noise = factor()
        border.begin(ends, blocks, residual, noise)
        whole.add(ends, blocks, noise, residual)
        known = count + 1
        i, j = rng.choice(OLD, 2, replace=False).tolist()
        pairs = (i, count), (count, OLD), (i, j), (FIXED, count), (j, FIXED)
        for ends in [pair for pair in pairs[count % 3:] if pair[0] != pair[1]]:
            blocks, residual, noise = factor()
            predicted, steps = border.predict(ends, blocks, residual), whole.steps(known)
            expected = residual + blocks[0] @ steps[ends[0]] + blocks[1] @ steps[ends[1]]
            assert_allclose(predicted.residual, expected, rtol=1e-6, atol=1e-8)
            assert_allclose(predicted.covariance, whole.covariance(ends, blocks, known),
                            rtol=1e-7, atol=1e-9)
            border.add(predicted, noise)
            whole.add(ends, blocks, noise, residual)
        steps = whole.steps(known)
        assert_allclose(border.steps().all(), steps[:known], rtol=1e-6, atol=1e-8)
        some = [i, j, OLD - 1, count, FIXED, known]
        assert_allclose(border.step(some), steps[some], rtol=1e-6, atol=1e-8)
    for v in range(OLD + NEW):
        for other, turn in (FIXED, np.zeros((k, k))), (int(rng.integers(OLD)), rng.normal(
                size=(k, k))):
            if v != other:
                expected = whole.covariance((v, other), np.stack((np.eye(k), -turn)), OLD + NEW)
                assert_allclose(border.covariance(v, other, turn), expected, rtol=1e-7, atol=1e-9)
    # To ask has changed nothing.
    assert_allclose(border.steps().all(), steps[:-1], rtol=1e-6, atol=1e-8)
