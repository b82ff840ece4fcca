# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Covariance, information and the root of it that whitens a residual.

Whitening is `r = L' e` with information = L L' (Cholesky, L lower triangular). Under L2 any
root gives the same cost; under L1 it does not. Cholesky is taken because the paper's costs come
out with it, and because the last rows of L' then involve the rotation alone, which is what lets
Algorithm 3 solve for the angles first.

A measurement may say nothing of some components: their rows and columns are zeros, in the
information, in its root, and in the covariance that stands for it here.
"""

import math
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core import native
from l1slam_ros.core.errors import NoiseError
from l1slam_ros.core.geometry.manifold import FEW, Array, Indices, Manifold

Mask = NDArray[np.bool_]

# Files print six digits or more; a matrix less symmetric than this was not meant as one.
_ASYMMETRY = 1e-4
# Beyond, squares and products of the entries overflow; no measurement is that good or that bad.
_SMALLEST, _LARGEST = 1e-30, 1e30
# Least eigenvalue of the correlation: below it is rounding, and the root would be noise.
_SINGULAR = 1e-14
# Correlations of one row that leave all eigenvalues far above that, whatever they are.
_BESIDE = 0.5
# Of the largest eigenvalue of an information matrix: less than that is none. Where a matrix says
# nothing of a direction, or less than nothing, it then knows it a thousand times worse than its
# best one, which other factors overrule, and maps can still be factored.
LEAST_EIGENVALUE = 1e-6
# [m^2], [rad^2] Between these a variance is one of a measurement. Measured on the Intel graph,
# whose own are 1e-2 or so: with thirty steps at 1e-10 the primal-dual map is .6% above the
# optimum, with 1e-14 or 1e8 the normal matrix is singular.
LEAST_VARIANCE, MOST_VARIANCE = 1e-8, 1e6
# Odometry is taken to know that much. Where sixty steps of Intel's have 100, the chain is torn and
# the judgement finds no loop likely any more; at 10 it takes all.
MOST_OF_ODOMETRY = 10.0


def square_root_information(information: Array) -> Array:
    """
    Return L', the upper triangular root that whitens: information = L L'.

    Parameters
    ----------
    information : (m, d, d) array, inverse covariances [1/m^2, 1/(m rad), 1/rad^2]

    Raises
    ------
    NoiseError : naming the first matrix that is not finite, symmetric and, but for rows and
        columns of zeros, positive definite; or that is all zeros.

    """
    information = np.asarray(information, float)
    silent = np.asarray((information == 0).all(axis=2))
    whole = filled(information, silent)
    variances = np.diagonal(whole, axis1=1, axis2=2)
    extreme = ((variances < _SMALLEST) | (variances > _LARGEST)).any(axis=1)
    for bad, expected in (
            (silent.all(axis=1), 'positive definite'), *_flaws(information, silent),
            (extreme, f'within {_SMALLEST:g} to {_LARGEST:g} on its diagonal')):
        if bad.any():
            index = int(np.argmax(bad))
            rows = '; '.join(' '.join(f'{v:g}' for v in row) for row in information[index])
            raise NoiseError(f'matrix {index} is not {expected}: [{rows}]')
    root = np.linalg.cholesky(whole).transpose(0, 2, 1)
    return silenced(root.astype(np.float64, copy=False), silent)


def nearest_definite(information: Array) -> tuple[Array, Array]:
    """
    Return information matrices (m, d, d), those made definite that are not, and how far they were.

    The nearest matrix, in the Frobenius norm, whose eigenvalues are `LEAST_EIGENVALUE` of its
    largest one or more (N. J. Higham, Computing a nearest symmetric positive semidefinite matrix,
    1988). Rows and columns of zeros stay zeros. How far, (m,): the least eigenvalue over the
    largest, NaN where the matrix stays as it is: it is definite, or has no such neighbour.

    information : (m, d, d) symmetric, in units in which a metre and a radian may be compared
    """
    silent = np.asarray((information == 0).all(axis=2))
    with np.errstate(invalid='ignore'):
        sound = np.asarray((np.abs(information) <= _LARGEST).all(axis=(1, 2)))
    rows = np.flatnonzero(sound)
    rows = rows[~_is_definite(filled(information[rows], silent[rows]))]
    values, vectors = np.linalg.eigh(information[rows])
    some = values[:, -1] > 0
    rows = rows[some]
    values = values[some]
    vectors = vectors[some]
    floor = LEAST_EIGENVALUE * values[:, -1:]
    definite = information.copy()
    least = np.full(len(information), np.nan)
    definite[rows] = silenced(
        (vectors * np.maximum(values, floor)[:, None, :]) @ vectors.transpose(0, 2, 1),
        silent[rows])
    least[rows] = values[:, 0] / values[:, -1]
    return definite, least


def filled(matrices: Array, silent: Mask) -> Array:
    """Return matrices (m, d, d) with the identity in rows and columns that are silent, (m, d)."""
    if not silent.any():
        return matrices
    return silenced(matrices, silent) + silent[:, :, None] * np.eye(silent.shape[1])


def silenced(matrices: Array, silent: Mask) -> Array:
    """Return matrices (m, d, d) with zeros in rows and columns that are silent, (m, d)."""
    if not silent.any():
        return matrices
    return np.where(silent[:, :, None] | silent[:, None, :], 0.0, matrices)


def silent_components(covariance: Array, absolute: bool) -> Mask:
    """
    Tell which components of measurements say nothing, by covariances of messages, (m, d).

    An infinite variance; of an absolute pose also one that is 0 or less, or above `MOST_VARIANCE`.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    if not absolute:
        return np.asarray(np.isposinf(variance))
    return np.logical_not((variance > 0) & (variance <= MOST_VARIANCE))


