# SPDX-License-Identifier: Apache-2.0
"""Whose odometry it is: the first frame that a few messages agree on, not that of the first."""

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.measurements import OdometrySample
from l1slam_ros.io.files import quoted

# So many messages of one frame settle it: a stray message or two in the beginning do not.
_ENOUGH = 3


class BaseFrame:
    """
    Tells the robot's odometry from that of others by its `child_frame_id`.

    Parameters
    ----------
    name : the frame, when it is known; empty: that on which the first messages agree

    Attributes
    ----------
    name : the frame, empty as long as it is not settled

    """

    def __init__(self, name: str):
        self.name = name
        self._settled = bool(name)
        self._held: list[tuple[str, OdometrySample]] = []

    def take(self, frame: str, sample: OdometrySample
             ) -> tuple[list[OdometrySample], list[MessageError]]:
        """Return the samples of the robot that may be used now, and why others may not."""
        if self._settled:
            self.name = self.name or frame
            return self._sorted([(frame, sample)])
        self._held.append((frame, sample))
        votes = sum(name == frame for name, _ in self._held)
        return self.settle() if votes >= _ENOUGH else ([], [])

    def settle(self) -> tuple[list[OdometrySample], list[MessageError]]:
        """Choose by the messages that have come, as there are no more, and return those."""
        names = [name for name, _ in self._held if name]
        # Of equally many, the later: there is no way to know, but a stray comes first.
        self.name = self.name or max(reversed(names), key=names.count, default='')
        held, self._held, self._settled = self._held, [], True
        return self._sorted(held)

    def _sorted(self, samples: list[tuple[str, OdometrySample]]
                ) -> tuple[list[OdometrySample], list[MessageError]]:
        """Return the samples of the robot or of no frame, and an error for each of the others."""
        ours = [sample for frame, sample in samples if frame in (self.name, '')]
        others = [MessageError('child_frame', f'odometry of {quoted(frame)}; expected that of '
                               f'{quoted(self.name)}')
                  for frame, _ in samples if frame not in (self.name, '')]
        return ours, others
