# SPDX-License-Identifier: Apache-2.0
"""
Covariance, information and the root of it that whitens a residual.

Whitening is `r = L' e` with information = L L' (Cholesky, L lower triangular). Under L2 any
root gives the same cost; under L1 it does not. Cholesky is taken because the paper's costs come
out with it, and because the last rows of L' then involve the rotation alone, which is what lets
Algorithm 3 solve for the angles first.
"""

import numpy as np

from l1slam_ros.core.errors import NoiseError
from l1slam_ros.core.manifold import Array

# Files print six digits or more; a matrix less symmetric than this was not meant as one.
_ASYMMETRY = 1e-4


def square_root_information(information: Array) -> Array:
    """
    Return L', the upper triangular root that whitens: information = L L'.

    Parameters
    ----------
    information : (m, d, d) array, inverse covariances [1/m^2, 1/(m rad), 1/rad^2]

    Raises
    ------
    NoiseError : naming the first matrix that is not finite, symmetric and positive definite.

    """
    information = np.asarray(information, float)
    finite = np.isfinite(information).all(axis=(1, 2))
    _refuse(np.logical_not(finite), information, 'finite')
    scale = np.abs(information).max(axis=(1, 2), initial=0.0)
    skew = np.abs(information - information.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    _refuse(skew > _ASYMMETRY * scale, information, 'symmetric')
    # A pivot lost to rounding counts as not positive: its square root would be noise.
    smallest = np.linalg.eigvalsh(information)[:, 0]
    _refuse(smallest <= 1e-15 * scale, information, 'positive definite')
    root = np.linalg.cholesky(information).transpose(0, 2, 1)
    return root.astype(np.float64, copy=False)


def information_from_covariance(covariance: Array) -> Array:
    """
    Return the inverse of each (m, d, d) covariance.

    Raises
    ------
    NoiseError : naming the first one that is not finite, symmetric and positive definite.

    """
    root = square_root_information(covariance)  # the same demands hold for a covariance
    inverse = np.linalg.inv(root)
    product: Array = inverse @ inverse.transpose(0, 2, 1)
    return product


def is_usable_covariance(covariance: Array) -> bool:
    """Tell whether one (d, d) matrix can be inverted: messages carry zeros, -1 and worse."""
    try:
        square_root_information(covariance[None])
    except NoiseError:
        return False
    return True


def whiten(sqrt_information: Array, vectors: Array) -> Array:
    """Return L' e for stacked roots (m, d, d) and vectors (m, d) or Jacobians (m, d, k)."""
    if vectors.ndim == 2:
        product: Array = (sqrt_information @ vectors[..., None])[..., 0]
    else:
        product = sqrt_information @ vectors
    return product


def _refuse(bad: np.ndarray, matrices: Array, expected: str) -> None:
    if bad.any():
        index = int(np.argmax(bad))
        rows = '; '.join(' '.join(f'{v:g}' for v in row) for row in matrices[index])
        raise NoiseError(f'matrix {index} is not {expected}: [{rows}]')
