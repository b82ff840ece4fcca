# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The native verbs of single poses and covariances, against those of NumPy for many."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from l1slam_ros.core import native
from l1slam_ros.core.geometry import noise, se2, se3

MANY = 60  # rows, for which the manifolds and `noise` use NumPy


def steps(manifold, rng, scale=2.0):
    step = scale * rng.standard_normal((MANY, manifold.TANGENT_SIZE))
    step[0] = 0.0
    step[1] *= 1e-9
    step[2, manifold.ROTATION] = np.pi if manifold is se2 else [np.pi, 0.0, 0.0]
    return step


def poses(manifold, rng):
    return manifold.retract(manifold.identity(MANY), steps(manifold, rng))


def assert_alike(manifold, found, expected):
    """Of a half turn either sign is right."""
    turned = manifold.rotation(found), manifold.rotation(expected)
    assert_allclose(manifold.positions(found), manifold.positions(expected), atol=1e-13)
    assert_allclose(*turned, atol=1e-13)


@pytest.mark.parametrize('manifold', [se2, se3], ids=['plane', 'space'])
def test_verbs(manifold, rng):
    a, b, step = poses(manifold, rng), poses(manifold, rng), steps(manifold, rng, 0.5)
    for verb in 'compose', 'between':
        few, many = getattr(native.poses, verb), getattr(manifold, verb)
        assert_alike(manifold, few(a, b), many(a, b))
        assert_alike(manifold, few(a[:1], b), many(a[:1], b))
        assert_alike(manifold, few(a, b[3:4]), many(a, b[3:4]))
        # Rows wherever they lie, as of arrays that Python has cut or repeated.
        strided = np.broadcast_to(a[5], a.shape), np.asfortranarray(b)[::-1]
        assert_alike(manifold, few(*strided), many(*strided))
    assert_alike(manifold, native.poses.inverse(a), manifold.inverse(a))
    assert_alike(manifold, native.poses.retract(a, step), manifold.retract(a, step))
    near = manifold.retract(a, step)
    assert_allclose(native.poses.local(a, near), manifold.local(a, near), atol=1e-12)
    assert_allclose(native.poses.motion(step), manifold.motion(step), rtol=1e-14)
    for n in 0, 1, 8:  # as few as go through the native verbs
        assert_alike(manifold, manifold.compose(a[:n], b[:n]), native.poses.compose(a, b)[:n])


def test_onto_the_plane(rng):
    pose3 = poses(se3, rng)
    assert_allclose(native.poses.onto_plane(pose3), se2.from_pose3(pose3), atol=1e-14)


@pytest.mark.parametrize('manifold', [se2, se3], ids=['plane', 'space'])
def test_poses_at_times(manifold, rng):
    samples = poses(manifold, rng)
    times = np.sort(rng.choice(1000, MANY, replace=False))
    asked = np.sort(rng.integers(times[0], times[-1], MANY))
    after = np.clip(np.searchsorted(times, asked), 1, None)
    fraction = (asked - times[after - 1]) / (times[after] - times[after - 1])
    expected = manifold.interpolate(samples[after - 1], samples[after], fraction)
    whole = np.array([0]), np.array([MANY])
    assert_alike(manifold, native.poses.interpolate(times, samples, *whole, asked), expected)
    # Of the part of a single sample it is that one.
    alone = native.poses.interpolate(times, samples, np.array([4]), np.array([5]), asked)
    assert_alike(manifold, alone, np.broadcast_to(samples[4], samples.shape))


def test_places(rng):
    times, asked = np.sort(rng.integers(0, 50, 40)), np.arange(-2, 55)
    for to, side in (False, 'left'), (True, 'right'):
        assert_array_equal(native.poses.places(times, asked, to),
                           np.searchsorted(times, asked, side))


@pytest.mark.parametrize('d', [2, 3, 6])
def test_covariances(d, rng):
    A = rng.standard_normal((MANY, d, d)) * 10 ** rng.uniform(-3, 3, (MANY, d, 1))
    sound = A @ A.transpose(0, 2, 1)
    sound = (sound + sound.transpose(0, 2, 1)) / 2
    flawed = sound[:8].copy()
    flawed[0, 0, 0] = np.nan
    flawed[1, 0, 1] = np.inf
    flawed[2, 0, 1] += 1e-3 * np.abs(flawed[2]).max()
    flawed[3, 1, 1] = 0.0
    flawed[4] *= -1
    flawed[5, 0] = flawed[5, 1]
    flawed[5, :, 0] = flawed[5, :, 1]
    flawed[6] = 0.0
    flawed[7, 0, 1] = flawed[7, 1, 0] = 2 * np.sqrt(flawed[7, 0, 0] * flawed[7, 1, 1])
    both = np.concatenate((sound, flawed))
    # One by one they are looked at natively, all together by NumPy.
    assert_array_equal([noise.usable(one[None])[0] for one in both], noise.usable(both))
    assert_array_equal(noise.usable(both), np.arange(len(both)) < MANY)
    expected = noise.root_of_inverse(sound)
    for one, root in zip(sound, expected, strict=True):
        assert_allclose(noise.root_of_inverse(one[None])[0], root, rtol=1e-6,
                        atol=1e-9 * np.abs(root).max())
    silent = sound[0].copy()
    silent[0] = silent[:, 0] = 0.0
    root = native.noise.root_of_inverse(silent[None])[0]
    assert not root[0].any() and not root[:, 0].any()
    assert_allclose(root[1:, 1:].T @ root[1:, 1:] @ silent[1:, 1:], np.eye(d - 1), atol=1e-6)


def test_what_does_not_fit_is_refused_by_name():
    a, b = np.zeros((2, 3)), np.zeros((3, 3))
    for call, said in (
        (lambda: native.poses.compose(a, b), 'as many rows'),
        (lambda: native.poses.compose(a, np.zeros((2, 7))), 'b of'),
        (lambda: native.poses.compose(np.zeros((2, 4)), b), 'poses'),
        (lambda: native.poses.compose(a.astype('f4'), a), 'a must be a float64 array'),
        (lambda: native.poses.motion(np.zeros((1, 4))), 'steps'),
        (lambda: native.poses.onto_plane(a), 'poses'),
        (lambda: native.poses.interpolate(np.arange(2), a, np.array([0]), np.array([3]),
                                          np.arange(2)), 'parts of times'),
        (lambda: native.noise.usable(np.zeros((1, 2, 3)), 0.0, 0.0), 'covariance of'),
        (lambda: native.noise.root_of_inverse(-np.eye(3)[None]), 'positive definite'),
    ):
        with pytest.raises(TypeError, match=said):
            call()
