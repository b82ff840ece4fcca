# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The native border of a factored map against the same least squares problem solved as a whole."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from systems import SHAPES, chain, cholesky_of_system, random_system

from l1slam_ros.core import native
from l1slam_ros.core.geometry import se2, se3

WORLD = -1
L1, L2 = 0, 1
USUAL, MU, OF_ODOMETRY, OF_LOOPS = 0.7, 0.2, 1.3, 0.6
OLD, NEW = 14, 6
# Columns of L^-1 are kept of all keyframes, of some, of none.
CASES = [pytest.param(shape, manifold, fixed, longest,
                      id=f'{shape.__name__} {manifold.NAME} {fixed} {longest}')
         for shape in SHAPES for manifold in (se2, se3) for fixed in (0, 1)
         for longest in (OLD, 4, 0) if manifold is se2 or shape is SHAPES[-1]]


class Whole:
    """One map: all keyframes and all factors in one dense system of normal equations."""

    def __init__(self, system, weights, poses, manifold, fixed):
        self.manifold, self.fixed, self.k = manifold, fixed, manifold.TANGENT_SIZE
        self.first = poses.copy()
        A = system.A.toarray()
        self.H, self.right = A.T @ (weights[:, None] * A), np.zeros(A.shape[1])

    def steps(self):
        """Return the steps of all keyframes, those held and the world, last, included."""
        found = np.linalg.solve(self.H, self.right).reshape(-1, self.k)
        return np.concatenate((np.zeros((self.fixed, self.k)), found, np.zeros((1, self.k))))

    def poses(self):
        return self.manifold.retract(self.ends(), self.steps())[:-1]

    def ends(self):
        return np.concatenate((self.first, self.manifold.identity(1)))

    def row(self, ends, blocks):
        """Return the blocks of a factor in the columns of the keyframes that are not held."""
        J = np.zeros((self.k, len(self.first) + 1, self.k))
        for end, block in zip(ends, blocks, strict=True):
            J[:, end] += block
        return J[:, self.fixed:-1].reshape(self.k, -1)

    def append_keyframe(self, ends, z):
        """Put the next keyframe where a factor says that sees it, which has no noise yet."""
        now, parent = np.concatenate((self.poses(), self.manifold.identity(1))), min(ends)
        to_new = z if ends[1] == len(self.first) else self.manifold.inverse(z)
        self.first = np.concatenate((self.first, self.manifold.compose(now[[parent]], to_new)))
        self.H = np.pad(self.H, (0, self.k))
        self.right = np.pad(self.right, (0, self.k))

    def linearised(self, ends, z, root, steps):
        """Return J of all keyframes, and e where they are now."""
        first = self.ends()
        now, ends = self.manifold.retract(first, steps), list(ends)
        J = self.manifold.residual_jacobians(z, *first[ends][:, None])[0]
        e = self.manifold.residual(z, *now[ends][:, None])[0]
        return self.row(ends, root @ J), root @ e

    def append(self, J, e, noise, steps):
        """Append a factor; `steps` are those at which e is the residual."""
        residual = e - J @ steps[self.fixed:-1].ravel()
        self.H += J.T @ (J / noise[:, None])
        self.right -= J.T @ (residual / noise)


def random_poses(manifold, n, rng):
    return manifold.retract(manifold.identity(n), rng.standard_normal((n, manifold.TANGENT_SIZE)))


def front_of(shape, manifold, fixed, rng, longest=OLD):
    """Return a front and the two maps that it has, of random factors."""
    k = manifold.TANGENT_SIZE
    sign = np.array([-1.0, 1.0]).reshape(2, 1, 1)
    choleskys, wholes = [], []
    for _ in (L1, L2):
        system = random_system(shape(OLD), OLD, k, rng)
        system.blocks[:] = sign * np.eye(k) + 0.1 / k * rng.standard_normal(system.blocks.shape)
        system.blocks[system.keyframe == OLD] = 0.0
        cholesky, weights = cholesky_of_system(system), rng.uniform(0.5, 2.0, len(system.b))
        assert cholesky.factorise(system, weights)
        choleskys.append(cholesky)
        wholes.append(Whole(system, weights, random_poses(manifold, fixed + OLD, rng), manifold,
                            fixed))
    for whole in wholes:
        whole.first.flags.writeable = False
    front = native.front.begin(*(whole.first for whole in wholes), fixed, USUAL, MU, OF_ODOMETRY,
                                OF_LOOPS, longest, *choleskys[L1].factor, *choleskys[L2].factor)
    return front, choleskys, wholes


def append_keyframe(front, wholes, ends, z, root):
    known = front.keyframes()
    assert front.append_keyframe(*ends, z[0], root)
    assert front.keyframes() == known + 1
    for whole, noise in zip(wholes, (USUAL, OF_ODOMETRY), strict=True):
        parent = min(ends)
        before = whole.steps()
        whole.append_keyframe(ends, z)
        # It has no step yet.
        steps = np.concatenate((before[:-1], np.zeros((2, whole.k))))
        assert parent == WORLD or np.array_equal(steps[parent], before[parent])
        J, e = whole.linearised(ends, z, root, steps)
        whole.append(J, e, np.full(whole.k, noise), steps)


