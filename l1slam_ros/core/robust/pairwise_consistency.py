# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Pairwise consistency of loops, independent of the map's prediction of them (PCM).

In: loops of a robust solve. Out: those that agree best with one, which predicts them through the
relative poses of their first ends and of their second ends. Where no accepted loop spans a slip or
a gap, both sides are right in themselves: inliers across fail the gate, but all agree.
"""

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.graph.draws import keys
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import claimed_volume, log_claims, log_likelihood_ratio
from l1slam_ros.core.robust.places import NEAR
from l1slam_ros.core.robust.rounds.evidence import TWO_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth, gain_of_places

# First ends, second ends and measurements of loops.
Ends = tuple[Indices, Indices, Array]
# Loops compared at most.
ASKED = 250
# Pairs evaluated for each loop, on average: those that differ least.
_NEAREST = 20
# Loops of a run, each of which agrees with half this number of others.
RUN = 6

NONE: Indices = np.zeros(0, np.int64)


def strongest_group(growth: Growth, rows: Indices) -> Indices:
    """
    Return the loops that agree best with one, the first; none where that may be chance, (k,).

    Each place counts once, by the best log ratio of its loops, less ln m: any of the m compared
    could agree by chance.
    """
    rows = asked(growth, rows)
    if len(rows) < 2:
        return NONE
    one, other, log_ratio = agreement(growth, rows)
    _, first, place = np.unique(growth.given.place[rows], return_index=True, return_inverse=True)
    evidence = _evidence(place, one, other, log_ratio)
    best = int(np.argmax(evidence))
    needed = np.log(len(rows) / DOUBT)
    one_each = rows[np.sort(first)]  # in the order of `asked`, whatever their numbers
    if evidence[best] < needed or evidence[best] < needed + _by_chance(growth, one_each):
        return NONE
    group: Indices = rows[np.concatenate(([best], other[one == best]))]
    return group


def strongest_across(growth: Growth) -> Indices:
    """
    Return the loops that agree best on the relative pose of two parts, or none, (k,).

    They are of two places or more, else of one long run.
    """
    given, rows = growth.given, growth.joining()
    pair = pair_key(growth.part[given.low[rows]], growth.part[given.high[rows]],
                    given.graph.n_poses)
    by_parts = [rows[pair == one] for one in np.unique(pair)]
    group = max((strongest_group(growth, some) for some in by_parts), key=given.count_places,
                default=NONE)
    if given.count_places(group) >= TWO_PLACES:
        return group
    return max((longest_run(growth, some) for some in by_parts), key=len, default=NONE)


def longest_run(growth: Growth, rows: Indices) -> Indices:
    """
    Return the run that most of some loops belong to, or none, (k,).

    To outweigh the odometry it is twice as long as others: of recorded ones with ten loops five in
    six are true.
    """
    rows = asked(growth, rows)
    longest = max(runs(growth, rows), key=len, default=NONE)
    return longest if len(longest) >= max(2 * RUN, len(rows) / 2 + 1) else NONE


def runs(growth: Growth, rows: Indices) -> list[Indices]:
    """
    Return those of some loops that are of one place, but hardly with one error.

    A path travelled twice is one place. Enough loops that agree in pairs, over a long path at
    either end, are hardly all false.
    """
    rows = asked(growth, rows)
    one, other, _ = agreement(growth, rows)
    given = growth.given
    place = given.place[rows]
    poses = given.graph.manifold.positions(growth.poses)
    count = np.bincount(one[place[one] == place[other]], minlength=len(rows))
    found = []
    for number in np.unique(place):
        own = np.flatnonzero(place == number)
        own = own[2 * count[own] >= RUN]
        ways = [np.ptp(poses[ends[rows[own]]], axis=0).max(initial=0.0)
                for ends in (given.low, given.high)] if len(own) >= RUN else [0.0]
        # Both lengths together exceed the linking distance.
        if min(ways) > NEAR / 2:
            order = np.argsort(-count[own], kind='stable')
            found.append(rows[own[order]])
    return found


def gain_of(growth: Growth, as_stated: Growth, cut: Growth) -> float:
    """
    Return the log odds of a cut by places and runs won, less places that lose loops.

    A path travelled repeatedly is one place, won before, however many of its loops were rejected:
    a run of these counts as a place.
    """
    place, before = growth.given.place, growth.loops
    more = np.flatnonzero(
        cut.loops & ~before & ~as_stated.accepted & np.isin(place, place[before]))
    return gain_of_places(growth, as_stated, cut) + growth.given.log_odds_of_place * len(
        runs(cut, more))


def agree_at_a_place(growth: Growth, rows: Indices) -> Indices:
    """
    Return those of some loops that agree with others of their place, if hardly by chance, (k,).

    The evidence is the best loop's, summed as over places in `strongest_group`.
    """
    _, number, count = np.unique(growth.given.place[rows], return_inverse=True, return_counts=True)
    rows = asked(growth, rows[count[number] > 1])
    one, other, log_ratio = agreement(growth, rows)
    number = np.unique(growth.given.place[rows], return_inverse=True)[1]
    m = max(len(rows), 1)
    same = number[one] == number[other]
    best = np.zeros(m)
    np.maximum.at(best, number, np.bincount(
        one[same], log_ratio[same] - np.log(m), len(rows)))
    sure = np.unique(one[same & (best[number[one]] > np.log(m / DOUBT))])
    agree: Indices = rows[sure]
    return agree


def asked(growth: Growth, rows: Indices) -> Indices:
    """Return a pseudo-random selection of `ASKED` loops, or all, (k,)."""
    order = np.argsort(keys(growth.given.low[rows], growth.given.high[rows]))
    chosen: Indices = rows[order[:ASKED]]
    return chosen


def _evidence(place: Indices, one: Indices, other: Indices, log_ratio: Array) -> Array:
    """Return the evidence of all places for each loop, (k,), from pairs that agree."""
    by_place = np.zeros((len(place), place.max() + 1))
    np.maximum.at(by_place, (one, place[other]), log_ratio - np.log(len(place)))
    by_place[np.arange(len(place)), place] = 0.0
    return by_place.sum(axis=1)


def _by_chance(growth: Growth, rows: Indices) -> float:
    """
    Return the best evidence of loops of one place each with second ends permuted at random.

    On a sphere, or any path alike everywhere, loops agree by chance far more often than in a
    volume.
    """
    exchanged = np.random.default_rng(0).permutation(growth.given.high[rows])
    pairs = agreement(growth, rows, exchanged)
    return float(_evidence(np.arange(len(rows)), *pairs).max(initial=0.0))


def spanned(low: Indices, high: Indices, n: int) -> Indices:
    """Return how many factors span the step from each of n keyframes to the next, (n - 1,)."""
    change = np.zeros(n, np.int64)
    np.add.at(change, np.maximum(low, 0), 1)  # the world precedes all keyframes
    np.add.at(change, high, -1)
    return np.cumsum(change)[:-1]


def agreement(growth: Growth, rows: Indices, high: Indices | None = None
              ) -> tuple[Indices, Indices, Array]:
    """
    Return the pairs of some loops that rather agree than not, three (pairs,).

    Positions of both in `rows`, each pair in both orders, and ln of the likelihood ratio of their
    difference, agreement against chance. One predicts the other by the map's relative poses of
    their first ends and of their second ends, whatever their innovations.

    high : (k,) second ends; None: their own
    """
    given = growth.given
    manifold = given.graph.manifold
    poses = growth.poses
    high = given.high[rows] if high is None else high
    first, second, Z = _ends_by_part(growth, rows, high)
    same_way = growth.part[first] * (growth.part.max() + 1) + growth.part[second]
    a, b = np.triu_indices(len(rows), 1)
    alike = same_way[a] == same_way[b]
    a, b = a[alike], b[alike]
    if not len(a):
        return a, b, np.zeros(0)
    known = with_world(manifold, poses)
    # Second ends as each loop predicts them, and the step there that reconciles them.
    said = manifold.compose(known[first], Z)
    back = manifold.compose(known[second], manifold.inverse(said))
    error = manifold.residual(said[b], back[a], known[second][b])
    scatter = np.linalg.pinv(error.T @ error, hermitian=True)
    far = (error @ scatter * error).sum(axis=1)
    near = np.argsort(far, kind='stable')[: _NEAREST * len(rows)]
    a = a[near]
    b = b[near]
    error = error[near]
    factors = growth.subgraph(rows).between
    k = manifold.TANGENT_SIZE
    roots = factors.sqrt_information[b]
    covariance = 2 * np.eye(k) + _spread(growth, (first, second, Z), a, b, roots)
    square, log_det = native.prediction.normalise(covariance, whiten(roots, error))
    volume = claimed_volume(manifold, poses)
    freedom = factors.freedom[b]
    log_ratio = log_likelihood_ratio(square, log_det, log_claims(factors, volume)[b], freedom,
                                     k)
    good = np.flatnonzero((square < given.gate(freedom)) & (log_ratio > np.log(len(rows))))
    a = a[good]
    b = b[good]
    log_ratio = log_ratio[good]
    return np.concatenate((a, b)), np.concatenate((b, a)), np.tile(log_ratio, 2)


def _ends_by_part(growth: Growth, rows: Indices, high: Indices) -> Ends:
    """Return loops directed to the later part, or within one to the later keyframe."""
    given = growth.given
    low = given.low[rows]
    Z = given.factors.measurement[rows]
    turn = growth.part[low] > growth.part[high]
    return (np.where(turn, high, low), np.where(turn, low, high),
            np.where(turn[:, None], given.graph.manifold.inverse(Z), Z))


def _spread(growth: Growth, ends: Ends, a: Indices, b: Indices, roots: Array) -> Array:
    """
    Return the covariance of the whitened difference of pairs by the map, (pairs, k, k).

    Loop a predicts F Za S for b, with F from the first end of b to that of a, S from the second
    end of a to that of b. To first order Ad (Za S)^-1 and -Ad (F Za S)^-1 times the steps of the
    first ends of a and b, -Ad S^-1 and the identity times those of the second ends.
    """
    manifold = growth.given.graph.manifold
    low, high, Z = ends
    samples, noise = growth.posterior.samples, growth.posterior.noise
    poses = with_world(manifold, growth.poses)
    S = manifold.between(poses[high[a]], poses[high[b]])
    onward = manifold.compose(Z[a], S)
    F = manifold.between(poses[low[b]], poses[low[a]])
    J = [manifold.adjoint(manifold.inverse(T)) for T in (onward, manifold.compose(F, onward), S)]
    blocks = np.stack((roots @ J[0], -roots @ J[1], -roots @ J[2], roots), axis=1)
    keyframe = np.stack((low[a], low[b], high[a], high[b]), axis=1) - growth.posterior.fixed
    keyframe[keyframe < 0] = len(samples) - 1
    return native.prediction.left_over(keyframe, blocks, samples, noise[:0])
