# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loop measurements, carried from the times that they name to the nearest keyframes."""

import numpy as np

from l1slam_ros.core.geometry import noise
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.online.loops.waiting_loops import WaitingLoop


def carried(manifold: Manifold, used: list[WaitingLoop], to_reference: Array,
            to_keyframe: Array, unseen: Array) -> tuple[Array, Array, Mask]:
    """
    Return the measurements of loops between the keyframes nearest to their times.

    Parameters
    ----------
    to_reference : (m, p) the robot at the reference, seen from the first keyframe; an absolute
        pose has none
    to_keyframe : (m, p) the second keyframe, seen from the robot at the end
    unseen : (2, m, 2) the sigmas [m], [rad] of where the robot was at the reference and at the end

    Returns
    -------
    measurement : (m, p); covariance : (m, d, d) in the axes of the keyframe. A loop that leaves
        components unsaid keeps its own axes, the way being short; one without a heading goes that
        way in a direction unknown, which is noise.
    sound : (m,) bool, the covariance is one: a heading nearly unknown, at the end of a long lever,
        leaves rounding where position was.

    """
    stated = np.concatenate([one.measurement for one in used])
    covariance = np.concatenate([one.covariance for one in used])
    absolute = np.array([one.loop.is_absolute for one in used])
    silent = np.diagonal(covariance, axis1=1, axis2=2) == 0
    if unseen.any():
        covariance = covariance + noise.silenced(
            _of_silences(manifold, stated, absolute, unseen), silent)
    unturned = silent[:, manifold.ROTATION].any(axis=1)
    measurement = np.where(absolute[:, None], stated, manifold.compose(to_reference, stated))
    measurement = np.where(unturned[:, None], measurement,
                           manifold.compose(measurement, to_keyframe))
    # The error lives in the axes of the measured pose; see it from the keyframe instead.
    Ad = manifold.adjoint(manifold.inverse(to_keyframe))
    turned = Ad @ covariance @ Ad.transpose(0, 2, 1)
    if not silent.any():
        return measurement, turned, noise.usable(turned)
    way = manifold.local(manifold.identity(len(used)), to_keyframe)
    lost = np.zeros(silent.shape)
    lost[:, manifold.TRANSLATION] = (way[:, manifold.TRANSLATION] ** 2).mean(axis=1)[:, None]
    kept = covariance + (lost * (unturned[:, None] & ~silent))[:, :, None] * np.eye(lost.shape[1])
    covariance = np.where(silent.any(axis=1)[:, None, None], kept, turned)
    return measurement, covariance, noise.usable(noise.filled(covariance, silent))


def _of_silences(manifold: Manifold, stated: Array, absolute: Mask, unseen: Array) -> Array:
    """Return the covariances, (m, d, d), of loops whose ends nobody saw; see `_carried`."""
    own = np.zeros((*unseen.shape[:2], manifold.TANGENT_SIZE))
    own[:, :, manifold.TRANSLATION] = unseen[:, :, :1] ** 2
    own[:, :, manifold.ROTATION] = unseen[:, :, 1:] ** 2
    own[0, absolute] = 0.0  # the map has no time
    first, second = own[..., None] * np.eye(manifold.TANGENT_SIZE)
    Ad = manifold.adjoint(manifold.inverse(stated))
    return Ad @ first @ Ad.transpose(0, 2, 1) + second
