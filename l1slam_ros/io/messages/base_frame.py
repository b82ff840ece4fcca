# SPDX-License-Identifier: Apache-2.0
"""Whose odometry it is: that of the first message, unless that one proves to be a stray."""

from dataclasses import dataclass

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.io.files import quoted


@dataclass(frozen=True)
class Sorted:
    """
    The robot's samples that may be used now, and an error for each of another's.

    anew : the sample that was used before these was another's: the map is to begin anew
    """

    ours: tuple[OdometrySample, ...] = ()
    others: tuple[MessageError, ...] = ()
    anew: bool = False


class BaseFrame:
    """
    Tells the robot's odometry from that of others by its `child_frame_id`.

    The first message is the robot's at once. If two of one other frame come before a second one
    of its own, it was a stray: those two are the robot's. What the user names is not doubted.

    Parameters
    ----------
    name : the frame, when it is known; empty: to be found out

    Attributes
    ----------
    name : the frame as far as is known, without a slash before it, as in tf2; messages without one
        go with any

    """

    def __init__(self, name: str):
        self.name = name.removeprefix('/')
        self._sure = bool(name)
        self._used = 0
        self._held: list[tuple[str, OdometrySample]] = []

    def take(self, frame: str, sample: OdometrySample) -> Sorted:
        """Sort a sample, and those that are held."""
        frame = frame.removeprefix('/')
        if frame and not self.name:
            self.name, self._sure = frame, self._used > 0
        elif frame == self.name:
            self._sure = True
        if frame in (self.name, ''):
            self._used += 1
            return Sorted((sample,), self.rest() if self._sure else ())
        self._held.append((frame, sample))
        if self._sure:
            return Sorted((), self.rest())
        ours = tuple(held for name, held in self._held if name == frame)
        if len(ours) == 1:
            return Sorted()
        self._held = [(self.name, sample)] * self._used + [
            held for held in self._held if held[0] != frame]
        self.name, self._sure = frame, True
        return Sorted(ours, self.rest(), anew=True)

    def rest(self) -> tuple[MessageError, ...]:
        """Return an error for each sample that is held, of which none is the robot's."""
        errors = tuple(
            MessageError('child_frame', f'odometry of {quoted(frame)}; expected that of '
                         f'{quoted(self.name)}') for frame, _ in self._held)
        self._held = []
        return errors
