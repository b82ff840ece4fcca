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
from systems import SHAPES, random_system

from l1slam_ros.core.bordered.bordered_system import BorderedSystem
from l1slam_ros.core.bordered.points import FIXED
from l1slam_ros.core.solvers.block_cholesky import BlockCholesky, find_pattern

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
        J = np.zeros((self.k, (OLD + NEW) * self.k))
        for end, block in zip(ends, blocks, strict=True):
            if end != FIXED:
                J[:, end * self.k:(end + 1) * self.k] += block
        return J

    def add(self, ends, blocks, noise, residual):
        J = self.row(ends, blocks)
        self.H += J.T @ (J / noise[:, None])
        self.right -= J.T @ (residual / noise)

    def covariance(self, ends, blocks, count):
        J, used = self.row(ends, blocks), count * self.k
        return J[:, :used] @ np.linalg.solve(self.H[:used, :used], J[:, :used].T)

    def steps(self, count):
        used = count * self.k
        return np.linalg.solve(self.H[:used, :used], self.right[:used]).reshape(-1, self.k)


def block(k, rng, *count):
    """Return J_i and J_j, (2, ..., k, k)."""
    sign = np.array([-1.0, 1.0]).reshape(2, *(1,) * len(count), 1, 1)
    return sign * np.eye(k) + 0.1 / k * rng.standard_normal((2, *count, k, k))


def factored(k, shape, rng):
    system = random_system(shape(OLD), OLD, k, rng)
    # Like those of a graph: random ones make a chain's error grow beyond double precision.
    system.blocks[:, 0], system.blocks[:, 1] = block(k, rng, len(system.blocks))
    system.blocks[system.keyframe == OLD] = 0.0
    cholesky = BlockCholesky(find_pattern(system.keyframe, OLD, 10**6), system.keyframe)
    weights = rng.uniform(0.5, 2.0, len(system.b))
    assert cholesky.factorise(system, weights)
    return system, weights, cholesky


@pytest.mark.parametrize('shape, k', CASES)
def test_a_border_is_the_whole_problem(k, shape, rng):
    """Old, new and fixed keyframes in all mixtures: steps, and what is predicted, are exact."""
    system, weights, cholesky = factored(k, shape, rng)
    whole, border = Whole(system, weights, k), BorderedSystem(cholesky, OLD, k)
    assert_allclose(border.steps().all(), 0)

    def compare(ends, blocks, residual, count):
        predicted = border.predict(ends, blocks, residual)
        steps = np.zeros((OLD + NEW + 1, k))
        steps[:count] = whole.steps(count)
        expected = residual + sum(block @ steps[end] for block, end in zip(
            blocks, ends, strict=True))
        assert_allclose(predicted.residual, expected, rtol=1e-6, atol=1e-8)
        assert_allclose(predicted.covariance, whole.covariance(ends, blocks, count), rtol=1e-7,
                        atol=1e-9)
        return predicted

    def factor(ends, count):
        blocks = block(k, rng)
        noise, residual = rng.uniform(0.5, 2, k), rng.standard_normal(k)
        border.add(compare(ends, blocks, residual, count), noise)
        whole.add(ends, blocks, noise, residual)

    for count in range(OLD, OLD + NEW):
        last = count - 1 if count % 5 else 3
        blocks = block(k, rng)
        noise, residual = rng.uniform(0.5, 2, k), rng.standard_normal(k)
        ends = (last, count) if count % 2 else (count, last)
        border.begin(ends, blocks, residual, noise)
        whole.add(ends, blocks, noise, residual)
        known = count + 1
        i, j = rng.choice(OLD, 2, replace=False).tolist()
        for pair in ((i, count), (count, OLD), (i, j), (FIXED, count), (j, FIXED))[count % 3:]:
            if pair[0] != pair[1]:
                factor(pair, known)
        steps = whole.steps(known)
        assert_allclose(border.steps().all(), steps, rtol=1e-6, atol=1e-8)
        some = [i, j, OLD - 1, count]
        assert_allclose(border.step([*some, FIXED, known]),
                        [*steps[some], *np.zeros((2, k))], rtol=1e-6, atol=1e-8)
    for v in range(OLD + NEW):
        for other, turn in (FIXED, np.zeros((k, k))), (int(rng.integers(OLD)), rng.normal(
                size=(k, k))):
            if v != other:
                assert_allclose(
                    border.covariance(v, other, turn), whole.covariance(
                        (v, other), np.stack((np.eye(k), -turn)), OLD + NEW),
                    rtol=1e-7, atol=1e-9)
    # To ask has changed nothing.
    assert_allclose(border.steps().all(), steps, rtol=1e-6, atol=1e-8)