def usable(covariance: Array) -> Mask:
    """Tell which of (m, d, d) matrices are covariances, (m,): messages carry zeros and worse."""
    if len(covariance) <= FEW:
        return native.noise.usable(np.ascontiguousarray(covariance), _ASYMMETRY, _SINGULAR)
    none = np.zeros(covariance.shape[:2], bool)
    flawed = np.any([bad for bad, _ in _flaws(covariance, none)], axis=0)
    return np.asarray(np.logical_not(flawed))


def without_unset(covariance: Array) -> Array:
    """
    Return covariances (m, d, d) with a variance of 1 in rows and columns of zeros.

    For `usable`: a message may leave z, roll and pitch unset, and its x, y and yaw are as good.
    What is all zeros stays so.
    """
    if np.diagonal(covariance, axis1=1, axis2=2).all():
        return covariance
    unset = np.asarray((covariance == 0).all(axis=2))
    return filled(covariance, unset & ~unset.all(axis=1, keepdims=True))


def within_bounds(
    covariance: Array, model: Array, most: float, silent: float = np.inf
) -> tuple[Array, list[tuple[float, float]]]:
    """
    Return covariances (m, d, d) with variances of measurements, and those found and used instead.

    Below `LEAST_VARIANCE` it would nail whatever it stands at, above `silent` it says nothing: the
    model, (d, d), speaks for its component. Above `most` it becomes that, correlations are kept.
    """
    found = np.diagonal(covariance, axis1=1, axis2=2)
    if found.min(initial=np.inf) >= LEAST_VARIANCE and found.max(initial=0.0) <= min(most, silent):
        return covariance, []
    out = (found < LEAST_VARIANCE) | (found > silent)
    if out.any():
        modelled = (out * np.diagonal(model))[:, :, None] * np.eye(len(model))
        covariance = silenced(covariance, out) + modelled
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    large = variance > most
    if large.any():
        scale = np.where(large, np.sqrt(most) / np.sqrt(variance), 1.0)
        covariance = scale[:, :, None] * covariance * scale[:, None, :]
    used = np.diagonal(covariance, axis1=1, axis2=2)
    out = out | large
    return covariance, list(zip(found[out].tolist(), used[out].tolist(), strict=True))


def loop_identity(reference: int, stamp: int, measurement: Array, covariance: Array) -> bytes:
    """
    Return what equal measurements have in common: stamps, pose and, to six digits, covariance.

    Fewer digits than it has: a covariance that is worked out anew comes back to rounding. Sixteen
    bytes, of which no two differing measurements have the same.
    """
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)).ravel()
    sigma = np.where(sigma > 0, sigma, 1.0)
    correlation = covariance.reshape(len(sigma), -1) / np.outer(sigma, sigma)
    digits = np.rint(1e6 * np.concatenate((np.log(sigma), correlation.ravel()))).astype(np.int64)
    whole = b'%d %d ' % (reference, stamp) + measurement.tobytes() + digits.tobytes()
    return blake2b(whole, digest_size=16).digest()


