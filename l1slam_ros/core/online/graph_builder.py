# SPDX-License-Identifier: Apache-2.0
"""
How the graph grows: odometry samples and loop closures in, keyframes and factors out.

A loop closure names two times. It waits until odometry has reached both, is then carried to the
nearest keyframes by the raw odometry in between, and becomes a between factor. An absolute pose
names one, the other end of its factor is the world.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import (
    LEAST_VARIANCE,
    MOST_OF_ODOMETRY,
    MOST_VARIANCE,
    Mask,
    covariance_of,
    loop_identity,
    root_of_inverse,
)
from l1slam_ros.core.graph.factor_graph import WORLD, FactorGraph
from l1slam_ros.core.graph.growable_array import GrowingArray
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.keyframes import (
    KeyframeOptions,
    Motion,
    OdometryOptions,
    diagonal_covariance,
    reduced_covariance,
)
from l1slam_ros.core.online.notes import Notes
from l1slam_ros.core.online.odometry_stream import OdometryStream, Point
from l1slam_ros.core.online.odometry_track import OdometryTrack
from l1slam_ros.core.online.waiting_loops import (
    WaitingLoop,
    WaitingLoops,
    carried,
    loop_covariance,
    said,
)
from l1slam_ros.core.options import Options, option

# [rad/s] A robot that nobody saw may have turned so fast.
_UNSEEN_TURN = 1.0


@dataclass(frozen=True)
class LoopOptions(Options):
    """How loop closures are read."""

    covariance_source: str = option(
        'message', 'message: as stated, the model where that is unusable; model: the sigmas below',
        '', choices=('message', 'model'))
    sigma_translation: float = option(0.1, 'model: of the position', 'm', 1e-9, 1e6)
    sigma_rotation: float = option(0.05, 'model: of the heading', 'rad', 1e-9, 1e6)
    wait: float = option(
        10.0, 'how long a loop for times not yet seen waits, on the clock of the odometry', 's',
        0, 1e9)


@dataclass(frozen=True)
class GraphBuilderOptions(Options):
    """What makes keyframes and factors of messages."""

    keyframe: KeyframeOptions = KeyframeOptions()
    odometry: OdometryOptions = OdometryOptions()
    loop: LoopOptions = LoopOptions()


class GraphBuilder:
    """
    Grows a factor graph from messages.

    Parameters
    ----------
    manifold : what the poses live on
    options : see `GraphBuilderOptions`; may be replaced at any time
    verbatim : the messages are those of a graph: each is a measurement as it is stated, none a
        loop sent again or odometry that jumps

    Attributes
    ----------
    graph : the factor graph so far; loops enter it in `add_due_loops`
    notes : of messages that were not used, or otherwise than they say
    offset : (1, p) takes poses of the odometry frame to those kept here: the identity, until
        after `restore`, or when the odometry moves its frame, it goes on from where the robot was

    """

    def __init__(self, manifold: Manifold, options: GraphBuilderOptions, verbatim: bool = False):
        self.options = options
        self.graph = FactorGraph(manifold)
        self.notes = Notes()
        self._verbatim = verbatim
        self._stream = OdometryStream(manifold, self.notes)
        self._track = OdometryTrack(manifold)
        self._motion: Motion
        self._glued = True
        self.offset = manifold.identity(1)
        self._moved = self._resumed = False
        self._waiting = WaitingLoops()
        self._seen: set[bytes] = set()
        self._expired = GrowingArray((2,), np.int64)
        self._loop_stamps = GrowingArray((2,), np.int64)
        self._loop_rows = GrowingArray((), np.int64)

    @property
    def refused(self) -> Counter[str]:
        """Why messages were not used, cause -> count."""
        return self.notes.refused

    @property
    def stamps(self) -> Indices:
        """Stamps of the keyframes, (n,) [ns]."""
        return self._track.keyframe_stamps

    @property
    def odometry(self) -> Array:
        """Poses of the keyframes in the odometry frame, (n, p)."""
        return self._track.keyframe_poses

    @property
    def n_waiting(self) -> int:
        """How many loops are not in the graph yet, nor refused."""
        return len(self._waiting)

    @property
    def held(self) -> str:
        """Why the last sample is not used until the next one speaks for it; empty: it is used."""
        return self._stream.reason()

    @property
    def loop_stamps(self) -> tuple[Indices, Indices, Indices]:
        """
        Stamps (reference, end) [ns] of the loops in the graph, waiting and expired, (k, 2) each.

        Those in the graph are in the order of `loop_rows`, to which they stay tied.
        """
        return self._loop_stamps.view(), self._waiting.stamps(), self._expired.view()

    @property
    def loop_rows(self) -> Indices:
        """Which between factors of the graph are loops, (k,)."""
        return self._loop_rows.view()

    def add_odometry(self, sample: OdometrySample) -> bool:
        """
        Add one sample; return whether there is a new keyframe.

        A sample that its predecessor does not explain is held, see `odometry_stream`: the next
        one decides.

        Raises
        ------
        MessageError : `old_stamp`, the stamp is not after the last one; nothing is added.

        """
        if not self._glued and sample.stamp <= self._track.last:
            raise MessageError('old_stamp', f'odometry stamp {sample.stamp} ns is not after the '
                               f'last one, {self._track.last} ns')
        keyframes = [self._add(point) for point in self._stream.take(sample, self._verbatim)]
        return any(keyframes)

    def finish(self) -> None:
        """Use the last sample of all, if it is held for a pause alone; see `held`."""
        for point in self._stream.finish():
            self._add(point)

    def _add(self, point: Point) -> bool:
        """Add a sample of the robot's motion; return whether it made a keyframe."""
        if point.anew:
            self._forget()
        if not len(self._track):
            self._track.append(point.stamp, point.pose)
            self._begin_keyframe(point.stamp, point.pose)
            return True
        manifold, pose = self.graph.manifold, point.pose
        if not self._glued or point.unseen:
            self.offset = manifold.compose(self._track.last_pose, manifold.inverse(pose))
            self._glued = self._moved = True
        if self._moved:
            pose = manifold.compose(self.offset, pose)
        self._track.append(point.stamp, pose)
        if point.unseen:
            self._motion.add_unseen(point.sample, point.unseen, _UNSEEN_TURN * point.seconds)
        else:
            self._motion.add(point.sample, pose, self.options.odometry)
        # Where the frame has moved there is a keyframe: what is published goes by the last one.
        if not point.unseen and not self._motion.is_keyframe(self.options.keyframe):
            return False
        motion = self._motion
        covariance = motion.covariance(self.options.odometry, self._verbatim)
        self._note_bounds('odometry', point.stamp, motion.bounded, MOST_OF_ODOMETRY)
        self._begin_keyframe(point.stamp, pose)
        k = self.graph.n_poses - 1
        self.graph.append_between(np.array([k - 1]), np.array([k]), motion.pose,
                                  root_of_inverse(covariance[None]))
        return True

    def begin_anew(self) -> None:
        """Forget the only sample so far, a stray; of a restored map: let odometry begin again."""
        self._stream = OdometryStream(self.graph.manifold, self.notes, self._resumed)
        if self._resumed:
            self._glued = False
            return
        self._forget()

    def _forget(self) -> None:
        """Forget the only sample; loops that came may yet find odometry of their times."""
        self.graph = FactorGraph(self.graph.manifold)
        self._track = OdometryTrack(self.graph.manifold)
        self._waiting.forget_arrivals()

    def restore(self, graph: FactorGraph, stamps: Indices, poses: Array) -> None:
        """
        Take over a graph of an earlier run, its stamps (n,) [ns] and poses (n, p).

        The robot is taken to stand where that run ended; its odometry may begin anywhere. A loop
        of that run that is sent again is known where it named the stamps of keyframes: others
        were carried there and are not what was sent.
        """
        self.graph = graph
        self._track.extend_by_keyframes(stamps, poses)
        self._motion = Motion(graph.manifold, int(stamps[-1]), poses[-1:])
        self._glued, self._resumed = False, True
        self._stream = OdometryStream(graph.manifold, self.notes, resumed=True)
        factors = graph.between
        rows = np.flatnonzero(~factors.is_odometry)
        ends = stamps[factors.pairs[rows]]
        self._note_loops(rows, np.sort(ends, axis=1))
        covariances = covariance_of(factors.sqrt_information[rows])
        for (reference, stamp), row, covariance in zip(ends.tolist(), rows, covariances,
                                                       strict=True):
            self._seen.add(loop_identity(reference, stamp, factors.measurement[row], covariance,
                                       bool(factors.trusted[row])))

    def add_loop(self, loop: LoopClosure) -> None:
        """Take a loop closure or an absolute pose in, once; see `add_due_loops`."""
        covariance = self._loop_covariance(loop)
        if covariance is None:
            return
        measurement = said(self.graph.manifold, loop, covariance)
        key = loop_identity(*loop.stamps, measurement, covariance, loop.trusted)
        if key in self._seen and not self._verbatim:
            self._refuse('repeated', loop, 'was sent before; expected each loop once')
            return
        self._seen.add(key)
        arrival = self._track.last if len(self._track) else 0
        self._waiting.add(WaitingLoop(loop, arrival, measurement, covariance, key))

    def add_due_loops(self) -> int:
        """
        Make factors of the waiting loops whose times odometry has reached; return how many.

        Loops that can never become one are counted in `refused`: `before_start` (a time before
        the first odometry), `same_keyframe`, `expired`.
        """
        if not len(self._waiting) or not len(self._track):
            return 0
        now = self._track.last
        due = self._waiting.due(now)
        since = now - int(self.options.loop.wait * 1e9)
        for one in self._waiting.expired(since) if self._track.first < since else ():
            self._expired.extend(np.array([one.loop.stamps]))
            self._refuse('expired', one.loop, f'waited for odometry until {now} ns; expected '
                         'odometry of its times')
            # Sent again when odometry has come that far, it is welcome.
            self._seen.discard(one.key)
        return self._add_loops(due) if due else 0

    def _add_loops(self, due: list[WaitingLoop]) -> int:
        manifold = self.graph.manifold
        stamps = np.array([one.loop.stamps for one in due])
        known = self._track.known_until(np.array([one.arrival for one in due]), stamps[:, 1])
        i, j = (self._track.nearest_keyframe(end, known) for end in stamps.T)
        keep = self._can_be_factors([one.loop for one in due], i, j)
        if not keep.any():
            return 0
        used = [one for one, kept in zip(due, keep, strict=True) if kept]
        i, j, stamps = i[keep], j[keep], stamps[keep]
        to_reference = manifold.between(self.odometry[i], self._track.at(stamps[:, 0]))
        to_keyframe = manifold.between(self._track.at(stamps[:, 1]), self.odometry[j])
        measurement, covariance, sound = carried(manifold, used, to_reference, to_keyframe)
        covariance = np.where(sound[:, None, None], covariance, self._loop_model())
        i = np.where([one.loop.is_absolute for one in used], WORLD, i)
        self.graph.append_between(i, j, measurement, root_of_inverse(covariance),
                                  np.array([one.loop.trusted for one in used]))
        last = len(self.graph.between)
        self._note_loops(np.arange(last - len(used), last), stamps)
        return len(used)

    def _can_be_factors(self, loops: list[LoopClosure], i: Indices, j: Indices) -> Mask:
        """Return which loops between the keyframes i, j (m,) can be factors, and note the rest."""
        first = self._track.first
        early = np.array([loop.stamps[0] < first for loop in loops])
        same = (i == j) & ~early & ~np.array([loop.is_absolute for loop in loops])
        for row in np.flatnonzero(early | same).tolist():
            if early[row]:
                self._refuse('before_start', loops[row], 'begins before the odometry; expected '
                             f'times from {first} ns on')
            else:
                self._refuse('same_keyframe', loops[row], 'begins and ends at one keyframe; '
                             'expected two')
        can: Mask = ~(early | same)
        return can

    def _note_loops(self, rows: Indices, stamps: Indices) -> None:
        self._loop_rows.extend(rows)
        self._loop_stamps.extend(stamps)

    def _refuse(self, cause: str, loop: LoopClosure, why: str) -> None:
        what = 'an absolute pose at' if loop.is_absolute else f'a loop from {loop.stamps[0]} ns to'
        self.notes.refuse(cause, f'{what} {loop.stamp} ns {why}')

    def _note_bounds(self, what: str, stamp: int, bounded: list[tuple[float, float]],
                     most: float) -> None:
        for found, used in bounded:
            self.notes.warn(f'{what}_variance', f'variance {found:g} of {what} at {stamp} ns; '
                            f'expected {LEAST_VARIANCE:g} to {most:g}; {used:g} is used')

    def _loop_covariance(self, loop: LoopClosure) -> Array | None:
        """
        Return what a loop states, zeros for what it leaves unsaid, (1, d, d).

        Where that is no covariance, the model; there is none of absolute poses: None, refused.
        """
        stated = reduced_covariance(self.graph.manifold, loop.covariance[None])
        model, absolute = self._loop_model(), loop.is_absolute
        if self.options.loop.covariance_source == 'model' and not absolute:
            return model[None]
        used, bounded = loop_covariance(stated, None if absolute else model, self._verbatim)
        self._note_bounds('loop', loop.stamp, bounded, MOST_VARIANCE)
        if used is None:
            self._refuse('covariance', loop, f'has the variances {np.diagonal(stated[0])}; '
                         f'expected one above 0, to {MOST_VARIANCE:g}')
        return used

    def _loop_model(self) -> Array:
        options = self.options.loop
        return diagonal_covariance(
            self.graph.manifold, options.sigma_translation, options.sigma_rotation)

    def _begin_keyframe(self, stamp: int, pose: Array) -> None:
        self._track.mark_keyframe()
        self.graph.add_poses(1)
        self._motion = Motion(self.graph.manifold, stamp, pose)
