"""Covariances of measurements; see `l1slam_ros.core.geometry.noise`."""

import numpy as np
from numpy.typing import NDArray

from l1slam_ros.core.geometry.manifold import Array

def usable(covariance: Array, asymmetry: float, singular: float) -> NDArray[np.bool_]:
    """
    Return which matrices (m, d, d) are finite, symmetric and positive definite, (m,).

    asymmetry : allowed, over the largest entry; singular : the least eigenvalue of the correlation
    is above that
    """

def root_of_inverse(covariance: Array) -> Array:
    """
    Return the upper triangular L', L L' the inverse, of covariances, (m, d, d).

    Zeros stand in rows and columns of components without a variance.
    """
