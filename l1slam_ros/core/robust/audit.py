# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Audit a robust solve: leave each place out and predict it from all else.

In: the end of the rounds. Out: the same without places that all else contradicts, with rejected
ones that explain more than they cost; and alternative maps.

A place may have one error d, k numbers, that displaces all its loops, by B d. With the residuals r
of its loops and their covariance R by the noise, all else determines d:

    M = B'RB,   d = -M^-1 B'r,   square = d'Md,   covariance C = M^-1

If the place is true, d has Student's distribution with this covariance, with more degrees of
freedom the more accepted places show the noise. If false, d is uniform over the claimed volume; or
of unknown size, ln of it uniform from that of C to that volume. The share of the latter, and the
odds of a false place, are estimated from all places, accepted and rejected (EM): a local false
discovery rate, logistic in how easily the place would fit by chance and in its number of loops.

The former density decides acceptance; both together give the confidence.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import lgamma

import numpy as np

from l1slam_ros.core import native
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.linear_system import with_world
from l1slam_ros.core.robust.confidence import UNLIKELY, Alternative, Drawn, Shifts, drawn
from l1slam_ros.core.robust.gating import DOUBT, TINY, probability
from l1slam_ros.core.robust.innovation import (
    SAMPLES,
    TAIL,
    claimed_volume,
    log_likelihood_ratio,
)
from l1slam_ros.core.robust.judgement import OTHER_MAP, UNCONFIRMED
from l1slam_ros.core.robust.rounds.evidence import Evidence
from l1slam_ros.core.robust.rounds.growth import Growth

# Log odds of being true below which an accepted place is dropped; else it is a doubt.
_CLEARLY_FALSE = -float(np.log(1 / DOUBT - 1))
# Log ratio below which a rejected place is not tried.
_LEAST = -15.0
# Log odds of being true below which a place may be the false one instead of another.
_RIVAL = 3.0
# Limits: places dropped, rejected ones tried, and accepted; drops after a trial.
_DROPPED, _TRIED, _TAKEN, _SETTLED = 12, 3, 4, 3
# A place that outliers would fit more often than this is not checked by others.
_UNTOLD = 0.5
# Ridge and prior mean of the logistic weights; each further loop makes a place likelier.
_RIDGE, _CENTRE = np.array([0.0, 0.5, 0.5]), np.array([0.0, 0.0, -1.0])
_ROUNDS, _NEWTON, _NEVER = 50, 3, 99


@dataclass(frozen=True)
class Places:
    """
    Places of loops as predicted by all else.

    Attributes
    ----------
    number : (p,) as `Evidence.place`
    accepted : (p,) bool
    count : (p,) of loops
    ratio, mixed : (p,) ln p(d | true) / p(d | false), false ones uniform, or also of unknown size
    odds : (p,) prior ln (false / true)
    information : (p, k, k) M, NaN where hardly constrained
    alone : (p,) bool, accepted but not checked by others
    agrees : (p,) bool, loops agree but for a common error
    rows, of : (m,) loops, and the place of each

    """

    number: Indices
    accepted: Mask
    count: Indices
    ratio: Array
    mixed: Array
    odds: Array
    information: Array
    alone: Mask
    agrees: Mask
    rows: Indices
    of: Indices

    @property
    def likely(self) -> Array:
        """Log odds of each to be true, (p,); infinite if alone."""
        return np.where(self.alone, np.inf, self.ratio - self.odds)

    @property
    def least_likely(self) -> list[int]:
        """The least likely accepted place, if clearly false, and the next; or []."""
        likely = np.where(self.accepted, self.likely, np.inf)
        order: list[int] = np.argsort(likely, kind='stable')[:2].tolist()
        return order if order and likely[order[0]] <= _CLEARLY_FALSE else []

    def loops(self, place: int) -> Indices:
        """Return the loops of a place, (k,)."""
        return self.rows[self.of == place]

    def known(self) -> dict[int, float]:
        """Return the log ratio of each accepted place, by its number."""
        return {int(self.number[k]): float(self.ratio[k]) for k in np.flatnonzero(self.accepted)}


