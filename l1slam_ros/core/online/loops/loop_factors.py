# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures -> factors.

A loop closure names two times. It waits until odometry has reached both, is then carried to the
nearest keyframes by the raw odometry in between, and becomes a between factor. An absolute pose
names one, the other end of its factor is the world.

A person may vouch for a loop or strike it out, before it comes or after: the last word counts.
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import noise
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.measurements import LoopClosure, Notes
from l1slam_ros.core.online.builder_state import LoopsState, key_of
from l1slam_ros.core.online.keyframes import diagonal_covariance, reduced_covariance
from l1slam_ros.core.online.loops.carried import carried
from l1slam_ros.core.online.loops.waiting_loops import WaitingLoop, WaitingLoops
from l1slam_ros.core.online.odometry.tracks import Tracks
from l1slam_ros.core.options import Options, option

# So many loops wait at most: nothing else bounds those for a robot that never comes, or is gone,
# since the time they wait is that of its own odometry.
_MOST_WAITING = 50_000
# The row of a loop that is no factor.
_NO_ROW = -1


@dataclass(frozen=True)
class LoopOptions(Options):
    """How loop closures are read."""

    covariance_source: str = option(
        'message', 'where the covariance of a loop comes from. message: from the message, or from '
        'the model if that covariance is unusable; model: from the two sigmas below', '',
        choices=('message', 'model'))
    sigma_translation: float = option(
        0.1, 'model: standard deviation of the position', 'm', 1e-9, 1e6)
    sigma_rotation: float = option(
        0.05, 'model: standard deviation of the heading', 'rad', 1e-9, 1e6)
    wait: float = option(
        10.0, 'how long a loop waits for odometry at its times, measured in odometry stamps; then '
        'it expires', 's', 0, 1e9)