def append_loop(front, wholes, ends, z, root, accepted):
    nis, log_likelihood, sigmas = front.predict(*ends, z[0], root)
    l1, l2 = wholes
    J, e = l2.linearised(ends, z, root, l2.steps())
    covariance = J @ np.linalg.solve(l2.H, J.T) + OF_LOOPS * np.eye(l2.k)
    whitened = np.linalg.solve(covariance, e)
    assert nis == pytest.approx(e @ whitened, rel=1e-7)
    assert log_likelihood == pytest.approx(
        np.log(root.diagonal()).sum() - nis / 2 - np.linalg.slogdet(covariance)[1] / 2, rel=1e-7)
    left = OF_LOOPS * whitened
    assert sigmas == pytest.approx(np.sqrt(left @ left / OF_LOOPS), rel=1e-7)
    if not accepted:
        front.refuse()
        return
    assert front.append()
    l2.append(J, e, np.full(l2.k, OF_LOOPS), l2.steps())
    steps = l1.steps()
    J, e = l1.linearised(ends, z, root, steps)
    l1.append(J, e, np.sqrt(USUAL * np.hypot(left, MU)), steps)


def compare(front, choleskys, wholes, some):
    for which, (cholesky, whole) in enumerate(zip(choleskys, wholes, strict=True)):
        poses, fixed = whole.poses(), whole.fixed
        assert_allclose(whole.manifold.local(poses[some], front.poses(which, np.array(some))),
                        0, atol=1e-8)
        pulled, pull, parent, turn, shift, began = front.moment(which)
        old = len(poses) - len(parent) - fixed
        steps = np.zeros((old + len(parent), whole.k))
        steps[pulled] = pull
        steps[:old] = cholesky.solve(steps[:old].ravel()).reshape(old, -1)
        native.front.hang(parent, turn, shift, steps)
        assert_allclose(steps, whole.steps()[fixed:-1], rtol=1e-6, atol=1e-8)
        assert_allclose(began, whole.first[fixed + old:], atol=1e-8)


def covariances_hold(front, whole, rng):
    inverse, k, n = np.linalg.inv(whole.H), whole.k, front.keyframes()
    for one in (whole.fixed, n // 2, n - 1):
        for other, turn in ((WORLD, np.zeros((k, k))), (int(rng.integers(whole.fixed, n)),
                                                        rng.normal(size=(k, k)))):
            if one != other:
                J = whole.row((one, other), (np.eye(k), -turn))
                assert_allclose(front.covariance(one, other, turn), J @ inverse @ J.T, rtol=1e-6,
                                atol=1e-9)


@pytest.mark.parametrize('shape, manifold, fixed, longest', CASES)
def test_a_border_is_the_whole_problem(shape, manifold, fixed, longest, rng):
    """Old, new and held keyframes in all mixtures, some loops refused, several robots' ends."""
    front, choleskys, wholes = front_of(shape, manifold, fixed, rng, longest)
    k, held = manifold.TANGENT_SIZE, OLD + fixed

    def factor():
        return (random_poses(manifold, 1, rng),
                np.triu(np.eye(k) + 0.2 / k * rng.standard_normal((k, k))))

    assert front.rows() == front.points() == 0
    for count in range(held, held + NEW):
        last = (count - 1, 3, WORLD if not fixed else 0, count - 2)[count % 4]
        append_keyframe(front, wholes, (last, count) if count % 2 else (count, last), *factor())
        i, j = (fixed + rng.choice(OLD, 2, replace=False)).tolist()
        pairs = [(i, count), (count, j), (i, j), (count - 1, count), (j, i)]
        pairs += [(0, count)] if fixed else [(WORLD, count)]
        rows = front.rows()
        for at, ends in enumerate(pairs[count % 3:]):
            append_loop(front, wholes, ends, *factor(), accepted=at != 1)
        assert front.rows() == rows + k * (len(pairs[count % 3:]) - 1)
        compare(front, choleskys, wholes, [i, held - 1, count, count - 1, 0])
    covariances_hold(front, wholes[L2], rng)
    # To ask has changed nothing.
    compare(front, choleskys, wholes, [held])


def test_a_factor_that_says_too_little_is_not_appended(rng):
    front, choleskys, wholes = front_of(chain, se2, 1, rng)
    z, root = random_poses(se2, 1, rng), np.diag([1.0, 0.0, 1.0])
    assert not front.append_keyframe(OLD, OLD + 1, z[0], root)
    assert front.keyframes() == OLD + 1
    assert front.predict(2, OLD, z[0], root)[1] == -np.inf
    front.refuse()
    compare(front, choleskys, wholes, [OLD])


def test_what_does_not_fit_is_refused_by_name(rng):
    front, choleskys, wholes = front_of(chain, se2, 1, rng)
    z, root = random_poses(se2, 1, rng)[0], np.eye(3)
    for call, said in (
        (lambda: front.predict(0, OLD + 1, z, root), 'keyframes there are'),
        (lambda: front.predict(0, -2, z, root), 'keyframes there are'),
        (lambda: front.append_keyframe(0, OLD, z, root), 'the next keyframe'),
        (lambda: front.predict(0, 1, z[:2].copy(), root), 'z of'),
        (lambda: front.predict(0, 1, z, np.eye(6)), 'root of'),
        (lambda: front.predict(0, 1, z, root[::2]), 'root must be a C-contiguous float64'),
        (lambda: front.append(), 'predict before append'),
        (lambda: front.poses(2, np.array([0])), 'map 0 or 1'),
        (lambda: front.poses(L1, np.array([99])), 'keyframes there are'),
        (lambda: front.covariance(0, 99, root), 'keyframes there are'),
        (lambda: native.front.Front.predict(None, 0, 1, z, root), 'Front'),
        (lambda: native.front.Front(), 'cannot create'),
        (lambda: native.front.begin(wholes[L1].first[1:], wholes[L2].first, 1, USUAL, MU, 1.0,
                                     1.0, OLD, *2 * choleskys[L1].factor), 'of one shape'),
    ):
        with pytest.raises(TypeError, match=said):
            call()
