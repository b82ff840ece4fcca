# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Cuts of the odometry: a step is left out, its two sides are joined by the loops across it alone.

In: a robust state, and a step that may have slipped. Out: the state without the step's
measurement, and whether it leaves the robot a usual motion there. If each side is a part that is
right in itself, the true loops across agree with each other (`pairwise_consistency`): parts are
joined where loops of two places or more agree. The sides of a gap are joined likewise.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import component_labels, lowest_of_components
from l1slam_ros.core.graph.spanning_tree import pair_key, parents
from l1slam_ros.core.robust.odometry.motion import Motion, steps_of, unwhitening
from l1slam_ros.core.robust.pairwise_consistency import spanned, strongest_across
from l1slam_ros.core.robust.rounds.growth import Growth


def join(growth: Growth) -> bool:
    """Join parts where loops across agree; return whether any were joined."""
    joined = False
    while len(group := strongest_across(growth)):
        _join_by(growth, group)
        joined = True
    return joined


def _join_by(growth: Growth, group: Indices) -> None:
    """Align the later one of two parts by the first loop of a group, and accept the group."""
    given = growth.given
    manifold, loop = given.graph.manifold, group[0]
    fixed, moving = given.low[loop], given.high[loop]
    Z = given.factors.measurement[loop, None]
    if growth.part[fixed] > growth.part[moving]:
        fixed, moving, Z = moving, fixed, manifold.inverse(Z)
    wanted = manifold.compose(growth.poses[fixed, None], Z)
    motion = manifold.compose(wanted, manifold.inverse(growth.poses[moving, None]))
    part = growth.part == growth.part[moving]
    growth.poses = growth.poses.copy()
    growth.poses[part] = manifold.compose(
        np.broadcast_to(motion, growth.poses[part].shape), growth.poses[part])
    growth.accepted[group] = True
    growth.solve()


def cut_and_joined(growth: Growth, step: int) -> Growth | None:
    """
    Return the state after the rounds that follow the cut of a step, None: it falls apart.

    Its sides are joined by loops of two places or a long run, else by those accepted before.
    """
    state, span = growth.copy(), growth.given.spanning(step)
    state.cut[step] = True
    state.drops[:] = 0
    kept = state.copy()
    is_spanned = (state.accepted & span).any()
    if is_spanned:
        state.accepted[span] = state.given.trusted[span]
        state.solve()
    else:  # neither side changes
        state.label_parts()
    if not join(state) or state.across()[step]:
        if is_spanned:
            kept.solve()
        if not is_spanned or kept.across()[step]:
            return None
        state = kept
    state.accept_more()
    if not (state.accepted & ~growth.accepted).any():
        state.learn_noise_anew()  # the slip was part of its estimate
    return state


def cut_at_loops(growth: Growth, steps: list[int], loops: list[int]) -> Growth | None:
    """
    Return the state after the rounds that follow the cut of steps, None: it falls apart.

    loops : for each step the one that joins its sides
    """
    state, given = growth.copy(), growth.given
    state.cut[steps] = True
    state.drops[:] = 0
    state.label_parts()
    for step, loop in zip(steps, loops, strict=True):
        if not state.across()[step]:
            span = given.spanning(step)
            state.accepted[span] = given.trusted[span]
            state.label_parts()
        if state.across()[loop]:
            _join_by(state, np.array([loop]))
    join(state)
    if (state.across() & state.cut & ~given.gap).any():
        return None
    state.accept_more()
    return state


def moved_to_likeliest(state: Growth, motion: Motion) -> Growth:
    """Return the state with each cut where it leaves the robot the likeliest motion."""
    for cut in np.flatnonzero(state.cut & ~state.given.gap).tolist():
        step = _likeliest(state, cut, motion)
        if step != cut:
            state = _cut_at(state, cut, step)
    return state


def _likeliest(state: Growth, cut: int, motion: Motion) -> int:
    """Return the likeliest step to have slipped, by the motion, of those in series with a cut."""
    steps, side = _in_series(state, cut)
    gain = motion.log_density(*motion_repaired(state, cut, steps, side)) - motion.log_density(
        steps_of(state, steps))
    return int(steps[np.argmax(gain)])


