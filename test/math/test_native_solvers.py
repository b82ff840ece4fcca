# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of the solvers against NumPy, and with arrays that do not fit."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from systems import chain, cholesky_of_system, random_loops, random_system

from l1slam_ros.core import native
from l1slam_ros.core.robust.innovation import SAMPLES

pytestmark = pytest.mark.usefixtures('level')
POSES = pytest.mark.parametrize('k', [3, 6])
ROWS = 1037  # more than the interior point takes in one run, and no multiple of a vector


@pytest.fixture
def rows(rng):
    """Return u, v, s, t, q, e, y and a step of y of an interior point."""
    u, v, s, t = rng.uniform(0.1, 2, (4, ROWS))
    e, y, dy = rng.standard_normal((3, ROWS))
    return u, v, s, t, 1 / (u / s + v / t), e, y, dy


# The interior point


def test_it_begins_on_the_central_path(rng):
    e, mu = 10.0 ** rng.uniform(-9, 3, ROWS) * rng.choice((-1, 1), ROWS), 0.3
    u, v, s, t, y = native.interior_point.begin(e, mu)
    assert_allclose([u * s, v * t], mu, rtol=1e-12)
    assert_allclose(u - v, e, rtol=1e-12, atol=1e-15)
    assert_allclose([s, t], [1 - y, 1 + y], rtol=1e-6, atol=1e-12)
    assert min(part.min() for part in (u, v, s, t)) > 0


def test_products_are_aimed_at(rows):
    u, v, s, t, q, e, y, dy = rows
    kernels, state, c1, c2 = native.interior_point, rows[:7], 0.2 * u, 0.3 * v
    weights, gap = kernels.weigh(u, v, s, t)
    assert_allclose(weights, q, rtol=1e-12)
    assert gap == pytest.approx(u @ s + v @ t, rel=1e-12)

    def pull(c1, c2):
        return -(y + q * (e - c1 / s + c2 / t))

    assert_allclose(kernels.aim(*state, c1, c2), pull(c1, c2), rtol=1e-10, atol=1e-13)
    one, other, found = kernels.aim_combined(*state, dy, 0.1, 0.5)
    assert_allclose(one, 0.1 + np.clip((u * dy / s - u) * dy, -0.5, 0.5), rtol=1e-10, atol=1e-13)
    assert_allclose(other, 0.1 - np.clip((-v * dy / t - v) * dy, -0.5, 0.5), rtol=1e-10,
                    atol=1e-13)
    assert_allclose(found, pull(one, other), rtol=1e-10, atol=1e-12)
    one, other, found = kernels.aim_centrally(*state, dy, c1, c2, 0.2, 0.9)
    for new, c, end in ((one, c1, c1 - ((c1 + u * dy) / s - u) * dy),
                        (other, c2, c2 + ((c2 - v * dy) / t - v) * dy)):
        assert_allclose(new, c + np.maximum(np.clip(end, 0.2, 0.9) - end, -0.9), rtol=1e-10,
                        atol=1e-12)
    assert_allclose(found, pull(one, other), rtol=1e-10, atol=1e-12)


def test_a_step_goes_up_to_the_nearest_bound(rows):
    u, v, s, t, q, e, y, moved = rows
    kernels, c1, c2, fraction = native.interior_point, 0.2 * u, 0.3 * v, 0.99
    dy, primal, dual, gap = kernels.complete(*rows[:7], c1, c2, moved, fraction)
    assert_allclose(dy, q * (moved + e - c1 / s + c2 / t), rtol=1e-10, atol=1e-13)
    du, dv = (c1 + u * dy) / s - u, (c2 - v * dy) / t - v
    assert primal == pytest.approx(min(1, fraction / max((-du / u).max(), (-dv / v).max())))
    assert dual == pytest.approx(min(1, fraction / max((dy / s).max(), (-dy / t).max())))
    after = [u + primal * du, v + primal * dv, s - dual * dy, t + dual * dy, y + dual * dy]
    assert gap == pytest.approx(after[0] @ after[2] + after[1] @ after[3])
    kernels.advance(u, v, s, t, y, c1, c2, dy, primal, dual, 1e-15)
    assert_allclose([u, v, s, t, y], after, rtol=1e-10, atol=1e-13)
    found = kernels.missing(u, v, s, t, e)
    assert_allclose(found, (u @ s + v @ t, np.abs(e - u + v).sum()), rtol=1e-12)
    found = kernels.depart(y, e, moved, 0.5)
    assert_allclose(found, (np.abs(y).sum(), np.abs(y - e - 0.5 * moved).sum()), rtol=1e-12)


# Predicted innovations


@pytest.fixture
def sampled(k, rng):
    """Return a system, its matrix (m, k, (n + 1) k) with what is held fixed, steps and signs."""
    system = random_system(random_loops(19), 19, k, rng)
    m = len(system.blocks)
    A = np.zeros((m, k, 20, k))
    for f, pair in enumerate(system.keyframe):
        for side, v in enumerate(pair):
            A[f, :, v] += system.blocks[f, side]
    return (system, A.reshape(m, k, -1), rng.standard_normal((20, k, SAMPLES)),
            rng.choice(np.array((-1, 1), np.int8), (m, k, SAMPLES)))


