# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a map says of a factor: against dense algebra, and against drawn numbers."""

import numpy as np
import pytest
from worlds import made

import l1slam_ros as l1
from l1slam_ros.core import native
from l1slam_ros.core.graph.linear_system import linearise
from l1slam_ros.core.robust.innovation import (
    TAIL,
    chi2_quantile,
    claimed_volume,
    covariances,
    innovations,
    log_likelihood_ratio,
    sample_posterior,
    spread_of,
    student_quantile,
)
from l1slam_ros.core.robust.places import err_together
from l1slam_ros.core.solvers.block_cholesky import cholesky_of


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return a graph with 101 true loops."""
    path = made(tmp_path_factory.mktemp('world') / 'a.g2o', 120, 220)
    return l1.read_graph(path)[0]


def solved_without(graph, rows):
    """Return the graph without some factors, these, and the L2 map of the rest."""
    out = np.isin(np.arange(len(graph.between)), rows)
    part = graph.subset(~out)
    return part, graph.subset(out), l1.solve(part, norm='l2', robust=False).poses


@pytest.fixture(scope='module')
def solved(whole):
    """Return a graph without its last loops, these loops, the L2 map and the posterior."""
    loops = np.flatnonzero(~whole.between.is_odometry)
    part, others, poses = solved_without(whole, loops[-20:])
    return part, others, poses, sample_posterior(part, poses, cholesky_of(part))


def dense_squares(part, others, poses):
    """Return r'C^-1 r of each of some factors, C = I + J H^-1 J'."""
    A, system = linearise(part, poses).A.toarray(), linearise(others, poses)
    J = system.A.toarray().reshape(len(others.between), 3, -1)
    covariance = np.eye(3) + J @ np.linalg.inv(A.T @ A) @ J.transpose(0, 2, 1)
    r = system.b.reshape(-1, 3)
    return np.einsum('mi,mij,mj->m', r, np.linalg.inv(covariance), r)


def test_sampled_squares_are_about_the_exact_ones(solved):
    part, others, poses, posterior = solved
    sampled = innovations(others, poses, posterior, 0.0).square
    ratio = sampled / dense_squares(part, others, poses)
    assert 0.8 < np.median(ratio) < 1.4  # C^-1 of so few samples is 1 / (1 - 4/24) too large
    assert ratio.min() > 0.4 and ratio.max() < 4


def test_a_factor_left_out_is_as_far_off_as_if_it_had_never_been_there(whole):
    poses = l1.solve(whole, norm='l2', robust=False).poses
    inside = sample_posterior(whole, poses, cholesky_of(whole)).left_out()
    row = np.flatnonzero(~whole.between.is_odometry)[-1]
    assert inside[row] == pytest.approx(dense_squares(*solved_without(whole, row))[0], rel=0.8)


def test_the_noise_that_there_is_shows_in_the_map_by_the_weights_that_are_stated(solved):
    part, _, poses, _ = solved
    variance = np.where(part.between.is_odometry, 9.0, 1.0)
    A = linearise(part, poses).A.toarray()
    gain = np.linalg.inv(A.T @ A) @ A.T * np.sqrt(np.repeat(variance, 3))
    exact = np.diag(gain @ gain.T)
    found = covariances(spread_of(part, poses, cholesky_of(part), variance))
    ratio = np.diagonal(found, axis1=1, axis2=2).ravel() / exact
    assert np.median(ratio) == pytest.approx(1, abs=0.1)
    assert ratio.min() > 0.4 and ratio.max() < 2.5


@pytest.mark.parametrize(('size', 'k'), [(3, 3), (6, 3), (6, 6)])
def test_true_factors_stay_below_the_quantile_of_samples(size, k):
    rng, samples = np.random.default_rng(0), TAIL * k
    drawn = rng.standard_normal((20000, samples, size))
    covariance = drawn.transpose(0, 2, 1) @ drawn / samples
    r = rng.standard_normal((20000, size))
    square = np.einsum('mi,mij,mj->m', r, np.linalg.inv(covariance), r)
    beyond = (square > student_quantile(0.99, size, k)).mean()
    assert 0.008 < beyond < 0.012
    assert student_quantile(0.99, size, k) > chi2_quantile(0.99, size)


def test_the_density_of_a_true_residual_has_volume_one():
    x = np.linspace(-60, 60, 241)
    square = (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2).ravel()
    none = np.zeros_like(square)
    density = np.exp(log_likelihood_ratio(square, none, none, 3, 3))
    assert density.sum() * (x[1] - x[0]) ** 3 == pytest.approx(1, rel=1e-3)


def test_a_corridor_does_not_narrow_what_false_factors_claim(whole):
    rng = np.random.default_rng(0)
    straight = np.zeros((500, 3))
    straight[:, 0] = np.arange(500)
    area = np.column_stack((rng.uniform(0, 500, (500, 2)) / np.sqrt(2), np.zeros(500)))
    along, about = (claimed_volume(whole.manifold, poses) for poses in (straight, area))
    assert along == pytest.approx(about, abs=0.3)


@pytest.mark.parametrize('k', [3, 6])
def test_pairs_are_normalised_as_their_whole_covariance_says(k, rng):
    m = 7
    samples, residual = rng.standard_normal((m * k, 48)), rng.standard_normal((m, k))
    shared = samples @ samples.T / 48
    first, second = np.triu_indices(m, 1)
    first, second = np.append(second, first), np.append(first, second)  # either way round
    blocks = shared.reshape(m, k, m, k)[np.arange(m), :, np.arange(m)] + np.eye(k)
    square, log_det = native.prediction.normalise_pairs(blocks, residual, shared, first, second)
    rows = np.arange(m * k).reshape(m, k)
    for a, b, found, log in zip(first, second, square, log_det, strict=True):
        own = np.append(rows[a], rows[b])
        C, r = shared[np.ix_(own, own)] + np.eye(2 * k), residual.ravel()[own]
        assert found == pytest.approx(r @ np.linalg.solve(C, r), rel=1e-12)
        assert log == pytest.approx(np.linalg.slogdet(C)[1], rel=1e-12)


def test_a_pair_that_is_not_definite_is_infinitely_far_off():
    shared = np.full((6, 6), 2.0)
    square, log_det = native.prediction.normalise_pairs(
        np.stack((np.eye(3), np.eye(3))), np.ones((2, 3)), shared, np.array([0]), np.array([1]))
    assert square == np.inf and log_det == -np.inf


@pytest.mark.parametrize(('shared', 'together'), [(0.0, False), (0.5, True), (1.0, True)])
def test_sums_over_places_tell_whether_loops_err_together(shared, together):
    rng = np.random.default_rng(0)
    place, found = np.repeat(np.arange(9), 20), 0
    for _ in range(50):
        own, common = (rng.standard_normal((size, 3)) for size in (180, 9))
        residual = np.sqrt(1 - shared) * own + np.sqrt(shared) * common[place]
        found += err_together(place, residual, rng.standard_normal((180, 3, 24)))
    assert found == 50 * together
