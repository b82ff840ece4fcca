# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Probabilities and quantiles of the gamma and the beta distribution.

SciPy has them, too; importing it takes longer than to judge a few hundred loops. Both
distribution functions are their power series (Abramowitz and Stegun 6.5.29 and 26.5.4), turned
round by Newton's method, which halves the interval where it would leave it.
"""

from collections.abc import Callable
from math import exp, lgamma, log, log1p

# A term that small no more changes a sum.
_NOTHING = 1e-17
_STEPS = 200
# Newton's method has found it: the next step would be below the last digit.
_CLOSE = 1e-12


def gamma_probability(a: float, x: float) -> float:
    """Return P(a, x), the regularised lower incomplete gamma function; x > 0."""
    first = _gamma_first(a, x)
    if not first:  # so far out, on either side, that both tails are below what a number can be
        return float(x > a)
    return _sum(first, lambda n: x / (a + n))


def gamma_quantile(a: float, probability: float) -> float:
    """Return the x with P(a, x) = probability < 1."""
    high = a + 1.0
    while gamma_probability(a, high) < probability:
        high *= 2
    return _solve(lambda x: (gamma_probability(a, x), _gamma_first(a, x) * a / x), probability,
                  high)


def _gamma_first(a: float, x: float) -> float:
    return exp(a * log(x) - x - lgamma(a + 1))


def beta_quantile(a: float, b: float, probability: float) -> float:
    """Return the x with I_x(a, b) = probability < 1."""
    constant = lgamma(a + b) - lgamma(a + 1) - lgamma(b)

    def values(x: float) -> tuple[float, float]:
        first = exp(a * log(x) + b * log1p(-x) + constant)
        return _sum(first, lambda n: x * (a + b + n - 1) / (a + n)), first * a / (x * (1 - x))

    return _solve(values, probability, 1.0)


def _sum(term: float, ratio: Callable[[int], float]) -> float:
    """Return the sum of a series; ratio : of term n to the one before it."""
    total = 0.0
    n = 0
    while term > _NOTHING * total:
        total = total + term
        n = n + 1
        term *= ratio(n)
    return total


def _solve(values: Callable[[float], tuple[float, float]], wanted: float, high: float) -> float:
    """Return where a function is as wanted, between 0 and `high`; values : it, its derivative."""
    low = 0.0
    x = high / 2
    for _ in range(_STEPS):
        value, slope = values(x)
        low, high = (low, x) if value > wanted else (x, high)
        better = x + (wanted - value) / slope if slope > 0 else low
        if not low < better < high:
            better = (low + high) / 2
        if abs(better - x) <= _CLOSE * x:
            break
        x = better
    return better
