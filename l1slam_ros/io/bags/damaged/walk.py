# SPDX-License-Identifier: Apache-2.0
"""What the walks through bag files share: each yields messages from the start to the damage."""

from typing import Any, NamedTuple


class BagMessage(NamedTuple):
    """A message of a bag; time : when recorded [ns]; data : serialised (CDR), or decoded."""

    topic: str
    msgtype: str
    time: int
    data: Any


class BrokenRecordError(Exception):
    """The walk ends; `position` [bytes] is where in the file, or in the chunk."""

    def __init__(self, position: int):
        super().__init__(f'no readable record at byte {position}')
        self.position = position
