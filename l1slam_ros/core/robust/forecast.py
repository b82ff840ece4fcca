# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How often maps that looked like this one were right: a forecast with a record.

In: what is known at the end of a judgement. Out: a share of 1. It is a logistic regression of
three terms on what became of made and of recorded graphs with lies: `benchmarks/robust/verdict.py`
makes the graphs, fits the weights on half of them and counts on the other half what was right.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask

# Of a map with no loop left out; then for the share of loops that is left out, each power of ten
# by which the variance of loops is larger than stated, and the share that is suspect.
_WEIGHTS = np.array([-5.16, 3.75, 0.90, 1.67])
# From here on it is no reason to doubt a map that most of its loops are left out.
CONFIDENT = 0.9


def forecast(accepted: Mask, suspect: Mask, variance: float) -> float:
    """
    Return how often such maps were right; NaN without loops, of which nothing is recorded.

    Parameters
    ----------
    accepted, suspect : (k,) of each loop, as a judgement has them
    variance : of loops as it was found, in units of what they state

    """
    if not len(accepted):
        return float('nan')
    return float(1 / (1 + np.exp(_WEIGHTS @ terms_of(accepted, suspect, variance))))


def terms_of(accepted: Mask, suspect: Mask, variance: float) -> Array:
    """Return what the weights are of, (4,); see `forecast`."""
    return np.array([1.0, np.mean(~accepted), np.log10(max(variance, 1.0)),
                     np.log1p(10 * np.mean(suspect))])
