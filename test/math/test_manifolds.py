# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Laws every manifold obeys, by parametrisation; then what is SE(2)'s and SE(3)'s own."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from l1slam_ros.core.geometry import se2, se3

MANIFOLDS = [se2, se3]
N = 20
H = 1e-6  # of a central difference


def identical(manifold, rng):
    return manifold.identity(N)


def near_identity(manifold, rng):
    step = rng.standard_normal((N, manifold.TANGENT_SIZE))
    return manifold.retract(manifold.identity(N), 1e-8 * step)


def anywhere(manifold, rng):
    rotation = Rotation.from_quat(rng.standard_normal((N, 4)))
    return from_rotations(manifold, rng, rotation)


def turned_about(manifold, rng):
    """Turns at and next to the seam between pi and -pi, about one axis: the plane's, if it may."""
    beyond_pi = np.resize([0.0, 1e-15, -1e-15, 1e-9, -1e-9, 1e-3, -1e-3], N)
    axis = [0, 0, 1] if manifold is se2 else np.array([2, -6, 3]) / 7
    return from_rotations(manifold, rng, Rotation.from_rotvec(np.outer(np.pi + beyond_pi, axis)))


def from_rotations(manifold, rng, rotation):
    return manifold.from_pose3(
        np.concatenate((3 * rng.standard_normal((N, 3)), rotation.as_quat()), axis=1))


@pytest.fixture(params=MANIFOLDS, ids=lambda manifold: manifold.NAME)
def manifold(request):
    return request.param


@pytest.fixture(params=[identical, near_identity, anywhere, turned_about],
                ids=lambda kind: kind.__name__)
def triple(request, manifold, rng):
    """Three stacks of poses of one kind."""
    return [request.param(manifold, rng) for _ in range(3)]


def assert_same(manifold, a, b, atol=1e-12):
    """Compare poses as poses: pi and -pi, or q and -q, are the same heading."""
    assert a.shape == b.shape == (N, manifold.POSE_SIZE)
    assert_allclose(manifold.local(a, b), 0, atol=atol)


def differences(manifold, function, pose):
    """Return the derivative of `function` by a right step of `pose`, (n, d, d)."""
    columns = []
    for axis in np.eye(manifold.TANGENT_SIZE):
        step = np.broadcast_to(H * axis, (len(pose), manifold.TANGENT_SIZE))
        change = function(manifold.retract(pose, step)) - function(manifold.retract(pose, -step))
        columns.append(change / (2 * H))
    return np.stack(columns, axis=2)


def test_compose_and_inverse_are_of_a_group(manifold, triple):
    a, b, c = triple
    e, inverse = manifold.identity(N), manifold.inverse(a)
    assert_same(manifold, manifold.compose(a, inverse), e)
    assert_same(manifold, manifold.compose(inverse, a), e)
    assert_same(manifold, manifold.between(a, b), manifold.compose(inverse, b))
    assert_same(manifold, manifold.compose(manifold.compose(a, b), c),
                manifold.compose(a, manifold.compose(b, c)))


def test_steps_apply_on_the_right_and_local_undoes_them(manifold, triple, rng):
    a, b, _ = triple
    step = 0.3 * rng.uniform(-1, 1, (N, manifold.TANGENT_SIZE))
    assert_same(manifold, manifold.retract(a, manifold.local(a, b)), b)
    assert_allclose(manifold.local(a, manifold.retract(a, step)), step, atol=1e-12)
    assert_same(manifold, manifold.retract(manifold.compose(a, b), step),
                manifold.compose(a, manifold.retract(b, step)))


def test_adjoint_carries_a_step_from_right_to_left(manifold, triple):
    a, inverse = triple[0], manifold.inverse(triple[0])

    def conjugated(v):
        """Return the step s for which a v = v2t(s) a."""
        return manifold.local(manifold.identity(N),
                              manifold.compose(manifold.compose(a, v), inverse))

    numeric = differences(manifold, conjugated, manifold.identity(N))
    assert_allclose(manifold.adjoint(a), numeric, atol=1e-8)


def test_residual_reads_the_coordinates_off_the_error(manifold, triple):
    z, a, b = triple
    t, turn = np.split(manifold.local(z, manifold.between(a, b)), [manifold.TRANSLATION.stop], 1)
    if manifold is se3:
        turn = turn * np.sinc(np.linalg.norm(turn, axis=1, keepdims=True) / 2 / np.pi)
    assert_allclose(manifold.residual(z, a, b), np.hstack((t, turn)), atol=1e-12)
    assert_allclose(manifold.residual(manifold.between(a, b), a, b), 0, atol=1e-12)