def places_of(growth: Growth) -> Places:
    """Return all places that can be predicted, of accepted loops and of rejected ones."""
    given = growth.given
    k = given.graph.manifold.TANGENT_SIZE
    may_lie = (given.is_loop & ~given.trusted & ~given.factors.is_absolute & ~growth.cut
               & (given.factors.freedom == k))
    some = [np.flatnonzero(may_lie & growth.accepted),
            np.flatnonzero(may_lie & ~growth.accepted & ~growth.across())]
    parts = [_summed(growth, rows, said) for rows, said in zip(some, (_accepted, _refused),
                                                               strict=True)]
    number, first, of, M, b, inner = (
        np.concatenate([part[at] for part in parts]) for at in range(6))
    of[len(some[0]):] += len(parts[0][0])
    count = np.bincount(of, minlength=len(number))
    accepted = np.arange(len(number)) < len(parts[0][0])
    lam, axes = np.linalg.eigh(M) if len(M) else (np.ones((0, k)), np.zeros((0, k, k)))
    lam = np.maximum(lam, TINY**2)
    square = (np.einsum('pij,pi->pj', axes, b)**2 / lam).sum(axis=1)
    log_det = -np.log(lam).sum(axis=1)
    claim = float(claimed_volume(given.graph.manifold, growth.poses).sum())
    # The degrees of freedom grow with the number of other accepted places.
    shown = int(np.count_nonzero(accepted))
    true, peak = (np.where(accepted, *(log_likelihood_ratio(
        at, log_det, np.zeros(1), np.full(len(at), k), k, min(max(n, 1), TAIL))
        for n in (shown, shown + 1))) for at in (square, 0 * square))
    # Where the map is less certain than the claimed volume, outliers fill its uncertainty.
    wide = np.maximum(claim, -peak)
    ratio, near = true + wide, _log_near(square, log_det, wide, peak, k) - true
    gate = float(given.gate(np.array([k]))[0])
    chance = np.minimum(0.0, (log_det + k * np.log(np.pi * gate)) / 2 - lgamma(k / 2 + 1) - claim)
    agrees = inner - square < 4 * np.maximum(k * (count - 1), 1)
    information = (axes * lam[:, None]) @ axes.transpose(0, 2, 1)
    information[wide > claim] = np.nan
    rows = np.concatenate(some)
    alone = accepted & (chance > np.log(_UNTOLD))
    _, odds = _local_odds(ratio, np.full(len(ratio), -np.inf), chance, count)
    mixed, others = _local_odds(ratio, near, chance, count)
    mixed += odds - others
    return Places(number, accepted, count, ratio, mixed, odds, information, alone,
                  agrees | accepted, rows, of)


def _summed(growth: Growth, rows: Indices, said: Callable[..., tuple[Array, Array, Array]]
            ) -> tuple[Indices, Indices, Indices, Array, Array, Array]:
    """Return numbers, first loops, the place of each loop, M, b and r'C^-1 r of places."""
    k = growth.given.graph.manifold.TANGENT_SIZE
    number, first, of = np.unique(growth.given.place[rows], return_index=True,
                                  return_inverse=True)
    if not len(rows):
        return number, first, of, np.zeros((0, k, k)), np.zeros((0, k)), np.zeros(0)
    carried = _carried(growth, rows, rows[first][of])
    return number, first, of, *said(growth, rows, of, len(number), carried)


def _carried(growth: Growth, rows: Indices, first: Indices) -> Array:
    """Return adjoints from the end of the first loop of a place to those of all, (m, k, k)."""
    manifold, high = growth.given.graph.manifold, growth.given.high
    poses = with_world(manifold, growth.poses)
    return manifold.adjoint(manifold.between(poses[high[rows]], poses[high[first]]))


def _add(of: Indices, n: int, values: Array) -> Array:
    total = np.zeros((n, *values.shape[1:]))
    np.add.at(total, of, values)
    return total


