# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Quantiles against those of SciPy."""

import pytest
from scipy.special import betaincinv, gammainc, gammaincinv

from l1slam_ros.core.geometry.quantiles import beta_quantile, gamma_probability, gamma_quantile

PROBABILITIES = [1e-6, 0.01, 0.5, 0.95, 0.999, 1 - 1e-6, 1 - 1e-9]


@pytest.mark.parametrize('probability', PROBABILITIES)
@pytest.mark.parametrize('a', [0.5, 1.0, 1.5, 3.0, 6.0, 40.0, 745.0, 7301.2, 1e5])
def test_of_the_gamma_distribution(a, probability):
    # Near 1 the last digit of the probability itself moves the quantile; that of a large one is a
    # difference of numbers as large as a log a.
    digits, near_1 = (1e-9, 1e-13) if a > 100 else (1e-12, 1e-15)
    within = max(digits, near_1 / (1 - probability))
    assert gamma_quantile(a, probability) == pytest.approx(gammaincinv(a, probability), rel=within)
    for x in a / 3, 3 * a:
        assert gamma_probability(a, x) == pytest.approx(gammainc(a, x), rel=1e-9, abs=1e-300)


@pytest.mark.parametrize('probability', PROBABILITIES)
@pytest.mark.parametrize('a, b', [(0.5, 12.0), (1.5, 11.0), (3.0, 9.5), (6.0, 6.5)])
def test_of_the_beta_distribution(a, b, probability):
    within = max(1e-12, 1e-15 / (1 - probability))
    assert beta_quantile(a, b, probability) == pytest.approx(betaincinv(a, b, probability),
                                                            rel=within)
