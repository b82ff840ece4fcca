# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The noise of odometry and of loops that a robust solve assumes.

In: stated variances and estimates. Out: the variances to weight factors by, in units of the
stated. Each update returns a new record.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.robust.innovation import within_ratio

# In the end, stated variance counts up to this multiple of the estimate.
_WORD = 100.0


@dataclass(frozen=True)
class Noise:
    """
    Estimated noise of odometry and of loops.

    Attributes
    ----------
    stated : (2,) stated variance
    variance : (2,) estimate in units of it, mean over components
    shape : (2, k) variance of each component relative to the mean
    learnt_of : (m,) bool, factors of the last estimate, (0,) before
    at_their_word : use max(estimated, stated) covariance

    """

    stated: Array
    variance: Array
    shape: Array
    learnt_of: Mask
    at_their_word: bool = False

    @staticmethod
    def of(stated: Array, k: int) -> 'Noise':
        """Return the stated noise, of k components."""
        return Noise(stated, within_ratio(np.ones(2), stated), np.ones((2, k)), np.zeros(0, bool))

    @property
    def assumed(self) -> Array:
        """(2, k) variances that weight factors."""
        return self.word if self.at_their_word else self.each

    @property
    def each(self) -> Array:
        """(2, k) estimated variances."""
        return self.variance[:, None] * self.shape

    @property
    def word(self) -> Array:
        """(2, k) max(estimated, stated) variance, bounded by `_WORD` and `within_ratio`."""
        word = np.maximum(self.each, np.minimum(_WORD * self.each, 1.0))
        mean = word.mean(axis=1)
        return word * (within_ratio(mean, self.stated) / mean)[:, None]

    @property
    def said(self) -> Array:
        """(2,) mean ratio of `word` to the estimate."""
        return (self.word / self.each).mean(axis=1)

    def is_known(self, accepted: Mask) -> bool:
        """Return whether not to estimate it: the same factors would count twice."""
        return self.at_their_word or np.array_equal(accepted, self.learnt_of)

    def found(self, variance: Array) -> 'Noise':
        """Return the noise with a new variance, (2,)."""
        return replace(self, variance=within_ratio(variance, self.stated))

    def learnt(self, scale: Array, accepted: Mask) -> 'Noise':
        """Return the noise scaled by (2, k), estimated from accepted factors, (m,)."""
        each = self.each * scale
        mean = each.mean(axis=1)
        return replace(self.found(mean), shape=each / mean[:, None], learnt_of=accepted.copy())

    def forgotten(self) -> 'Noise':
        """Return the noise as if estimated from no factors."""
        return replace(self, learnt_of=self.learnt_of[:0])