@POSES
def test_samples_are_gathered_and_moved(sampled, k):
    system, A, x, y = sampled
    product = x.copy()
    native.prediction.gather(system.keyframe, system.blocks, y, product)
    assert_allclose(product - x, np.einsum('mrc,mrq->cq', A, y).reshape(x.shape), atol=1e-11)
    Ax = A @ x.reshape(-1, SAMPLES)
    assert_allclose(native.prediction.moved(system.keyframe, system.blocks, x), Ax, atol=1e-11)
    for count in 0, 5, len(y):
        left = -Ax
        left[:count] += y[:count]
        assert_allclose(
            native.prediction.left_over(system.keyframe, system.blocks, x, y[:count]),
            left @ left.transpose(0, 2, 1) / SAMPLES, atol=1e-10)


@POSES
def test_samples_of_any_number_of_keyframes_are_moved(k, rng):
    keyframe, blocks = rng.integers(0, 20, (7, 4)), rng.standard_normal((7, 4, k, k))
    x = rng.standard_normal((20, k, SAMPLES))
    assert_allclose(native.prediction.moved(keyframe, blocks, x),
                    np.einsum('msrc,mscq->mrq', blocks, x[keyframe]), atol=1e-11)


@pytest.mark.parametrize('k', [1, 2, 3, 6])
def test_innovations_are_normalised(k, rng):
    root, r = rng.standard_normal((9, k, k + 2)), rng.standard_normal((9, k))
    C = root @ root.transpose(0, 2, 1)
    C[4] = -np.eye(k)
    C.setflags(write=False)
    square, log_det = native.prediction.normalise(C, r)
    assert (square[4], log_det[4]) == (np.inf, -np.inf)
    for f in set(range(9)) - {4}:
        assert square[f] == pytest.approx(r[f] @ np.linalg.solve(C[f], r[f]), rel=1e-9)
        assert log_det[f] == pytest.approx(np.linalg.slogdet(C[f])[1], rel=1e-9, abs=1e-12)


# What does not fit


@POSES
def test_wrong_arguments_are_named_and_nothing_is_read(k, rng):
    system = random_system(2 * chain(7), 7, k, rng)
    m, rows, x = len(system.blocks), np.ones((14, k)), np.ones((7, k))
    keyframe, blocks, solver = system.keyframe, system.blocks, cholesky_of_system(system)
    assert solver.factorise(system, rows.ravel(), 0.1)
    layout, position = solver._layouts[k], solver.pattern.position
    steps, signs = np.zeros((8, k, SAMPLES)), np.ones((m, k, SAMPLES), np.int8)
    share, off = np.zeros(len(solver.pattern.first) - 1, np.int8), keyframe + 7
    shape, shifted = layout.shape, [*layout.shape]
    shifted[3] = shifted[3] + 8
    far = [*layout.places]
    far[0] = far[0] + len(layout.panels)
    normal = blocks, rows, x, np.empty((0, 2, k // 2, 2 * k)), 0.0
    calls = [
        ('x', native.blocks.multiply, keyframe, blocks, x[:, 1:].copy()),
        ('keyframe', native.blocks.multiply, keyframe[1:], blocks, x),
        ('y', native.blocks.multiply_transposed, keyframe, blocks, rows[1:], 7),
        ('n', native.blocks.multiply_transposed, keyframe, blocks, rows, -1),
        ('roots', native.blocks.whiten, np.ones((3, k, k)), rows),
        ('blocks', native.blocks.whiten_blocks, np.ones((m, k, k)), np.ones((m, 1, k, k))),
        ('address', native.blocks.assemble, layout.panels, keyframe, *far, *normal),
        ('weights', native.blocks.assemble, layout.panels, keyframe, *layout.places, blocks,
         rows[1:], *normal[2:]),
        ('panels', native.cholesky.factorise, layout.panels[:-8], *shape, share, k, 1),
        ('panels', native.cholesky.factorise, layout.panels, *shifted, share, k, 1),
        ('share', native.cholesky.factorise, layout.panels, *shape, share[1:], k, 1),
        ('right', native.substitution.solve, layout.panels, *shape, position, x[1:]),
        ('position', native.substitution.solve, layout.panels, *shape, position + np.int32(1),
         x),
        ('right', native.prediction.solve_many, layout.panels, *shape, position, steps),
        ('keyframe', native.prediction.moved, off, blocks, steps),
        ('y', native.prediction.gather, keyframe, blocks, signs[1:], steps),
        ('second', native.prediction.normalise_pairs, np.ones((2, k, k)), np.ones((2, k)),
         np.ones((2 * k, 2 * k)), np.array([0]), np.array([2])),
        ('all arrays', native.interior_point.weigh, *np.ones((3, 5)), np.ones(4)),
        ('blocks', native.halpern.scale, keyframe, blocks[:, :1].copy(), 7)]
    for name, kernel, *arguments in calls:
        with pytest.raises(TypeError, match=rf'{name}\b.* must '):
            kernel(*arguments)
    tiles = np.ones((1, 2 * k * k + 3 * k, 16), np.float32)
    at, single = np.full((1, 2, 16), 7, np.int32), np.ones((8, k), np.float32)
    four = np.ones((8, 4), np.float32)
    for name, *arguments in (('tiles', tiles[:, 1:].copy(), at, single),
                             ('keyframe', tiles, at + np.int32(1), single),
                             ('x', tiles, at, four)):
        with pytest.raises(TypeError, match=rf'{name}\b.* must '):
            native.halpern.iterate(*arguments, *np.ones((2, 8, k), np.float32), 1.0, 0, 1)
