# SPDX-License-Identifier: Apache-2.0
"""What was found wrong with messages, and what was made of it: to be counted, logged, told."""

from collections import Counter

from l1slam_ros.core.geometry.noise import LEAST_VARIANCE


class Notes:
    """
    Per cause, how often it came and the first time in words.

    Attributes
    ----------
    refused : cause -> how many messages were not used for it
    warned : cause -> how many were used otherwise than they said

    """

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self.warned: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._unsaid: dict[str, str] = {}

    def refuse(self, cause: str, sentence: str) -> None:
        """Count a message that is not used; the sentence says what was found and expected."""
        self.refused[cause] += 1
        self._note(cause, sentence)

    def warn(self, cause: str, sentence: str) -> None:
        """Count a message that is used otherwise than it says; the sentence says how."""
        self.warned[cause] += 1
        self._note(cause, sentence)

    def tell(self, cause: str, sentence: str) -> None:
        """Count what makes another map of all that comes: it is news each time."""
        self.warn(cause, sentence)
        self._unsaid[cause] = sentence

    def warn_bounds(self, what: str, stamp: int, bounded: list[tuple[float, float]],
                    most: float) -> None:
        """Count variances that are used otherwise than stated: found and used."""
        for found, used in bounded:
            self.warn(f'{what}_variance', f'variance {found:g} of {what} at {stamp} ns; expected '
                      f'{LEAST_VARIANCE:g} to {most:g}; {used:g} is used')

    def news(self) -> list[str]:
        """Return a sentence of each cause that is new, or was told of, since the last call."""
        news, self._unsaid = self._unsaid, {}
        return list(news.values())

    def sentences(self) -> list[str]:
        """Return one sentence per cause: how often, and the first of them."""
        refused = [f'{count} message{"s" if count > 1 else ""} refused: {self._first[cause]}'
                   for cause, count in self.refused.items()]
        return refused + [self._first[cause] + (f' ({count} times in all)' if count > 1 else '')
                          for cause, count in self.warned.items()]

    def _note(self, cause: str, sentence: str) -> None:
        if cause not in self._first:
            self._first[cause] = self._unsaid[cause] = sentence