def _accepted(growth: Growth, rows: Indices, of: Indices, n: int, carried: Array
              ) -> tuple[Array, Array, Array]:
    posterior = growth.posterior
    at = np.searchsorted(np.flatnonzero(growth.accepted), rows)
    B = posterior.system.blocks[at, 1] @ carried
    b = -_add(of, n, np.einsum('mij,mi->mj', B, posterior.residual[at]))
    drawn = _add(of, n, B.transpose(0, 2, 1) @ posterior.left_over(at))
    return drawn @ drawn.transpose(0, 2, 1) / drawn.shape[2], b, np.zeros(n)


def _refused(growth: Growth, rows: Indices, of: Indices, n: int, carried: Array
             ) -> tuple[Array, Array, Array]:
    # C = I + Y Y' by samples, of all loops of a place jointly.
    system = growth.innovations(rows).system
    k = system.block_size
    B, r = system.blocks[:, 1] @ carried, system.b.reshape(-1, k)
    Y = native.prediction.moved(system.keyframe, system.blocks, growth.posterior.samples)
    Y = Y / np.sqrt(SAMPLES)
    M, b, inner = np.zeros((n, k, k)), np.zeros((n, k)), np.zeros(n)
    single = np.bincount(of, minlength=n)[of] == 1
    at, Bt, own = of[single], B[single].transpose(0, 2, 1), r[single, :, None]
    weighed = np.linalg.solve(np.eye(k) + Y[single] @ Y[single].transpose(0, 2, 1),
                              np.concatenate((B[single], own), axis=2))
    M[at], b[at] = Bt @ weighed[:, :, :k], (Bt @ weighed[:, :, k:])[:, :, 0]
    inner[at] = (own * weighed[:, :, k:])[:, :, 0].sum(axis=1)
    if single.all():
        return M, b, inner
    # Of several, C is inverted by a matrix of the samples (M. A. Woodbury).
    several, of = np.unique(of[~single], return_inverse=True)
    B, r, Y = B[~single], r[~single], Y[~single]
    Bt, Yt = B.transpose(0, 2, 1), Y.transpose(0, 2, 1)
    BB, BY, YY = (_add(of, len(several), product) for product in (Bt @ B, Bt @ Y, Yt @ Y))
    Br, Yr = (_add(of, len(several), (side @ r[:, :, None])[:, :, 0]) for side in (Bt, Yt))
    W = np.linalg.inv(np.eye(SAMPLES) + YY)
    WY = (W @ Yr[:, :, None])[:, :, 0]
    M[several] = BB - BY @ W @ BY.transpose(0, 2, 1)
    b[several] = Br - (BY @ WY[:, :, None])[:, :, 0]
    inner[several] = _add(of, len(several), (r**2).sum(axis=1)) - (Yr * WY).sum(axis=1)
    return M, b, inner


def _log_near(square: Array, log_det: Array, wide: Array, peak: Array, k: int) -> Array:
    """
    Return ln of the density of errors of unknown size, (p,), nowhere above `peak`, (p,).

    ln of the size is uniform from that of the covariance to that of the claimed volume: Student's
    distribution without degrees of freedom, truncated at that size, L:

        p(d) = (1 + square / k)^(-k/2) / (|C|^(1/2) k^(k/2) S ln(1 + L^2) / 2)

    with S the surface of the sphere in k dimensions.
    """
    size = np.maximum(wide - (log_det + k * np.log(2 * np.pi)) / 2, TINY) / k
    surface = np.log(2) + k / 2 * np.log(np.pi) - lgamma(k / 2)
    most = -(log_det + k * np.log(k)) / 2 - surface - np.log(np.log1p(np.exp(2 * size)) / 2)
    return np.minimum(most, peak) - k * np.log1p(square / k) / 2