@pytest.mark.parametrize('error', [0.0, 0.5])
def test_residual_jacobians_equal_differences(manifold, triple, error, rng):
    _, a, b = triple
    step = error * rng.uniform(-1, 1, (N, manifold.TANGENT_SIZE))
    z = manifold.retract(manifold.between(a, b), step)
    J_r_i, J_r_j = manifold.residual_jacobians(z, a, b).swapaxes(0, 1)
    assert_allclose(J_r_i, differences(manifold, lambda x: manifold.residual(z, x, b), a),
                    atol=1e-8)
    assert_allclose(J_r_j, differences(manifold, lambda x: manifold.residual(z, a, x), b),
                    atol=1e-8)


def gradients(manifold, z, a, b, dual):
    """Return J_r_i' dual and J_r_j' dual, (n, 2, d)."""
    return np.einsum('nerc,nr->nec', manifold.residual_jacobians(z, a, b), dual)


@pytest.mark.parametrize('error', [0.0, 0.5])
def test_residual_curvature_equals_differences_of_the_gradient(manifold, triple, error, rng):
    """Of J' dual at poses stepped to, turned back into the steps from where they came."""
    _, a, b = triple
    d, dual = manifold.TANGENT_SIZE, rng.standard_normal((N, manifold.TANGENT_SIZE))
    step = error * rng.uniform(-1, 1, (N, d))
    z = manifold.retract(manifold.between(a, b), step)

    def gradient(step):
        steps = [np.broadcast_to(part, (N, d)) for part in np.split(step, 2)]
        there = [manifold.retract(*pair) for pair in zip((a, b), steps, strict=True)]
        product = gradients(manifold, z, *there, dual)
        origin = manifold.identity(N)
        for side, part in enumerate(steps):
            further = manifold.local_jacobian(origin, manifold.retract(origin, part))
            back = np.linalg.inv(further).transpose(0, 2, 1)
            product[:, side] = (back @ product[:, side, :, None])[..., 0]
        return product.reshape(N, 2 * d)

    expected = np.stack([(gradient(H * axis) - gradient(-H * axis)) / (2 * H)
                         for axis in np.eye(2 * d)], axis=2)
    curvature = manifold.residual_curvature(z, a, b, dual)
    turns = np.arange(2 * d).reshape(2, d)[:, manifold.ROTATION]
    assert_allclose(curvature, expected[:, turns], atol=1e-7)
    among = curvature[..., turns.ravel()].reshape(N, turns.size, turns.size)
    assert_array_equal(among, among.transpose(0, 2, 1))
    straight = np.delete(np.arange(2 * d), turns.ravel())
    assert_allclose(expected[:, straight[:, None], straight], 0, atol=1e-7)


@pytest.mark.parametrize('error', [0.0, 0.5])
def test_local_jacobian_equals_differences(manifold, triple, error, rng):
    b = triple[0]
    a = manifold.retract(b, error * rng.uniform(-1, 1, (N, manifold.TANGENT_SIZE)))
    assert_allclose(manifold.local_jacobian(a, b),
                    differences(manifold, lambda x: manifold.local(a, x), b), atol=1e-8)


def test_interpolation_goes_from_end_to_end_by_equal_parts(manifold, triple):
    a, b, _ = triple
    parts = [manifold.interpolate(a, b, np.full(N, t)) for t in (0.0, 0.25, 1.0)]
    assert_same(manifold, parts[0], a)
    assert_same(manifold, parts[2], b)
    assert_allclose(manifold.local(a, parts[1]), manifold.local(a, b) / 4, atol=1e-12)
    fraction = np.linspace(0, 1, N)
    each = manifold.local(a, manifold.interpolate(a, b, fraction))
    assert_allclose(each, fraction[:, None] * manifold.local(a, b), atol=1e-12)


def test_motion_measures_length_and_angle(manifold):
    step = np.zeros((2, manifold.TANGENT_SIZE))
    step[0, manifold.TRANSLATION][:2] = 3.0, -4.0
    turned = manifold.from_pose3(np.array([[0, 0, 0, 0, 0, -np.sin(0.2), np.cos(0.2)]]))
    step[1:] = manifold.local(manifold.identity(1), turned)
    length, angle = manifold.motion(step)
    assert_allclose(length, [5, 0])
    assert_allclose(angle, [0, 0.4])


