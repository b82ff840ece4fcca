# SPDX-License-Identifier: Apache-2.0
"""
Which samples of the odometry are the robot's motion.

In: samples as they come. Out: those to be used, in order. A sample that its predecessor does not
explain is held until the next one speaks for it (goes on from it) or against it (goes on from
before); nothing that is held is used, nothing is dropped without being counted:

    child_frame   of another frame than the robot's
    stamp_ahead   a gap in time, and the next sample is back at the time before
    jump          a motion no robot makes, and the next sample is back where the robot was
    old_stamp     not after the sample before; also a first sample whose stamp was the stray

Where the next sample speaks for a motion no robot makes, the odometry has moved its frame: it
began at the identity again, or its source was exchanged. Where it speaks for an old stamp, the
clock was set back, or a bag is played again. The sample says so (`gap`).

Not told from motion: a frame moved by less than robots move (34 m within .1 s), unless it is to
the identity exactly and that is far; a restart at the identity nearer than half a metre.
"""

import math
from collections import deque
from collections.abc import Iterator

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.graph.measurements import (
    FASTEST,
    LONGEST_PAUSE,
    SHORTEST_STEP,
    Notes,
    OdometrySample,
)

# A restart at the identity is a step so many times the longest of the last few ...
_FAR, _RECENT = 5.0, 16
# ... and at least so far [m]: nearer, it bends the map by less than a keyframe.
_NEAR = 0.5
# [s] A clock that is set back is set back so far; messages that overtook each other are nearer.
_BACK = 0.5
# [s] After a longer gap a sample is held, which costs the robot nothing but a message's delay; it
# is confirmed by one within `LONGEST_PAUSE`, so that odometry of any rate passes.
_GAP = 2.0
# [m/s], [rad/s] A robot that nobody saw may have gone, and turned, so fast.
UNSEEN, UNSEEN_TURN = 1.0, 1.0
# [m], [rad] The identity, after its way through a quaternion.
_EXACT = 1e-9
# So much of a frame's name is quoted.
_QUOTED = 40


def is_identity(manifold: Manifold, pose: Array) -> bool:
    """Tell whether a pose (1, p) is where odometry begins."""
    return bool(abs(manifold.local(manifold.identity(1), pose)).max() < _EXACT)


class BaseFrame:
    """
    Tells the robot's odometry from that of others by its `child_frame_id`.

    The first sample is the robot's at once. If two of one other frame come before a second one
    of its own, it was a stray: those two are the robot's. What the user names is not doubted.

    Parameters
    ----------
    name : the frame, when it is known; empty: to be found out

    Attributes
    ----------
    name : the frame as far as is known, without a slash before it, as in tf2; samples without one
        go with any

    """

    def __init__(self, name: str):
        self.name = name.removeprefix('/')
        self._sure = bool(name)
        self._used = 0
        self._held: list[OdometrySample] = []

    def take(self, sample: OdometrySample, notes: Notes) -> list[OdometrySample]:
        """
        Return the robot's samples that may be used now: this one, none, or a held one and this.

        Two: what was used before was another's. notes : told of those

        Raises
        ------
        MessageError : `child_frame`, the sample is another's.

        """
        frame = _frame(sample)
        if frame and not self.name:
            self.name, self._sure = frame, self._used > 0
        elif frame == self.name:
            self._sure = True
        if frame in (self.name, ''):
            self._used += 1
            if self._sure:
                self.refuse_rest(notes)
            return [sample]
        if self._sure:
            raise self._error(frame)
        ours = [one for one in self._held if _frame(one) == frame] + [sample]
        if len(ours) == 1:
            self._held.append(sample)
            return []
        stray, self.name, self._sure = self.name, frame, True
        for _ in range(self._used):
            notes.refuse('child_frame', str(self._error(stray)))
        self.refuse_rest(notes)
        return ours

    def refuse_rest(self, notes: Notes) -> None:
        """Count what is held and another's: there is nothing to wait for any more."""
        for sample in self._held:
            if _frame(sample) != self.name:
                notes.refuse('child_frame', str(self._error(_frame(sample))))
        self._held = []

    def _error(self, frame: str) -> MessageError:
        return MessageError('child_frame', f'odometry of {frame[:_QUOTED]!r}; expected that of '
                            f'{self.name[:_QUOTED]!r}')


def _frame(sample: OdometrySample) -> str:
    return sample.frame.removeprefix('/')


class Point:
    """
    A sample, its pose (1, p) in the frame of its message, and its position [m].

    seconds : since the sample before; doubt : the cause it was held for, else empty; gap : why no
    motion is known from the sample before, else empty; unseen : how far the robot may have gone
    [m] meanwhile; anew : the only sample before it was a stray.
    """

    __slots__ = ('anew', 'doubt', 'gap', 'pose', 'position', 'sample', 'seconds', 'stamp',
                 'unseen')

    def __init__(self, manifold: Manifold, sample: OdometrySample):
        self.sample, self.stamp = sample, sample.stamp
        self.pose: Array = manifold.from_pose3(sample.pose3[None])
        self.position: list[float] = manifold.positions(self.pose)[0].tolist()
        self.doubt = self.gap = ''
        self.unseen, self.anew, self.seconds = 0.0, False, 0.0