def _local_odds(ratio: Array, near: Array, chance: Array, count: Indices) -> tuple[Array, Array]:
    """
    Return ln p(d | true) / p(d | false) and ln (false / true) of each place, (p,) each.

    By EM, see the module, also of the share of unknown size.

    ratio : with uniform outliers; near : ln p(d of unknown size) / p(d | true)
    """
    if not len(ratio):
        return ratio, ratio
    X = np.stack((np.ones(len(ratio)), chance - chance.mean(),
                  np.log(count) - np.log(count).mean()), axis=1)
    share, w = 0.5, _CENTRE.copy()
    for _ in range(_ROUNDS):
        parts = np.log(1 - share) - ratio, np.log(share) + near
        known = np.clip(-np.logaddexp(*parts), -30, 30)
        false, before = probability(X @ w - known), w
        small = false @ probability(parts[1] - parts[0])
        share = (small + 1) / (false.sum() + 2)
        for _ in range(_NEWTON):
            p, one = probability(X @ w), float(probability(w[:1])[0])
            slope = X.T @ (false - p) - _RIDGE * (w - _CENTRE)
            slope[0] += 1 - 2 * one  # one pseudo-place of each kind
            bend = (X.T * (p * (1 - p))) @ X + np.diag(_RIDGE + TINY)
            bend[0, 0] += 2 * one * (1 - one)
            w = w + np.clip(np.linalg.solve(bend, slope), -2, 2)
        w[1], w[2] = max(w[1], 0.0), min(w[2], 0.0)
        if abs(w - before).max() < 0.01:
            break
    return -np.logaddexp(*parts), X @ w


class _Vouched(Evidence):
    """A prepared graph with some loops trusted while others go."""

    vouched: Mask

    @property
    def trusted(self) -> Mask:
        return self.vouched


def audit(growth: Growth) -> tuple[Growth, Places, list[Alternative]]:
    """Return the state after the audit, its places, and alternatives that were tried."""
    growth = _with_uncontested(growth)
    others = _drop(growth)
    places, taken = places_of(growth), 0
    tried: set[int] = set()
    while len(tried) < _TRIED + 2 * taken:
        open_ = [k for k in np.argsort(-places.likely, kind='stable').tolist()
                 if not places.accepted[k] and places.count[k] > 1 and places.agrees[k]
                 and places.ratio[k] > _LEAST and int(places.number[k]) not in tried]
        if not open_:
            break
        own = int(places.number[open_[0]])
        tried.add(own)
        loops = places.loops(open_[0])
        state, after = _taken(growth, loops)
        old, new = places.known(), after.known()
        if own not in new and not set(new) - set(old):
            continue
        odds = (sum(new[k] for k in new if k not in old and k != own)
                - sum(old[k] for k in old if k not in new) + places.likely[open_[0]])
        if odds > 0 and taken < _TAKEN:
            others.append(Alternative(OTHER_MAP, loops, -float(odds), drawn(growth)))
            state.drops[:] = 0
            _again(state)
            places, growth = _settle(state), state
            taken += 1
        else:
            others.append(Alternative(OTHER_MAP, loops, float(odds), drawn(state)))
    return growth, places, [one for one in others if not growth.accepted[one.loops].all()]


def _with_uncontested(growth: Growth) -> Growth:
    """
    Return a state with all rejected loops, where they fit the map and each other.

    Then they are outliers by the prior alone, and the likelier map has them.
    """
    given = growth.given
    rows = np.flatnonzero(given.is_loop & ~growth.accepted)
    if not len(rows) or growth.across()[rows].any() or (growth.cut & ~given.gap).any():
        return growth
    found = growth.innovations(rows)
    if (found.square >= given.gate(found.freedom)).any():
        return growth
    state = growth.copy()
    state.accepted[rows] = True
    state.solve()
    return state if state.accepted[rows].all() else growth


def _drop(growth: Growth) -> list[Alternative]:
    """Drop clearly false places one by one; return alternatives where they are true."""
    dropped: list[Indices] = []
    others: list[Alternative] = []
    for _ in range(2):
        count = len(dropped)
        for _ in range(_DROPPED):
            places = places_of(growth)
            if not (least := places.least_likely):
                break
            worst, other = least[0], least[-1]
            loops, before = places.loops(worst), growth.copy()
            dropped.append(loops)
            growth.accepted[loops], growth.drops[loops] = False, _NEVER
            growth.solve()
            likely = places.likely
            others.append(Alternative(OTHER_MAP, loops, float(likely[worst]), drawn(before)))
            if (places.count[worst] > 1 and other != worst and places.accepted[other]
                    and likely[other] < _RIVAL):
                others += _instead(growth, before, places, worst, other)
        if len(dropped) == count:
            break
        _again(growth)
        growth.drops[np.concatenate(dropped)] = _NEVER
    return others


