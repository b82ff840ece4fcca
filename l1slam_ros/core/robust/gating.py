# SPDX-License-Identifier: Apache-2.0
"""
Which of many factors to believe, given how well each one fits.

In: likelihood ratios of true against false. Out: the odds of a false one among them, and those
that may be believed. The odds come from the factors themselves (empirical Bayes), so no share of
false ones is assumed.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.robust.innovation import Innovations

# Of factors that are believed at one time, any is false with at most this probability.
DOUBT = 0.01
# The noise is judged by so many of the best predicted factors.
_BEST_PREDICTED = 1000
_ROUNDS = 100
_SAME = 1e-3


def log_odds_of_false(log_ratio: Array, others: int, believed: int = 0) -> float:
    """
    Return ln (false / true) of a crowd of factors, by expectation and maximisation.

    log_ratio : (m,) of those that fit; others : how many do not, all false; believed : how many
    are true for sure. One of each kind is added, so that a crowd without a true or a false one
    still says how sure that is.
    """
    count, odds = len(log_ratio) + others + believed, 0.0
    for _ in range(_ROUNDS):
        true = float(probability(log_ratio - odds).sum()) + believed + 1
        before, odds = odds, float(np.log((count + 2 - true) / true))
        if abs(odds - before) < _SAME:
            break
    return odds


def probability(log_odds: Array) -> Array:
    """Return 1 / (1 + exp(-log_odds)) without overflow."""
    chance: Array = (1 + np.tanh(log_odds / 2)) / 2
    return chance


def believable(log_ratio: Array, log_odds: float) -> Indices:
    """Return the factors that may be believed, all of them at once, the surest first, (k,)."""
    doubt = probability(log_odds - log_ratio)
    order = np.argsort(doubt, kind='stable')
    doubt = doubt[order]
    good = np.cumsum(doubt) < DOUBT
    believed: Indices = order[good]
    return believed


def common_scale(found: Innovations) -> float:
    """
    Return by what the variances that factors state are to be multiplied, as one number.

    The true ones have innovations of covariance `scale C`, the false ones any: expectation and
    maximisation over the best predicted, whose fit tells most.
    """
    best = np.argsort(found.log_det, kind='stable')[:_BEST_PREDICTED]
    k, square, scale = found.system.block_size, found.square[best], 1.0
    share = found.freedom[best] / k
    for _ in range(_ROUNDS):
        log_ratio = found.log_ratio(scale)[best]
        true = probability(log_ratio - log_odds_of_false(log_ratio, 0))
        # The one pseudo-factor of scale 1 is for crowds without a true one.
        before, scale = scale, float((true @ square + k) / (k * ((true * share).sum() + 1)))
        if abs(scale / before - 1) < _SAME:
            break
    return scale


def one_of_each_group(i: Indices, j: Indices, apart: int) -> Indices:
    """
    Return factors (i, j) so that no two join nearly the same places; earlier ones first, (k,).

    apart : least sum of the distances, in keyframes, between their two ends
    """
    rest, chosen = np.arange(len(i)), []
    while len(rest):
        head = rest[0]
        chosen.append(head)
        rest = rest[np.abs(i[rest] - i[head]) + np.abs(j[rest] - j[head]) > apart]
    return np.array(chosen, np.int64)
