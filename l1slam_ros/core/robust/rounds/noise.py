# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The noise that a robust solve assumes, of odometry and of loops.

In: what factors state, and what is measured of them. Out: the variances to weigh them by, in units
of what they state. Each step makes another record of the one before.
"""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.robust.innovation import within_ratio

# What is stated counts in the end up to so many times the variance that was found.
_WORD = 100.0


@dataclass(frozen=True)
class Noise:
    """
    How noisy odometry and loops were found to be.

    stated : (2,) the variance that they state; variance : (2,) theirs in units of that, the mean
    of their numbers; shape : (2, k) of each number, in units of the mean;
    learnt_of : (m,) bool, the factors of which it was learnt last, (0,) of none; at_their_word :
    whether factors may be as noisy as they say.
    """

    stated: Array
    variance: Array
    shape: Array
    learnt_of: Mask
    at_their_word: bool = False

    @staticmethod
    def of(stated: Array, k: int) -> 'Noise':
        """Return the noise that is stated, of k numbers, of which nothing is learnt."""
        return Noise(stated, within_ratio(np.ones(2), stated), np.ones((2, k)), np.zeros(0, bool))

    @property
    def assumed(self) -> Array:
        """(2, k) what factors are weighed by."""
        return self.word if self.at_their_word else self.each

    @property
    def each(self) -> Array:
        """(2, k) the variance of each number."""
        return self.variance[:, None] * self.shape

    @property
    def word(self) -> Array:
        """(2, k) where factors are as noisy as they say, or as was found."""
        word = np.maximum(self.each, np.minimum(_WORD * self.each, 1.0))
        mean = word.mean(axis=1)
        return word * (within_ratio(mean, self.stated) / mean)[:, None]

    @property
    def said(self) -> Array:
        """(2,) how much larger the variance is that factors may have, than was found."""
        return (self.word / self.each).mean(axis=1)

    def is_known(self, accepted: Mask) -> bool:
        """Return whether there is nothing new to learn it of: what it was, says always more."""
        return self.at_their_word or np.array_equal(accepted, self.learnt_of)

    def found(self, variance: Array) -> 'Noise':
        """Return the noise where its variance, (2,), was found anew."""
        return replace(self, variance=within_ratio(variance, self.stated))

    def learnt(self, scale: Array, accepted: Mask) -> 'Noise':
        """Return the noise so many times as large, (2, k), learnt of what is accepted, (m,)."""
        each = self.each * scale
        mean = each.mean(axis=1)
        return replace(self.found(mean), shape=each / mean[:, None], learnt_of=accepted.copy())

    def forgotten(self) -> 'Noise':
        """Return the noise as if it were learnt of nothing."""
        return replace(self, learnt_of=self.learnt_of[:0])