class LoopFactors:
    """
    The loops on their way into a graph, and which of its factors they became.

    Parameters
    ----------
    manifold : what the poses live on
    notes : told of all that is not used
    verbatim : each is a measurement as it is stated, none a loop sent again

    Attributes
    ----------
    waiting : those that are not in the graph yet, nor refused
    lost : how many loops will never be in it; not what is sent again, absolute poses and strikes

    """

    def __init__(self, manifold: Manifold, notes: Notes, verbatim: bool):
        self._manifold = manifold
        self._notes = notes
        self._verbatim = verbatim
        self.waiting = WaitingLoops()
        self.lost = 0
        self.forget()

    def forget(self) -> None:
        """Begin with an empty graph; loops that wait may yet find odometry of their times."""
        # Their times of arrival are of another clock.
        self.waiting.forget_clocks()
        # The rows of the loops that came, by their identities, -1 until they are factors.
        self._row_of = {one.key: _NO_ROW for one in self.waiting.all() if not one.loop.struck}
        # Keyframes of the loops that are struck out, those to come too.
        self._struck: set[tuple[int, int]] = set()
        # Of the stamps of loops, reference and end, and of the robots of these.
        self._expired, self._expired_robots = (GrowingArray((2,), np.int64) for _ in range(2))
        self._stamps, self._robots = (GrowingArray((2,), np.int64) for _ in range(2))
        self._rows = GrowingArray((), np.int64)

    @property
    def stamps(self) -> tuple[Indices, Indices, Indices]:
        """
        Stamps (reference, end) [ns] of the loops in the graph, waiting and expired, (k, 2) each.

        Those in the graph are in the order of `rows`, to which they stay tied.
        """
        return self._stamps.view(), self.waiting.stamps(), self._expired.view()

    @property
    def robots(self) -> tuple[Indices, Indices, Indices]:
        """Whose times the `stamps` are."""
        return self._robots.view(), self.waiting.robots(), self._expired_robots.view()

    @property
    def rows(self) -> Indices:
        """Which between factors of the graph are loops, (k,)."""
        return self._rows.view()

    def state(self, tracks: Tracks) -> LoopsState:
        """Return the loops from which another run continues."""
        in_graph, _, expired = self.stamps
        own, _, of_expired = self.robots
        return LoopsState(
            self.rows, in_graph, own, expired, of_expired, self.waiting.arrivals(tracks.clocks),
            self._row_of.copy(), np.array(sorted(self._struck), np.int64).reshape(-1, 2))

    def restore(self, state: LoopsState, tracks: Tracks, options: LoopOptions) -> None:
        """Go on with the loops of an earlier run."""
        self._note(state.rows, state.stamps, state.robots)
        self._expired.extend(state.expired)
        self._expired_robots.extend(state.expired_robots)
        for loop, age in state.waiting:
            self.add(loop, tracks, options, age)
        self._row_of.update(state.seen)
        self._struck.update(map(tuple, state.struck_pairs.tolist()))

    def add(self, loop: LoopClosure, tracks: Tracks, options: LoopOptions,
            age: int = 0) -> None:
        """Take a loop closure or an absolute pose in, once, that came so long ago [ns]."""
        covariance = self._covariance(loop, options)
        if covariance is None:
            return
        measurement = _said(self._manifold, loop, covariance)
        robots = loop.robots
        key = key_of(noise.loop_identity(*loop.stamps, measurement, covariance), robots)
        # Of what a person says the last word counts, though it was said before.
        if not loop.struck:
            if key in self._row_of and not (loop.trusted or self._verbatim):
                self._refuse('repeated', loop, 'was sent before; expected each loop once')
                return
            self._row_of.setdefault(key, _NO_ROW)
        begin, end = map(tracks.time, robots, loop.stamps)
        first, last = (tracks.ago(robot, age) for robot in robots)
        self.waiting.add(
            WaitingLoop(loop, (first, last), begin, end, measurement, covariance, key))
        crowded = self.waiting.crowded(_MOST_WAITING)
        if crowded is not None:
            self._give_up(crowded, f'waited for odometry, as {_MOST_WAITING:,} others do, most of '
                          'them for the same robot; expected odometry of that robot')

    def add_due(self, graph: FactorGraph, tracks: Tracks, options: LoopOptions) -> int:
        """Make factors of the loops whose times odometry has reached; return how many."""
        if not len(self.waiting):
            return 0
        clocks = tracks.clocks
        due = self.waiting.due(clocks)
        for robot, now in clocks.items():
            since = now - int(options.wait * 1e9)
            track = tracks.of(robot)
            if track is not None and track.first < since:
                self._expire(robot, since, track.last_stamp)
        return self._add_due(due, graph, tracks, options) if due else 0

    def _expire(self, robot: int, since: int, stamp: int) -> None:
        """Give up what waits for a robot since before `since` [ns]; stamp : its last [ns]."""
        for one in self.waiting.expired(robot, since):
            self._give_up(one, f'waited for odometry until {stamp} ns; expected odometry of its '
                          'times')

    def _give_up(self, one: WaitingLoop, why: str) -> None:
        if not one.loop.struck:
            self._expired.extend(np.array([one.loop.stamps]))
            self._expired_robots.extend(np.array([one.loop.robots]))
        self._refuse('expired', one.loop, why)
        # A loop that is sent again once odometry has come that far is used.
        if self._row_of.get(one.key) == _NO_ROW:
            del self._row_of[one.key]

    def _add_due(self, due: list[WaitingLoop], graph: FactorGraph, tracks: Tracks,
                 options: LoopOptions) -> int:
        times, robots = _times(due)
        arrivals = np.array([one.arrivals for one in due])
        own = robots[:, 0] == robots[:, 1]
        # What one robot saw of itself was known with its later end.
        until = np.where(own[:, None], times[:, 1:], times)
        ends = tracks.of_each(robots.reshape(-1))
        known = ends.known_until(arrivals.reshape(-1), until.reshape(-1))
        pairs = ends.nearest_keyframe(times.reshape(-1), known).reshape(-1, 2)
        first = ends.first().reshape(-1, 2)
        can = np.flatnonzero(self._can_be_factors(due, pairs, first)).tolist()
        new: list[int] = []
        before, came = len(graph.between), len(self.rows)
        for k in can:
            # A person vouches for a loop that is in the graph already: there is no second factor.
            if not due[k].loop.struck and (
                    self._verbatim or self._row_of.get(due[k].key, _NO_ROW) == _NO_ROW):
                self._row_of[due[k].key] = before + len(new)
                new.append(k)
        if new:
            chosen = pairs if len(new) == len(pairs) else pairs[new]
            self._append([due[k] for k in new], chosen, graph, tracks, options)
        for k in can:
            # A word is of loops that came before it, though others become factors with them.
            self._say(due[k], (int(pairs[k, 0]), int(pairs[k, 1])), graph,
                      came + bisect_right(new, k))
        return len(new)

    def _append(self, loops: list[WaitingLoop], pairs: Indices, graph: FactorGraph,
                tracks: Tracks, options: LoopOptions) -> None:
        """Carry loops to the keyframes pairs (m, 2), and make factors of them."""
        manifold = self._manifold
        m = len(loops)
        # References first, then ends: to `ravel` columns lets go of the interpreter's lock.
        times, robots = (np.concatenate((column[:, 0], column[:, 1])) for column in _times(loops))
        ends = tracks.of_each(robots)
        at = ends.at(times)
        keyframes = ends.poses_of(np.concatenate((pairs[:, 0], pairs[:, 1])))
        ways = manifold.between(np.concatenate((keyframes[:m], at[m:])),
                                np.concatenate((at[:m], keyframes[m:])))
        unseen = ends.unseen(times)
        measurement, covariance, sound = carried(
            manifold, loops, ways[:m], ways[m:], unseen.reshape(2, m, 2))
        covariance = np.where(sound[:, None, None], covariance, self._model(options))
        i = np.where([one.loop.is_absolute for one in loops], WORLD, pairs[:, 0])
        graph.append_between(i, pairs[:, 1], measurement, noise.root_of_inverse(covariance),
                             np.array([one.loop.trusted for one in loops]))
        rows = len(graph.between) + np.arange(-m, 0)
        self._note(rows, np.array([one.loop.stamps for one in loops]), robots.reshape(2, m).T)

    def _say(self, one: WaitingLoop, pair: tuple[int, int], graph: FactorGraph,
             came: int) -> None:
        """Apply a person's word, `trusted` or `struck`; came : how many loops came, with this."""
        loop = one.loop
        if loop.struck:
            self._struck.add(pair)
            rows, stamps, robots = (
                column[:came] for column in (self.rows, self._stamps.view(), self._robots.view()))
            named = (stamps == loop.stamps).all(axis=1) & (robots == loop.robots).all(axis=1)
            factors = graph.between.pairs[rows]
            graph.say(rows[(factors == pair).all(axis=1) | (factors == pair[::-1]).all(axis=1)
                           | named], trusted=False)
        elif loop.trusted:
            self._struck.discard(pair)
            graph.say(np.array([self._row_of[one.key]]), trusted=True)
        elif pair in self._struck:
            graph.say(np.array([self._row_of[one.key]]), trusted=False)

    def _can_be_factors(self, loops: list[WaitingLoop], pairs: Indices, first: Indices) -> Mask:
        """
        Return which loops between keyframes (m, 2) can be factors, and note the rest.

        first : when the odometry of their robots begins, (m, 2) [ns]
        """
        early = np.logical_or(*(_times(loops)[0] < first).T)
        same = (pairs[:, 0] == pairs[:, 1]) & ~early & ~np.array(
            [one.loop.is_absolute for one in loops])
        for row in np.flatnonzero(early | same).tolist():
            if early[row]:
                self._refuse('before_start', loops[row].loop, 'begins before the odometry; '
                             f'expected times from {first[row, 0]} ns on')
            else:
                self._refuse('same_keyframe', loops[row].loop, 'begins and ends at one keyframe; '
                             'expected two')
        return ~(early | same)

    def _note(self, rows: Indices, stamps: Indices, robots: Indices) -> None:
        self._rows.extend(rows)
        self._stamps.extend(stamps)
        self._robots.extend(robots)

    def _refuse(self, cause: str, loop: LoopClosure, why: str) -> None:
        self.lost += not (loop.struck or loop.is_absolute or cause == 'repeated')
        kind = 'a strike' if loop.struck else 'a loop'
        what = 'an absolute pose at' if loop.is_absolute else f'{kind} from {loop.stamps[0]} ns to'
        self._notes.refuse(cause, f'{what} {loop.stamp} ns {why}')

    def _covariance(self, loop: LoopClosure, options: LoopOptions) -> Array | None:
        """
        Return the covariance that a loop states, zeros for components it leaves unsaid, (1, d, d).

        Where that is no covariance, the model; there is none of absolute poses: None, refused.
        """
        stated = reduced_covariance(self._manifold, loop.covariance[None])
        model = self._model(options)
        absolute = loop.is_absolute
        if options.covariance_source == 'model' and not absolute:
            return model[None]
        used, bounded = _loop_covariance(stated, None if absolute else model, self._verbatim)
        self._notes.warn_bounds('loop', loop.stamp, bounded, noise.MOST_VARIANCE)
        if used is None:
            self._refuse('covariance', loop, f'has the variances {np.diagonal(stated[0])}; '
                         f'expected one above 0, to {noise.MOST_VARIANCE:g}')
        return used

    def _model(self, options: LoopOptions) -> Array:
        return diagonal_covariance(
            self._manifold, options.sigma_translation, options.sigma_rotation)