def _instead(one: Growth, before: Growth, places: Places, place: int, other: int
             ) -> list[Alternative]:
    """Return the map in which another place than the dropped one is false."""
    two, loops = before, places.loops(other)
    two.accepted[loops] = False
    two.solve()
    odds = [_likely(state, number) for state, number in (
        (two, places.number[place]), (one, places.number[other]))]
    return [Alternative(OTHER_MAP, places.loops(place), odds[0] - odds[1], drawn(two))]


def _likely(state: Growth, number: int) -> float:
    """Return the log odds of an accepted place to be true; else `_LEAST`."""
    places = places_of(state)
    at = np.flatnonzero(places.accepted & (places.number == number))
    return float(places.likely[at[0]]) if len(at) else _LEAST


def _again(growth: Growth) -> None:
    """Estimate the noise again, and accept what fits by it."""
    growth.noise = replace(growth.noise, at_their_word=False).forgotten()
    growth.learn_noise_anew()
    growth.accept_more()
    growth.take_at_their_word()
    growth.solve()
    growth.accept_more()


def _taken(growth: Growth, loops: Indices) -> tuple[Growth, Places]:
    """Return the state with some rejected loops as true, and others updated."""
    state, given = growth.copy(), growth.given
    vouched = _Vouched(**{one.name: getattr(given, one.name) for one in fields(Evidence)})
    mask = given.factors.trusted.copy()
    mask[loops] = True
    object.__setattr__(vouched, 'vouched', mask)
    state.given = vouched
    state.accepted[loops] = True
    state.drops[:] = 0
    state.solve()
    state.accept_more()
    state.given = given
    return state, _settle(state)


def _settle(state: Growth) -> Places:
    """Drop a few clearly false places; return the places."""
    for number in range(_SETTLED + 1):
        places = places_of(state)
        if number == _SETTLED or not (least := places.least_likely):
            break
        loops = places.loops(least[0])
        state.accepted[loops], state.drops[loops] = False, _NEVER
        state.solve()
        state.accept_more()
        state.drops[loops] = _NEVER
    return places


def alternatives(growth: Growth, map_: Drawn, places: Places, known: list[Alternative]
                 ) -> list[Alternative]:
    """Return the maps with one place accepted or rejected instead, but for known ones."""
    true = places.mixed - places.odds
    odds = np.where(places.accepted, -true, true)
    known_places = np.unique(np.concatenate([places.of[np.isin(places.rows, one.loops)]
                                             for one in known] or [np.zeros(0, np.int64)]))
    odds[known_places[~places.accepted[known_places]]] = -np.inf
    # A place that alone spans a slip is covered by the alternative of the slip.
    for step in np.flatnonzero(growth.cut & ~growth.given.gap).tolist():
        across = np.unique(places.of[growth.given.spanning(step)[places.rows]])
        odds[across[places.alone[across]]] = -np.inf
    unsure = np.flatnonzero(odds > np.log(UNLIKELY))
    if not len(unsure):
        return []
    shifts = Shifts(growth, map_)
    found = []
    for k in unsure.tolist():
        loops = places.loops(k)
        if not places.accepted[k]:
            found.append(Alternative(OTHER_MAP, loops, float(odds[k]), shifts.with_one(loops[0])))
            continue
        other = None
        if np.isfinite(places.information[k]).all():
            at = np.searchsorted(np.flatnonzero(growth.accepted), loops)
            B = growth.posterior.system.blocks[at, 1] @ _carried(
                growth, loops, np.repeat(loops[:1], len(loops)))
            other = shifts.without(at, B, places.information[k])
        found.append(Alternative(UNCONFIRMED, loops, float(odds[k]), other))
    return found