def _in_series(state: Growth, cut: int) -> tuple[Indices, Indices]:
    """
    Return the steps in series with a cut: all ways between its sides lead along them, (k,).

    No loop distinguishes them. The first is the cut itself. And for each 1 or -1, whether the way
    runs along it forwards or backwards, 0 for the cut, (k,).
    """
    given = state.given
    start, end = int(given.low[cut]), int(given.high[cut])
    n = given.graph.n_poses + 1  # the world is the last
    holds = np.flatnonzero(state.accepted & ~state.cut)
    low, high = given.low[holds] % n, given.high[holds]
    before = parents(low, high, n, [start])
    way = [end]
    while way[-1] != start and before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    if way[-1] != start:
        return np.array([cut]), np.zeros(1, np.int64)
    one, other = np.array(way[:0:-1]), np.array(way[-2::-1])
    # Between the same keyframes the way takes the first factor.
    keys = pair_key(low, high, n)
    order = np.argsort(keys, kind='stable')
    along = order[np.searchsorted(keys[order], pair_key(one, other, n))]
    rest = np.ones(len(holds), bool)
    rest[along] = False
    # What else leads on from the way leads back to it further on, or nowhere.
    component = lowest_of_components(low[rest], high[rest], n)[np.append(one, end)]
    first, last = (np.full(n, fill) for fill in (n, -1))
    np.minimum.at(first, component, np.arange(len(component)))
    np.maximum.at(last, component, np.arange(len(component)))
    alone = (spanned(first[component], last[component], len(component)) == 0) & ~given.is_loop[
        holds[along]]
    return (np.append(cut, holds[along[alone]]), np.append(0, np.where(one < other, 1, -1)[alone]))


def _measured_end(state: Growth, cut: int) -> Array:
    """Return the pose after a cut by the measurement that is cut, (1, p)."""
    given, row = state.given, np.array([cut])
    end: Array = given.graph.manifold.compose(
        state.poses[given.low[row]], given.factors.measurement[row])
    return end


def _cut_at(state: Growth, cut: int, step: int) -> Growth:
    """Return the state with a cut moved to another step."""
    state, given = state.copy(), state.given
    state.cut[[cut, step]] = False, True
    holds = state.accepted & ~state.cut
    holds[cut] = False
    part = component_labels(given.graph.subset(holds))
    beyond = part == part[given.high[cut]]
    manifold = given.graph.manifold
    motion = manifold.compose(
        _measured_end(state, cut), manifold.inverse(state.poses[[given.high[cut]]]))
    state.poses = state.poses.copy()
    state.poses[beyond] = manifold.compose(
        np.repeat(motion, np.count_nonzero(beyond), axis=0), state.poses[beyond])
    state.solve()
    state.accept_more()
    return state


def unusual(state: Growth, motion: Motion) -> Indices:
    """
    Return the cut steps that leave the robot a motion unlike any other, (k,).

    And no likelier one than was measured: a slip is as rare as an error that many loops share, so
    the odds between the two are those of the motion that each leaves.
    """
    gate = state.given.gate(np.array([len(motion.mean)]))[0]
    # With the estimated noise, or with the stated one.
    said = state.noise.said[0]
    found = []
    for cut in np.flatnonzero(state.cut & ~state.given.gap).tolist():
        row = np.array([cut])
        repaired, spread = motion_repaired(state, cut, row, np.zeros(1, np.int64))
        density = max(motion.log_density(repaired, noise * spread)[0] for noise in (1.0, said))
        if (motion.distance(repaired[0], spread[0]).min() >= gate
                and density <= motion.log_density(steps_of(state, row))[0]):
            found.append(cut)
    return np.array(found, np.int64)


def motion_repaired(state: Growth, cut: int, steps: Indices, side: Indices) -> tuple[Array, Array]:
    """
    Return the motion at each of some steps if that one slipped in place of the one that is cut.

    Tangents (m, k) and their covariances (m, k, k). steps, side : (m,), see `_in_series`
    """
    given, poses = state.given, state.poses
    manifold = given.graph.manifold
    measured, row = state.uncut(), np.array([cut])
    root, spread = unwhitening(measured, row), measured.innovations(row).spread
    count, side = len(steps), side[:, None]
    high = np.repeat(poses[given.high[row]], count, axis=0)
    back = np.repeat(_measured_end(state, cut), count, axis=0)
    after = manifold.between(np.where(side < 0, back, high), poses[given.high[steps]])
    moved = manifold.compose(manifold.between(
        poses[given.low[steps]], np.where(side > 0, back, high)), after)
    start = manifold.identity(count)
    carried = manifold.local_jacobian(start, moved) @ manifold.adjoint(
        manifold.inverse(after)) @ root
    return manifold.local(start, moved), carried @ spread @ carried.transpose(0, 2, 1)
