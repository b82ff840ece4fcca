# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Gate factors by their odds of being outliers, with the outlier rate estimated from the data.

In: likelihood ratios of inlier against outlier. Out: the odds of an outlier, and the factors to
accept. The odds are fitted to the factors themselves (empirical Bayes); no rate is assumed.
"""

from collections.abc import Callable

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.robust.innovation import (
    BY_CHANCE,
    Innovations,
    Posterior,
    log_likelihood_ratio,
)

# Bound on the squared innovations of inliers, by their degrees of freedom.
Gate = Callable[[Indices], Array]

# Bound on the probability of an outlier among factors accepted together. In 89 runs
# (benchmarks/robust/sensitivity.py, as all such counts) half makes 4 worse, double 2.
DOUBT = 0.01
# The noise is estimated from this number of the best predicted factors; half or double makes none
# worse.
_BEST_PREDICTED = 1000
# Relative change at which expectation maximisation, or a robot's motion, counts as unchanged.
SAME = 1e-3
# Candidate ratios of the noise scale of loops to that of odometry. Any but 1 costs this log
# likelihood for each loop: half or double changes no run; without it FR079's map by wheels errs by
# .87 m instead of .73, and Intel with misstated noise loses fewer loops.
_RATIOS = (1.0, *(10.0**power for power in range(-6, 7) if power))
_RATIO_COSTS = 0.25
# Floor of variances and of information that may be zero.
TINY = 1e-9
# Pairs are formed of this number of the best fitting factors; half and double change 8 and 5 runs,
# none for the worse. With 250, Intel, a recorded log, gets a false slip.
_CANDIDATES = 200


def log_odds_of_false(log_ratio: Array, others: int, believed: int = 0) -> float:
    """
    Return ln (false / true) of a population of factors, by expectation maximisation.

    A pseudo-factor of each class keeps the odds finite.

    log_ratio : (m,) of factors that pass the gate; others : number that fail it, all false;
    believed : number known to be true
    """
    count = len(log_ratio) + others + believed
    odds, before = 0.0, np.inf
    while abs(odds - before) >= SAME:
        before = odds
        true = float(probability(log_ratio - odds).sum()) + believed + 1
        odds = float(np.log((count + 2 - true) / true))
    return odds


def probability(log_odds: Array) -> Array:
    """Return 1 / (1 + exp(-log_odds)) without overflow."""
    chance: Array = (1 + np.tanh(log_odds / 2)) / 2
    return chance


def believable(
    found: Innovations, posterior: Posterior, gate: Gate, fits: Mask, believed: int,
    place: Indices,
) -> Indices:
    """
    Return the factors to accept: each on its own odds, else in pairs, (k,).

    gate : see `Gate`; fits : (m,) which pass it; believed : number of others known to be true;
    place : (m,) see `places`
    """
    log_ratio = found.log_ratio()
    odds = log_odds_of_false(log_ratio[fits], int(np.count_nonzero(~fits)), believed)
    log_odds = np.logaddexp(odds, rivals(found, posterior, (fits, log_ratio, odds), place))
    # Before any loop is accepted, or with too large noise, outliers fit nearly as well.
    well = (found.square < gate(found.freedom) / 2) & (believed > 0)
    good: Indices = np.flatnonzero(fits)[at_once((log_ratio - log_odds)[fits], place[fits],
                                                 well[fits])]
    if not len(good):
        good = together(found, posterior, gate, (fits, log_ratio, log_odds), place)
    return good


def at_once(log_odds: Array, place: Indices, well: Mask) -> Indices:
    """
    Return the factors to accept together, surest first.

    As many as are all true but for `DOUBT`. Factors that fit well also pass by the false discovery
    rate (Y. Benjamini and Y. Hochberg, 1995): the expected number of false places, plus `DOUBT`,
    is below `BY_CHANCE` times their number; so a few places never pass. All loops of a place may
    share one error: it counts once, by its most doubtful factor.

    log_odds : (m,) ln (true / false); place : (m,) see `places`; well : (m,) which fit well
    """
    doubt = probability(-log_odds)
    order = np.argsort(doubt, kind='stable')
    doubt = doubt[order]
    by_place = np.argsort(place[order], kind='stable')
    same = np.diff(place[order][by_place]) == 0
    again = by_place[1:][same]
    more = doubt.copy()
    more[again] -= doubt[by_place[:-1][same]]
    first = np.ones(len(doubt), bool)
    first[again] = False
    few = np.flatnonzero(DOUBT + np.cumsum(more) < BY_CHANCE * np.cumsum(first))
    among_few = np.arange(len(doubt)) <= few.max(initial=-1)
    good: Indices = order[(np.cumsum(doubt) < DOUBT) | (among_few & well[order])]
    return good


def together(found: Innovations, posterior: Posterior, gate: Gate,
             alone: tuple[Mask, Array, Array], place: Indices) -> Indices:
    """
    Return the factors to accept in pairs, where none is sure by itself, (k,).

    The log ratio of a gains that of the best factor b of another place given a, less the log odds
    of b if positive: two loops that agree can start a map though each may fit by chance.

    gate, place : see `at_once`, `Gate`; alone : (m,) each, which pass it, log ratios, log odds
    """
    fits, log_ratio, odds = alone
    one, other, square, both = _pairs(found, posterior, np.flatnonzero(fits), log_ratio, place)
    far = np.zeros(len(fits))
    agree = square < gate(found.freedom[one] + found.freedom[other])
    gain = both - log_ratio[one] - np.maximum(odds[other], 0.0)
    np.maximum.at(far, one[agree], gain[agree])
    believed: Indices = np.flatnonzero(
        (log_ratio + far > odds + np.log(1 / DOUBT - 1)) & (far > 0))
    return believed


def rivals(found: Innovations, posterior: Posterior, alone: tuple[Mask, Array, float],
           place: Indices) -> Array:
    """
    Return the log odds against each factor by its best contradicting factor elsewhere, (m,).

    Where the map is less certain than the factors, two may fit it and contradict each other: if b
    is true, a is more likely false than both true.

    alone, place : see `together`, with one log odds of all
    """
    fits, log_ratio, odds = alone
    unsure = np.flatnonzero(fits & (found.log_det > found.freedom * np.log(2)))
    one, other, _, both = _pairs(found, posterior, unsure, log_ratio, place)
    best = np.full(len(fits), -np.inf)
    np.maximum.at(best, one, log_ratio[other] - np.logaddexp(
        0.0, both - odds - log_ratio[one]))
    return best


def _pairs(found: Innovations, posterior: Posterior, rows: Indices, log_ratio: Array,
           place: Indices) -> tuple[Indices, Indices, Array, Array]:
    """
    Return pairs of the best fitting of some factors, from two places, in both orders.

    First and second, (pairs,) each, with their `Innovations.joint`.
    """
    best = rows[np.argsort(-log_ratio[rows], kind='stable')[:_CANDIDATES]]
    a, b = (best[side] for side in np.triu_indices(len(best), 1))
    a, b = (ends[place[a] != place[b]] for ends in (a, b))
    square, both = found.joint(posterior, a, b) if len(a) else (np.zeros(0), np.zeros(0))
    return (np.concatenate((a, b)), np.concatenate((b, a)), np.tile(square, 2),
            np.tile(both, 2))


def noise_variance(found: Innovations) -> Array:
    """
    Return the ratios of actual to stated variance of odometry and loops, (2,).

    With `scale` of the odometry and `ratio scale` of loops, innovations of inliers have the
    covariance `scale (spread + ratio I)`. Expectation maximisation from several ratios and scales;
    the likeliest wins. Only the best predicted loops, the most informative, are used.
    """
    best = np.argsort(found.log_det, kind='stable')[:_BEST_PREDICTED]
    k = found.system.block_size
    log_claim = found.log_claim[best]
    freedom = found.freedom[best]
    residual = -found.system.b.reshape(-1, k)[best]
    spread = found.spread[best]
    fits: list[tuple[float, float, float]] = []
    for ratio in _RATIOS:
        square, log_det = native.prediction.normalise(spread + ratio * np.eye(k), residual)
        log_det -= (k - freedom) * np.log(ratio)  # uninformative rows have no noise
        for start in (1.0, *(np.quantile(square, (0.1, 0.5)) / k).tolist()):
            likelihood, scale = _fitted_scale(square, log_det, log_claim, freedom, k, start)
            # Prior: each factor of ten of misstatement is as unlikely as an accepted outlier.
            costs = _RATIO_COSTS * len(best) * (ratio != 1) - np.log(DOUBT) * (
                abs(np.log10(scale)) + abs(np.log10(ratio)))
            fits.append((likelihood - costs, scale, ratio))
    _, scale, ratio = max(fits)
    return np.array([scale, ratio * scale])


def _fitted_scale(square: Array, log_det: Array, log_claim: Array, freedom: Indices, k: int,
                  start: float) -> tuple[float, float]:
    """Return the log likelihood of the best scale of C near a start, and the scale."""
    scale, before = max(start, TINY), np.inf
    start = scale
    while abs(scale / before - 1) >= SAME:
        log_ratio = log_likelihood_ratio(square / scale, log_det + freedom * np.log(scale),
                                         log_claim, freedom, k)
        odds = log_odds_of_false(log_ratio, 0)
        true = probability(log_ratio - odds)
        # One pseudo-factor at the start, in case there is no inlier.
        before = scale
        scale = float((true @ square + start) / (true @ freedom + 1))
    likelihood = np.logaddexp(log_ratio - odds, 0.0).sum() - len(square) * np.logaddexp(0, -odds)
    return float(likelihood), scale