def _times(loops: list[WaitingLoop]) -> tuple[Indices, Indices]:
    """Return the times of loops, and on whose clocks these are, (m, 2) each."""
    return (np.array([(one.begin, one.end) for one in loops]),
            np.array([one.loop.robots for one in loops]))


def _loop_covariance(stated: Array, model: Array | None,
                    verbatim: bool) -> tuple[Array | None, list[tuple[float, float]]]:
    """
    Return a covariance by what a loop states, (1, d, d), and variances found and used instead.

    Zeros stand for what is left unsaid. Where nothing can be used it is the model.

    Parameters
    ----------
    stated : (1, d, d) of a message
    model : (d, d); None for an absolute pose, there is no model of these: None is returned then
    verbatim : as stated, though its variances be none of a measurement

    """
    silent = noise.silent_components(stated, absolute=model is None)
    whole = noise.filled(stated, silent)
    asked = whole if verbatim else noise.without_unset(whole)
    if silent.all() or not noise.usable(asked)[0]:
        return None if model is None else model[None], []
    if verbatim:
        return noise.silenced(stated, silent), []
    least = noise.LEAST_VARIANCE * np.eye(len(whole[0]))
    used, bounded = noise.within_bounds(
        whole, least if model is None else model, noise.MOST_VARIANCE)
    return noise.silenced(used, silent), bounded


def _said(manifold: Manifold, loop: LoopClosure, covariance: Array) -> Array:
    """Return what a loop measures, (1, p), without a rotation that it leaves unsaid."""
    measurement = manifold.from_pose3(loop.pose3[None])
    if np.diagonal(covariance[0])[manifold.ROTATION].all():
        return measurement
    pose = manifold.local(manifold.identity(1), measurement)
    pose[:, manifold.ROTATION] = 0.0
    return manifold.retract(manifold.identity(1), pose)
