# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which of many factors to believe, given how well each one fits.

In: likelihood ratios of true against false. Out: the odds of a false one among them, and those
that may be believed. The odds come from the factors themselves (empirical Bayes), so no share of
false ones is assumed.
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

# What squares of true factors stay below, by their freedom.
Gate = Callable[[Indices], Array]

# Of factors that are believed at one time, any is false with at most this probability. Of 89 runs
# (benchmarks/robust/sensitivity.py, as all such counts) half makes 4 worse, double 2.
DOUBT = 0.01
# The noise is judged by so many of the best predicted factors; half and double make none worse.
_BEST_PREDICTED = 1000
# What differs by no more than this part of it is the same: what rounds of expectation and
# maximisation find, which end then; how a robot moves.
SAME = 1e-3
# How much more the loops' variance may be off than the odometry's, as said or else; another ratio
# has to make each loop likelier by so much, ln. Half and double change none, but with none FR079's
# map by wheels is .87 m off for .73, and Intel with noise that is stated wrong loses fewer loops.
_RATIOS = (1.0, *(10.0**power for power in range(-6, 7) if power))
_RATIO_COSTS = 0.25
# Variances are no less, and no information, where they would be nothing.
TINY = 1e-9
# Pairs are formed of so many factors that fit best; half and double change 8 and 5, none is worse.
# By 250 a recorded log, Intel, gets a slip that is none.
_CANDIDATES = 200


def log_odds_of_false(log_ratio: Array, others: int, believed: int = 0) -> float:
    """
    Return ln (false / true) of a crowd of factors, by expectation and maximisation.

    log_ratio : (m,) of those that fit; others : how many do not, all false; believed : how many
    are true for sure. One of each kind is added, so that a crowd without a true or a false one
    still says how sure that is.
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
    Return the factors that may be believed: each by itself, else together, (k,).

    Parameters
    ----------
    gate : what squares of true factors stay below, by their freedom; fits : (m,) which do
    believed : how many others are true for sure
    place : (m,) see `places`

    """
    log_ratio = found.log_ratio()
    odds = log_odds_of_false(log_ratio[fits], int(np.count_nonzero(~fits)), believed)
    log_odds = np.logaddexp(odds, rivals(found, posterior, (fits, log_ratio, odds), place))
    # Before any is believed, or by noise that is too large, lies fit nearly as well as true ones.
    well = (found.square < gate(found.freedom) / 2) & (believed > 0)
    good: Indices = np.flatnonzero(fits)[at_once((log_ratio - log_odds)[fits], place[fits],
                                                 well[fits])]
    if not len(good):
        good = together(found, posterior, gate, (fits, log_ratio, log_odds), place)
    return good


def at_once(log_odds: Array, place: Indices, well: Mask) -> Indices:
    """
    Return which may be believed, all of them at once, surest first.

    As many as are all true but for `DOUBT`. Of those that fit well, as many as no more than
    `BY_CHANCE` of their places are expected to be false of, and `DOUBT` of one more place, so
    that of few none is given away (the false discovery rate of Y. Benjamini and Y. Hochberg,
    1995). A place may have been mistaken as a whole: it counts once, by its most doubtful factor.

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
    Return which factors may be believed by pairs, where none is sure by itself, (k,).

    To the log ratio of a that of the best factor b of another place given a is added, less the
    log odds of b above 0: two that fit well begin a map though each may be chance.

    Parameters
    ----------
    gate : what squares of true factors stay below, by their freedom
    alone : which fit (m,), the log ratios and the log odds (m,)
    place : (m,) see `places`

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
    Return what the best rival of another place speaks against each factor, ln of odds, (m,).

    Where the map knows less than the factors say, two may fit it and contradict each other: if b
    is true, a is rather false than both are true.

    alone, place : see `together`, but the log odds of all
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
    Return the pairs of two places, both ways round, of those of some factors that fit best.

    The one and the other, (pairs,) each, the square and the log ratio of both, see
    `Innovations.joint`.
    """
    best = rows[np.argsort(-log_ratio[rows], kind='stable')[:_CANDIDATES]]
    a, b = (best[side] for side in np.triu_indices(len(best), 1))
    a, b = (ends[place[a] != place[b]] for ends in (a, b))
    square, both = found.joint(posterior, a, b) if len(a) else (np.zeros(0), np.zeros(0))
    return (np.concatenate((a, b)), np.concatenate((b, a)), np.tile(square, 2),
            np.tile(both, 2))


def noise_variance(found: Innovations) -> Array:
    """
    Return by what the variances that odometry and loops state are to be multiplied, (2,).

    With `scale` of the odometry and `ratio scale` of the loops, true innovations have the
    covariance `scale (spread + ratio I)`; the false ones any. Expectation and maximisation, from
    several ratios and scales, of which the likeliest wins. Only the best predicted loops are
    asked: their fit tells most.
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
        log_det -= (k - freedom) * np.log(ratio)  # what says nothing has no noise
        for start in (1.0, *(np.quantile(square, (0.1, 0.5)) / k).tolist()):
            likelihood, scale = _fitted_scale(square, log_det, log_claim, freedom, k, start)
            # A factor of ten that files are off is as unlikely as a lie among what is believed.
            costs = _RATIO_COSTS * len(best) * (ratio != 1) - np.log(DOUBT) * (
                abs(np.log10(scale)) + abs(np.log10(ratio)))
            fits.append((likelihood - costs, scale, ratio))
    _, scale, ratio = max(fits)
    return np.array([scale, ratio * scale])


def _fitted_scale(square: Array, log_det: Array, log_claim: Array, freedom: Indices, k: int,
                  start: float) -> tuple[float, float]:
    """Return the log likelihood of the best scale of C near a start, and that scale."""
    scale, before = max(start, TINY), np.inf
    start = scale
    while abs(scale / before - 1) >= SAME:
        log_ratio = log_likelihood_ratio(square / scale, log_det + freedom * np.log(scale),
                                         log_claim, freedom, k)
        odds = log_odds_of_false(log_ratio, 0)
        true = probability(log_ratio - odds)
        # The one pseudo-factor at the start is for crowds without a true one.
        before = scale
        scale = float((true @ square + start) / (true @ freedom + 1))
    likelihood = np.logaddexp(log_ratio - odds, 0.0).sum() - len(square) * np.logaddexp(0, -odds)
    return float(likelihood), scale
