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

from l1slam_ros.core.bordered import points
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


@pytest.mark.parametrize('of_three', range(4), ids=lambda of_three: f'all but {of_three} of 3')
@pytest.mark.parametrize('shape, k', CASES)
def test_covariances_of_points_are_blocks_of_the_inverse(k, shape, of_three, rng):
    system, weights, cholesky = factored(k, shape, rng)
    A = system.A.toarray()
    inverse = np.linalg.inv(A.T @ (weights[:, None] * A)).reshape(OLD, k, OLD, k)
    order = rng.permutation(OLD)
    at, none = cholesky.pattern.position[order].astype(np.int64), np.full(OLD, FIXED)
    at[2] = FIXED
    kept, begins = np.zeros(0), none.copy()
    for count in range(1, OLD + 1):
        if count == 3:
            continue
        found, columns = cholesky.covariances(
            at[:count], none[:count], np.zeros((count, k, k)), kept, begins[:count])
        expected = inverse[order[:count], :, order[count - 1]].copy()
        expected[2:3] = 0.0
        assert_allclose(found, expected, atol=1e-9 * np.abs(inverse).max())
        # What is not kept is solved for.
        if of_three != count % 3:
            begins[count - 1] = len(kept)
            kept = np.append(kept, columns)


@pytest.mark.parametrize('longest', [0, 6, OLD])
@pytest.mark.parametrize('shape, k', CASES)
def test_a_border_is_the_whole_problem(k, shape, longest, rng, monkeypatch):
    """Old, new and fixed keyframes in all mixtures: steps, and what is predicted, are exact."""
    monkeypatch.setattr(points, '_LONGEST', longest)
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
        return blocks

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
    before = border.points
    for v in range(OLD + NEW):
        for other, turn in (FIXED, np.zeros((k, k))), (int(rng.integers(OLD)), rng.normal(
                size=(k, k))):
            if v != other:
                assert_allclose(
                    border.covariance(v, other, turn), whole.covariance(
                        (v, other), np.stack((np.eye(k), -turn)), OLD + NEW),
                    rtol=1e-7, atol=1e-9)
    assert border.points == before
    assert_allclose(border.steps().all(), steps, rtol=1e-6, atol=1e-8)
    taken = border.steps()
    factor((0, OLD + NEW - 1), OLD + NEW)
    assert_allclose(taken.all(), steps, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize('shape, k', CASES)
def test_a_keyframe_that_no_factor_kept_is_as_if_it_had_not_been_named(k, shape, rng):
    system, weights, cholesky = factored(k, shape, rng)
    whole, border = Whole(system, weights, k), BorderedSystem(cholesky, OLD, k)

    def add(ends):
        blocks = block(k, rng)
        noise = rng.uniform(0.5, 2, k)
        residual = rng.standard_normal(k)
        predicted = border.predict(ends, blocks, residual)
        assert_allclose(predicted.covariance, whole.covariance(ends, blocks, OLD), rtol=1e-7,
                        atol=1e-9)
        border.add(predicted, noise)
        whole.add(ends, blocks, noise, residual)

    border.step([3, 4, 5, 6])
    add((FIXED, 4))
    border.step([7])
    border.forget_unused(0)
    # Those behind the last that is used are gone, those before it name nothing any more.
    assert border.points == 2
    add((3, 6))
    add((5, 4))
    assert border.points == 5
    steps = whole.steps(OLD)
    assert_allclose(border.steps().all(), steps, rtol=1e-6, atol=1e-8)
    assert_allclose(border.step([3, 4, 5, 6, 7]), steps[3:8], rtol=1e-6, atol=1e-8)
