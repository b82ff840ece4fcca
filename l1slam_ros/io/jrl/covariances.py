# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Converting the covariances of a JRL file to square-root information, and back."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.geometry.noise import (
    LEAST_EIGENVALUE,
    covariance_of,
    nearest_definite,
    root_of_inverse,
    silenced,
)
from l1slam_ros.io.files import counted, rounded
from l1slam_ros.io.jrl.document import Node
from l1slam_ros.io.jrl.layout import SILENT, swapped

# Relative asymmetry that rounding may cause: files have six digits or more.
_ASYMMETRY = 1e-4
_LEAST = 1e-30


def roots_of(nodes: list[Node], manifold: Manifold) -> tuple[Array, list[str]]:
    """
    Return the roots of information (m, d, d) of covariances, and a sentence on the indefinite.

    Raises
    ------
    FileError : one is not symmetric, has a variance of 0 or less, or measures no component.

    """
    d = manifold.TANGENT_SIZE
    listed = np.array([node.numbers(d * d) for node in nodes]).reshape(-1, d, d)
    variance = np.diagonal(listed, axis1=1, axis2=2)
    turned = listed.transpose(0, 2, 1)
    skew = np.abs(listed - turned).max(axis=(1, 2))
    for bad, expected in (
            (skew > _ASYMMETRY * np.abs(listed).max(axis=(1, 2)), 'a symmetric matrix'),
            ((variance < _LEAST).any(axis=1), f'variances of {_LEAST:g} or more'),
            ((variance >= SILENT).all(axis=1), f'some variance below {SILENT:g}')):
        if bad.any():
            nodes[int(np.argmax(bad))].refuse(expected)
    covariance = swapped(silenced((listed + turned) / 2, variance >= SILENT), manifold)
    definite, least = nearest_definite(covariance)
    changed = np.isfinite(least)
    sentences = []
    if changed.any():
        matrices = counted(len(nodes), 'covariance')
        sentences = [f'{changed.sum():,} of {matrices} not positive definite: each is used as the '
                     f'nearest one that has no eigenvalue below {LEAST_EIGENVALUE:g} times its '
                     'largest']
    return root_of_inverse(definite), sentences


def lists_of(roots: Array, manifold: Manifold) -> list[list[float]]:
    """Return covariances row by row, in the order of the file, of roots (m, d, d)."""
    silent = np.diagonal(roots, axis1=1, axis2=2) == 0
    covariance = rounded(covariance_of(roots))
    covariance = covariance + (SILENT * silent)[:, :, None] * np.eye(silent.shape[1])
    return swapped(covariance, manifold).reshape(len(roots), -1).tolist()