class OdometryStream:
    """
    Passes samples on, holding one at most.

    Parameters
    ----------
    manifold : what the poses live on
    notes : told of all that is dropped or moved
    base_frame : tells whose samples they are
    resumed : a map is there already, which no stamp makes begin anew

    Attributes
    ----------
    last : the last sample that was passed on
    held : the one that is not yet

    """

    def __init__(self, manifold: Manifold, notes: Notes, base_frame: BaseFrame,
                 resumed: bool = False):
        self._manifold, self._notes, self._resumed = manifold, notes, resumed
        self._base_frame = base_frame
        self.last: Point | None = None
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._alone = False
        self.held: Point | None = None

    def take(self, sample: OdometrySample, verbatim: bool, back: bool = False
             ) -> Iterator[Point]:
        """
        Yield the samples that may be used now: this one, none, or a held one and this.

        verbatim : none is to be doubted; back : time may go back

        Raises
        ------
        MessageError : `child_frame`, it is another's; `old_stamp`, the stamp is not after the last
            one, and time did not go back.

        """
        ours = self._base_frame.take(sample, self._notes)
        stray = len(ours) > 1
        if stray:  # what was used before
            self.last = self.held = None
            self._recent.clear()
        for one in ours:
            point = Point(self._manifold, one)
            point.anew, stray = stray, False
            yield from self._taken(point, verbatim, back)

    def _taken(self, point: Point, verbatim: bool, back: bool) -> list[Point]:
        """Return what may be used now that the robot's next sample is here; see `take`."""
        last, held = self.last, self.held
        if last is None:
            used = self._used(point)
            self._alone = not self._resumed
            return used
        if held is not None and self._goes_on(last, held, point):
            self.held = None
            held.anew = held.doubt == 'old_stamp' and self._alone
            if held.doubt != 'stamp_ahead' and not held.anew:
                held.gap = self._why(last, held)
                held.unseen = max((UNSEEN * (held.stamp - last.stamp) * 1e-9, *self._recent))
            return self._used(held) + self._used(point)
        point.doubt = self._doubt(last, point)
        if verbatim and point.doubt != 'old_stamp':
            return self._used(point)
        again = held is not None and point.stamp == held.stamp
        known_back = (back and not verbatim) or self._may_begin_anew(last, point)
        if again or (point.doubt == 'old_stamp' and not (
                known_back and (last.stamp - point.stamp) * 1e-9 >= _BACK)):
            known = held.stamp if again and held is not None else last.stamp
            raise MessageError('old_stamp', f'odometry stamp {point.stamp} ns is not after the '
                               f'last one, {known} ns')
        if held is not None:
            self._notes.refuse(held.doubt, self._why(last, held))
        self.held = point if point.doubt else None
        return [] if point.doubt else self._used(point)

    def finish(self) -> list[Point]:
        """Return, as no more will come, what is held if it came after no more than a pause."""
        self._base_frame.refuse_rest(self._notes)
        last, held = self.last, self.held
        if last is None or held is None or held.doubt != 'stamp_ahead' or (
                (held.stamp - last.stamp) * 1e-9 > LONGEST_PAUSE):
            return []
        self.held = None
        return self._used(held)

    def reason(self) -> str:
        """Return why a sample is held; empty: none is."""
        if self.held is None or self.last is None:
            return ''
        return self._why(self.last, self.held)

    def _used(self, point: Point) -> list[Point]:
        last, self.last, self._alone = self.last, point, False
        if last is not None and point.anew:
            self._notes.refuse('stamp_ahead', f'first odometry stamp {last.stamp} ns; expected '
                               f'one before that of the next, {point.stamp} ns')
        elif last is not None:
            point.seconds = (point.stamp - last.stamp) * 1e-9
            if not point.gap:
                self._recent.append(math.dist(last.position, point.position))
        return [point]

    def _doubt(self, last: Point, point: Point) -> str:
        """Return the cause for which a sample after `last` is to be doubted; empty: none."""
        seconds = (point.stamp - last.stamp) * 1e-9
        if seconds <= 0:
            return 'old_stamp'
        length = math.dist(last.position, point.position)
        if length > FASTEST * max(seconds, SHORTEST_STEP):
            return 'jump'
        if length > _NEAR and length > _FAR * max(self._recent, default=0.0) and (
                is_identity(self._manifold, point.pose)):
            return 'jump'
        return 'stamp_ahead' if seconds > _GAP else ''

    def _goes_on(self, last: Point, held: Point, point: Point) -> bool:
        """Tell whether a sample speaks for the one that is held."""
        if held.doubt == 'old_stamp' and point.stamp > last.stamp:
            return False
        doubt = self._doubt(held, point)
        slow = doubt == 'stamp_ahead' and (point.stamp - held.stamp) * 1e-9 <= LONGEST_PAUSE
        if doubt and not slow:
            return False
        return held.doubt != 'jump' or (math.dist(held.position, point.position)
                                        <= math.dist(last.position, point.position))

    def _may_begin_anew(self, last: Point, point: Point) -> bool:
        """Tell whether the only sample so far may be a stray, its stamp far ahead of all."""
        return self._alone and (last.stamp - point.stamp) * 1e-9 > LONGEST_PAUSE

    def _why(self, last: Point, held: Point) -> str:
        seconds = (held.stamp - last.stamp) * 1e-9
        if held.doubt == 'jump':
            length = math.dist(last.position, held.position)
            return (f'odometry {length:.6g} m from one message to the next, {seconds:.6g} s '
                    f'later, at stamp {held.stamp} ns; expected a motion that robots make')
        if held.doubt == 'old_stamp':
            return (f'odometry stamp {held.stamp} ns is not after the last one, {last.stamp} ns')
        return (f'odometry stamp {held.stamp} ns is {seconds:.6g} s after the one before; '
                'expected the next one to go on from there')
