# SPDX-License-Identifier: Apache-2.0
"""How messages come on a topic: how many, how often, and how many never did."""

import time
from collections import deque
from collections.abc import Callable, Mapping

# [s] The rate is that of so long.
_WINDOW = 5.0


class Traffic:
    """
    The messages of one topic.

    Publishers number their messages, and the numbers come along. So whatever got lost on the way
    leaves a gap, also what a full queue has dropped: of that Fast DDS does not tell otherwise.
    The numbers do not say whose they are. With several publishers each message is taken to follow
    the nearest number before its own: who lost how many may be mixed up by that, the sum is not.

    Parameters
    ----------
    publishers : returns how many there are now

    """

    def __init__(self, publishers: Callable[[], int]):
        self.received = self.lost = 0
        self.publishers = publishers
        # The last number of each publisher, of who spoke last in front.
        self._numbers: list[int] = []
        self._marks = deque([(time.monotonic(), 0)])

    def note(self, information: Mapping[str, int | None]) -> None:
        """Count a message; information : what rclpy says about it."""
        self.received += 1
        number = information.get('publication_sequence_number')
        if number is None:
            return
        numbers = self._numbers
        if numbers and number == numbers[0] + 1:
            numbers[0] = number
            return
        before = [last for last in numbers if last < number]
        if number - 1 not in before and len(numbers) < self.publishers():
            before = []
        if before:
            nearest = max(before)
            numbers.remove(nearest)
            self.lost += number - nearest - 1
        numbers.insert(0, number)

    def values(self) -> dict[str, str]:
        """Return `received`, `rate` [1/s] and `lost`; to be called about once a second."""
        del self._numbers[max(self.publishers(), 1):]
        now = time.monotonic()
        self._marks.append((now, self.received))
        while len(self._marks) > 2 and now - self._marks[1][0] >= _WINDOW:
            self._marks.popleft()
        since, before = self._marks[0]
        rate = (self.received - before) / max(now - since, 1e-9)
        return {'received': str(self.received), 'rate': f'{rate:.1f}', 'lost': str(self.lost)}
