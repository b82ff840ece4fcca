# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Slips that refused loops show: such a loop is a lie, or true, and a step slipped.

In: the end of a robust solve. Out: of each loop and step the odds of that. Where few loops are,
one that does not fit may be all the evidence of a slip. A lie claims anything, a slip explains any
loop; but of a slip the loop says how the robot moved on, and of nearly all lies it would be a
motion as it never makes.
"""

from math import lgamma

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.robust.confidence import CONFIDENT
from l1slam_ros.core.robust.innovation import claimed_volume
from l1slam_ros.core.robust.odometry.motion import Motion, steps_of, unwhitening
from l1slam_ros.core.robust.pairwise_consistency import asked, spanned
from l1slam_ros.core.robust.rounds.evidence import FEWEST_PLACES
from l1slam_ros.core.robust.rounds.growth import Growth

# ln of odds from which on such a slip is a doubt: a map that is less likely right is doubted.
LEAST = float(np.log(1 / CONFIDENT - 1))
# Refused loops (l,), steps (k,), and ln of the odds that each shows each slipped, (l, k).
Shown = tuple[Indices, Indices, Array]
# Pairs of a loop and a step that are looked at together.
_PAIRS = 20_000


def shown_slips(growth: Growth, motion: Motion) -> Shown:
    """
    Return refused loops (l,), steps (k,), and ln of the odds that each shows each slipped, (l, k).

    Of steps of which few places tell; what spans another step that is cut, tells of none. The
    refused loop is true then, else it is a lie and nothing slipped. Of a step z, one of n, and y,
    what it was if the loop is true,

        p(y as motion) p_slip(z | y) V true / (n p(z as motion) refused)

    with V as much as lies claim, true how many places are accepted and refused how many loops are.
    A slip turns by anything and moves by a Cauchy distribution, as wide as steps are long and as y
    is unsure.
    """
    given, n = growth.given, growth.given.graph.n_poses
    loops = np.flatnonzero(growth.accepted & given.is_loop)
    loops = loops[np.unique(given.place[loops], return_index=True)[1]]
    rows = growth.undecided()
    rows = asked(growth, rows[given.factors.freedom[rows] == len(motion.mean)])
    cuts = np.append(0, np.cumsum(spanned(given.low[growth.cut], given.high[growth.cut], n)))
    tell = loops[cuts[given.low[loops]] == cuts[given.high[loops]]]
    across = spanned(given.low[tell], given.high[tell], n)
    steps = np.flatnonzero(given.is_step & ~growth.cut)
    steps = steps[across[given.low[steps]] < FEWEST_PLACES]
    if not len(rows) or not len(steps):
        return rows, steps, np.zeros((0, len(steps)))
    odds = slips_told(growth, motion, steps, rows) - motion.log_density(steps_of(growth, steps))
    return rows, steps, odds + prior_of_slip(growth)


def prior_of_slip(growth: Growth) -> float:
    """Return ln of the odds that a refused loop is true and a step slipped, see above."""
    given = growth.given
    true = len(np.unique(given.place[growth.accepted & given.is_loop])) + 1
    return float(np.log(true / (len(growth.undecided()) + 1) / np.count_nonzero(
        ~given.is_loop & ~growth.cut)))


def slips_told(growth: Growth, motion: Motion, steps: Indices, rows: Indices) -> Array:
    """
    Return ln p(y as motion) p_slip(z | y) V of steps z by refused loops, (loops, steps).

    -inf where a loop does not span a step.
    """
    given = growth.given
    told = np.full((len(rows), len(steps)), -np.inf)
    root, spread = unwhitening(growth, rows), growth.innovations(rows).spread
    covariance = root @ (spread + np.eye(len(motion.mean))) @ root.transpose(0, 2, 1)
    # So many at a time that what is worked out for each pair of them stays small.
    size = max(1, _PAIRS // max(len(steps), 1))
    for first in range(0, len(rows), size):
        some = rows[first:first + size]
        row, step = np.nonzero((given.low[some, None] <= given.low[steps])
                               & (given.high[some, None] >= given.high[steps]))
        told[first + row, step] = _log_density(
            growth, motion, steps[step], some[row], covariance[first + row])
    manifold = given.graph.manifold
    return told + claimed_volume(manifold, growth.poses)[manifold.TRANSLATION].sum()


def _log_density(growth: Growth, motion: Motion, steps: Indices, rows: Indices,
                 known: Array) -> Array:
    """
    Return ln p(y as motion) p_slip(z | y) of steps z, each of a loop that spans it, (k,).

    rows : (k,) the loops; known : (k, d, d) the covariance of each, predicted without it
    """
    given = growth.given
    manifold, poses = given.graph.manifold, growth.poses
    after = manifold.between(poses[given.high[steps]], poses[given.high[rows]])
    before = manifold.between(poses[given.low[steps]], poses[given.low[rows]])
    y = manifold.compose(before, manifold.compose(given.factors.measurement[rows],
                                                  manifold.inverse(after)))
    carried = manifold.adjoint(after)
    spread = carried @ known @ carried.transpose(0, 2, 1)
    start = manifold.identity(len(rows))
    J = manifold.local_jacobian(start, y)
    moved = motion.log_density(manifold.local(start, y), J @ spread @ J.transpose(0, 2, 1))
    slip = manifold.local(y, given.factors.measurement[steps])
    return moved + log_slip(manifold, slip, spread, motion)


def log_slip(manifold: Manifold, slip: Array, spread: Array, motion: Motion) -> Array:
    """Return the log density of slips, tangents (k, d), that are known to (k, d, d)."""
    part = manifold.TRANSLATION
    square = (slip[:, part] ** 2).sum(axis=1)
    long = (motion.step[:, part] ** 2).sum(axis=1).mean()
    wide = long + np.trace(spread[:, part, part], axis1=1, axis2=2)
    size = (part.stop + 1) / 2
    return (lgamma(size) - size * np.log(np.pi) + np.log(wide) / 2
            - size * np.log(wide + square))
