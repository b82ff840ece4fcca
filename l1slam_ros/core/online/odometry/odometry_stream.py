# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which samples of the odometry are the robot's motion.

In: samples as they come. Out: those to be used, in order. A sample that its predecessor does not
explain (`plausibility`) is held until the next one speaks for it (goes on from it) or against it
(goes on from before); nothing that is held is used, nothing is dropped without being counted:

    child_frame   of another frame than the robot's
    stamp_ahead   a gap in time, and the next sample is back at the time before
    jump          a motion that is not the robot's, and the next sample is back where it was
    old_stamp     not after the sample before; also a first sample whose stamp was the stray

Where the next sample speaks for a motion that is not the robot's, the odometry has moved its
frame: it began again, or its source was exchanged. Where it speaks for an old stamp, the clock was
set back, or a bag is played again. The sample says so (`gap`). Where after a silence nobody can
tell, the next sample is waited for, too, and it says that (`unsure`). A sample that is a little
late is no clock that was set back: see `GraphBuilder`.

Not told from motion: a frame moved by less than the robot moves, or by less than half a metre
where nothing else says that the odometry began again.
"""

from collections.abc import Callable, Iterator

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.geometry.manifold import Manifold
from l1slam_ros.core.graph.measurements import LONGEST_PAUSE, Notes, OdometrySample
from l1slam_ros.core.online.odometry.plausibility import (
    UNSEEN,
    UNSEEN_TURN,
    Point,
    RecentMotion,
    Step,
)

# [s] A clock that is set back is set back so far; messages that overtook each other are nearer.
_BACK = 0.5
# [s] After a longer gap a sample is held, which costs the robot nothing but a message's delay; it
# is confirmed by one within `LONGEST_PAUSE`, so that odometry of any rate passes.
_GAP = 2.0
# [rad] A smaller turn is not told of.
_TOLD = 0.1
# The number of letters of a frame's name that are quoted.
_QUOTED = 40


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
            self.name = frame
            self._sure = self._used > 0
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
        stray = self.name
        self.name = frame
        self._sure = True
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
        self._manifold = manifold
        self._notes = notes
        self._resumed = resumed
        self._base_frame = base_frame
        self.last: Point | None = None
        self._recent = RecentMotion(manifold)
        self._alone = False
        self.held: Point | None = None

    def take(self, sample: OdometrySample, verbatim: bool, back: bool = False,
             put_in_place: Callable[[Point], bool] = lambda _: False) -> Iterator[Point]:
        """
        Yield the samples that may be used now: this one, none, or a held one and this.

        verbatim : none is to be doubted; back : time may go back; put_in_place : takes a sample
        that is late, or returns False: it is none

        Raises
        ------
        MessageError : `child_frame`, it is another's; `old_stamp`, the stamp is not after the last
            one, and time did not go back.

        """
        ours = self._base_frame.take(sample, self._notes)
        stray = len(ours) > 1
        if stray:  # what was used before
            self.last = self.held = None
            self._recent.forget()
        for one in ours:
            point = Point(self._manifold, one)
            point.anew = stray
            stray = False
            yield from self._taken(point, verbatim, back, put_in_place)

    def _taken(self, point: Point, verbatim: bool, back: bool,
               put_in_place: Callable[[Point], bool]) -> list[Point]:
        """Return what may be used now that the robot's next sample is here; see `take`."""
        last = self.last
        held = self.held
        how = (verbatim, back, put_in_place)
        if last is None:
            used = self._used(point)
            self._alone = not self._resumed
            return used
        if held is not None and self._goes_on(last, held, point):
            self.held = None
            held.anew = held.doubt == 'old_stamp' and self._alone
            if not held.anew:
                self._explain(last, held, Step(self._manifold, held, point))
            return self._used(held) + self._used(point)
        if held is not None and held.doubt == 'unsure' and last.stamp < point.stamp < held.stamp:
            self.held = None  # it came before, out of turn
            return [*self._taken(point, *how), *self._taken(held, *how)]
        point.doubt = self._doubt(last, point)
        if verbatim and point.doubt != 'old_stamp':
            return self._used(point)
        if point.doubt == 'old_stamp' and put_in_place(point):
            return []
        again = held is not None and point.stamp == held.stamp
        known_back = (back and not verbatim) or self._may_begin_anew(last, point)
        if again or (point.doubt == 'old_stamp' and not (
                known_back and (last.stamp - point.stamp) * 1e-9 >= _BACK)):
            known = held.stamp if again and held is not None else last.stamp
            raise MessageError('old_stamp', f'odometry stamp {point.stamp} ns is not after the '
                               f'last one, {known} ns')
        self.held = None
        if held is not None and held.doubt == 'unsure':  # nothing says that it is a stray
            self._explain(last, held, None)
            return self._used(held) + self._taken(point, *how)
        if held is not None:
            self._notes.refuse(held.doubt, self._why(last, held))
        self.held = point if point.doubt else None
        return [] if point.doubt else self._used(point)

    def finish(self) -> list[Point]:
        """Return, as no more will come, what is held if it came after no more than a pause."""
        self._base_frame.refuse_rest(self._notes)
        last, held = self.last, self.held
        if last is None or held is None or held.doubt not in ('stamp_ahead', 'unsure') or (
                (held.stamp - last.stamp) * 1e-9 > LONGEST_PAUSE):
            return []
        self.held = None
        self._explain(last, held, None)
        return self._used(held)

    def reason(self) -> str:
        """Return why a sample is held; empty: none is."""
        if self.held is None or self.last is None:
            return ''
        return self._why(self.last, self.held)

    def _used(self, point: Point) -> list[Point]:
        last = self.last
        self.last = point
        self._alone = False
        if last is not None and point.anew:
            self._notes.refuse('stamp_ahead', f'first odometry stamp {last.stamp} ns; expected '
                               f'one before that of the next, {point.stamp} ns')
        elif last is not None:
            step = Step(self._manifold, last, point)
            point.seconds = step.seconds
            point.reach = self._recent.reach(step, bool(point.gap))
            if not point.gap:
                self._recent.hear(step)
            if point.unsure:  # it is not known where between the two either
                point.reach = point.unseen, UNSEEN_TURN * step.seconds
            elif not point.gap:
                self._recent.add(step)
        return [point]

    def _explain(self, last: Point, held: Point, after: Step | None) -> None:
        """Tell what is not known of the motion to a held sample that is used now."""
        step = Step(self._manifold, last, held)
        recent = self._recent
        if held.doubt == 'old_stamp' or (
                held.doubt == 'jump' and recent.jumps(last, held, step, after)):
            held.gap = self._why(last, held)
            held.unseen = max(UNSEEN * step.seconds, recent.longest)
        elif unseen := recent.unsure(last, held, step, after):
            held.unsure = self._why(last, held, 'unsure')
            held.unseen = unseen

    def _doubt(self, last: Point, point: Point) -> str:
        """Return the cause for which a sample after `last` is to be doubted; empty: none."""
        if point.stamp <= last.stamp:
            return 'old_stamp'
        step = Step(self._manifold, last, point)
        if self._recent.jumps(last, point, step):
            return 'jump'
        if step.seconds > _GAP:
            return 'stamp_ahead'
        return 'unsure' if self._recent.unsure(last, point, step) else ''

    def _goes_on(self, last: Point, held: Point, point: Point) -> bool:
        """Tell whether a sample continues the motion of the held one, and so confirms it."""
        if point.stamp <= held.stamp or (held.doubt == 'old_stamp' and point.stamp > last.stamp):
            return False
        after = Step(self._manifold, held, point)
        if held.doubt == 'old_stamp':  # maybe another recording
            return after.is_possible and after.seconds <= LONGEST_PAUSE
        if held.doubt == 'jump':
            back = Step(self._manifold, last, point)
            if after.metres + after.radians > back.metres + back.radians:
                return False
            if after.is_possible and not self._recent.jumps(
                    last, held, Step(self._manifold, last, held), after):
                return True  # a robot that is faster now
        doubt = self._doubt(held, point)
        slow = doubt == 'stamp_ahead' and after.seconds <= LONGEST_PAUSE
        return slow or doubt in ('', 'unsure')

    def _may_begin_anew(self, last: Point, point: Point) -> bool:
        """Tell whether the only sample so far may be a stray, its stamp far ahead of all."""
        return self._alone and (last.stamp - point.stamp) * 1e-9 > LONGEST_PAUSE

    def _why(self, last: Point, held: Point, doubt: str = '') -> str:
        step = Step(self._manifold, last, held)
        doubt = doubt or held.doubt
        if doubt in ('jump', 'unsure'):
            expected = 'a motion that robots make' if doubt == 'jump' else (
                'a robot that moves on as before and after')
            turned = ''
            if step.is_possible and step.radians > _TOLD:
                turned = f' and {step.radians:.2g} rad'
            return (f'odometry {step.metres:.6g} m{turned} from one message to the next, '
                    f'{step.seconds:.6g} s later, at stamp {held.stamp} ns; expected {expected}')
        seconds = step.seconds
        if doubt == 'old_stamp':
            return (f'odometry stamp {held.stamp} ns is not after the last one, {last.stamp} ns')
        return (f'odometry stamp {held.stamp} ns is {seconds:.6g} s after the one before; '
                'expected the next one to go on from there')