@pytest.mark.parametrize('factor', [1.0, -1.0, 0.95, -1.07])
def test_pose3_there_and_back_by_a_quaternion_of_any_length(manifold, triple, factor):
    a = triple[0]
    pose3 = manifold.to_pose3(a)
    R, position = manifold.rotation(a), manifold.positions(a)
    k = position.shape[1]
    assert_allclose(np.linalg.norm(pose3[:, 3:], axis=1), 1)
    assert_allclose(position, pose3[:, :k])
    assert_allclose(R, Rotation.from_quat(pose3[:, 3:]).as_matrix()[:, :k, :k], atol=1e-12)
    assert_same(manifold, manifold.from_pose3(pose3 * ([1.0] * 3 + [factor] * 4)), a)
    assert_same(manifold, manifold.from_rotation(R, position), a)


def test_pose3_composes_as_rigid_motions_of_space_do(manifold, triple):
    """SciPy's rotations in the place of our own formulas."""
    a, b, _ = triple
    first, second, product = map(manifold.to_pose3, (a, b, manifold.compose(a, b)))
    R_a, R_b, R_ab = (Rotation.from_quat(pose3[:, 3:]) for pose3 in (first, second, product))
    assert_allclose(R_ab.as_matrix(), (R_a * R_b).as_matrix(), atol=1e-12)
    assert_allclose(product[:, :3], first[:, :3] + R_a.apply(second[:, :3]), atol=1e-12)


# SE(2) alone


def test_wrap_moves_by_whole_turns_into_the_interval_and_nothing_within(rng):
    inside = np.concatenate((rng.uniform(-np.pi, np.pi, 100),
                             [np.pi, np.nextafter(-np.pi, 0), 0.0, 5e-324]))
    assert_array_equal(se2.wrap(inside), inside)
    angle = np.array([-np.pi, np.nextafter(np.pi, 4.0), 3 * np.pi, 4.0, -4.0, 100.0, -1e4])
    wrapped = se2.wrap(angle)
    assert (wrapped > -np.pi).all() and (wrapped <= np.pi).all()
    assert wrapped[0] == np.pi
    turns = (angle - wrapped) / (2 * np.pi)
    assert_allclose(turns, np.round(turns), atol=1e-10)


@pytest.mark.parametrize('largest', [1e-9, 1.0, 10.0, 1e4, 1e8])
def test_turns_are_as_exact_as_the_angle(largest, rng):
    """Also where one polynomial of a sine may take over from another, and beside that."""
    eighths = np.arange(-40, 41) * np.pi / 4
    angle = np.concatenate((rng.uniform(-largest, largest, 10_001), eighths,
                            np.nextafter(eighths, 99), np.nextafter(eighths, -99)))
    start = np.zeros((len(angle), 3))
    J_r_j = se2.residual_jacobians(start, start, start + angle[:, None] * [0, 0, 1])[:, 1]
    bound = 2 * np.finfo(float).eps + np.spacing(np.abs(angle))
    assert (np.abs(J_r_j[:, 0, 0] - np.cos(angle)) <= bound).all()
    assert (np.abs(J_r_j[:, 1, 0] - np.sin(angle)) <= bound).all()


def test_yaw_is_read_off_tilted_poses(rng):
    yaw, pitch, roll = rng.uniform(-1, 1, (3, 50)) * [[np.pi], [1.2], [1.2]]
    tilted = Rotation.from_euler('ZYX', np.stack((yaw, pitch, roll), axis=1))
    position = rng.standard_normal((50, 3))
    pose3 = np.concatenate((position, 0.97 * tilted.as_quat()), axis=1)
    expected = np.column_stack((position[:, :2], yaw))
    assert_allclose(se2.from_pose3(pose3), expected, atol=1e-12)


@pytest.mark.parametrize('verb', ['compose', 'between', 'local', 'retract'])
def test_headings_come_out_within_half_a_turn(verb, rng):
    a, b = rng.uniform(-10, 10, (2, 500, 3))
    theta = getattr(se2, verb)(a, b)[:, 2]
    assert (theta > -np.pi).all() and (theta <= np.pi).all()


# SE(3) alone


def test_what_is_normalised_stays_as_it_is_to_the_last_bit(rng):
    pose3 = np.concatenate((rng.standard_normal((500, 3)), rng.standard_normal((500, 4))), axis=1)
    once = se3.from_pose3(pose3)
    assert (once[:, 6] >= 0).all()
    assert_array_equal(se3.from_pose3(once), once)