def sigmas(manifold: Manifold, translation: float, rotation: float) -> Array:
    """Return the standard deviations of a step, (d,), of two for all axes [m], [rad]."""
    sigma = np.zeros(manifold.TANGENT_SIZE)
    sigma[manifold.TRANSLATION], sigma[manifold.ROTATION] = translation, rotation
    return sigma


def root_of_inverse(covariance: Array) -> Array:
    """Return the root L', see `square_root_information`, for sound covariances (m, d, d)."""
    if len(covariance) <= FEW:
        return native.noise.root_of_inverse(np.ascontiguousarray(covariance))
    silent = _without_variance(covariance)
    # Cholesky from the last row up gives U U' with U upper triangular, and L' = U^-1.
    lower = np.linalg.cholesky(filled(covariance, silent)[:, ::-1, ::-1])
    return silenced(np.linalg.inv(lower[:, ::-1, ::-1]), silent)


def covariance_of(sqrt_information: Array) -> Array:
    """Return the covariances (m, d, d) of the roots L'."""
    silent = _without_variance(sqrt_information)
    inverse = np.linalg.inv(filled(sqrt_information, silent))
    return silenced(inverse @ inverse.transpose(0, 2, 1), silent)


def _without_variance(matrices: Array) -> Mask:
    return np.asarray(np.diagonal(matrices, axis1=1, axis2=2) == 0)


def _flaws(matrices: Array, silent: Mask) -> list[tuple[Mask, str]]:
    """Return which of (m, d, d) matrices are not finite, which not symmetric, not definite."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    safe = matrices if finite.all() else np.where(finite[:, None, None], matrices, 0.0)
    with np.errstate(over='ignore'):
        skew = np.abs(safe - safe.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    scale = np.abs(safe).max(axis=(1, 2), initial=0.0)
    return [(np.logical_not(finite), 'finite'),
            (np.asarray(skew > _ASYMMETRY * scale), 'symmetric'),
            (np.logical_not(_is_definite(filled(safe, silent))), 'positive definite')]


def _is_definite(matrices: Array) -> Mask:
    """Tell which matrices are positive definite beyond rounding, whatever the units, (m,)."""
    variances = np.diagonal(matrices, axis1=1, axis2=2)
    positive = np.asarray((variances > 0).all(axis=1))
    root = np.sqrt(np.where(positive[:, None], variances, 1.0))
    with np.errstate(over='ignore'):  # an infinite correlation is refused like any above 1
        correlation = matrices / root[:, :, None] / root[:, None, :]
    # A correlation above 1 is not definite; clipped, so that nothing overflows, it still is not.
    correlation = np.clip(correlation, -2, 2)
    # Gershgorin's circles: most matrices have little beside their diagonal, hence no eigenvalue
    # near zero.
    size = np.abs(correlation)
    beside = size @ np.ones(size.shape[-1]) - np.diagonal(size, axis1=1, axis2=2)
    doubtful = ~(beside < _BESIDE).all(axis=1)
    definite = positive.copy()
    definite[doubtful] &= np.linalg.eigvalsh(correlation[doubtful])[:, 0] > _SINGULAR
    return definite


def distinct(matrices: Array) -> tuple[Indices, Indices]:
    """
    Return the row of one of each distinct matrix, and which of these each is, (m,).

    Measurements mostly share a few. Where more than a tenth of them differ, each is its own.
    """
    flat = matrices.reshape(len(matrices), math.prod(matrices.shape[1:]))
    # Equal matrices have the same sum of entries, each times a number of its own.
    with np.errstate(invalid='ignore', over='ignore'):
        sums = flat @ np.sqrt(np.arange(2.0, 2 + flat.shape[1]))
    _, rows, which = np.unique(sums, return_index=True, return_inverse=True)
    if 10 * len(rows) <= len(flat) and np.array_equal(flat[rows][which], flat):
        return rows, which
    return np.arange(len(flat)), np.arange(len(flat))


def whiten(sqrt_information: Array, vectors: Array) -> Array:
    """Return L' e for stacked roots (m, d, d) and vectors (m, d) or Jacobians (m, d, k)."""
    if vectors.ndim == 2:
        return (sqrt_information @ vectors[..., None])[..., 0]
    return sqrt_information @ vectors
