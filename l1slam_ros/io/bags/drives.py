# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Which bags are one drive: a recorder that was restarted begins another bag.

In: bags. Out: those of one robot that follow each other. Where odometry itself did not go on
between them, what reads them begins a new part.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from l1slam_ros.core.errors import MessageError
from l1slam_ros.core.graph.measurements import LONGEST_PAUSE
from l1slam_ros.io.bags.reader import read_messages, read_note
from l1slam_ros.io.bags.topics import ODOMETRY_TYPE, POSE_TYPE, Topics
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.messages.conversion import reference_stamp, stamp_of


@dataclass(frozen=True)
class _Extent:
    """
    What a bag says of its drive.

    frames : of the odometry; note : of the bag; first, last : stamps of the odometry [ns];
    references : the earlier times that its loops name [ns]
    """

    frames: tuple[str, str]
    note: dict[str, str]
    first: int
    last: int
    references: tuple[int, ...]

    def follows(self, first: '_Extent', last: '_Extent') -> bool:
        """Tell whether this bag is of the drive that begins and ends with two others."""
        pause = self.first - last.last
        return ((self.frames, self.note) == (last.frames, last.note) and pause > 0 and (
            pause <= LONGEST_PAUSE * NANOSECONDS
            or any(first.first <= time <= last.last for time in self.references)))


def drives(bags: Sequence[Path], topics: Topics) -> list[list[Path]]:
    """
    Return the bags of each drive in order of time, the drives in the order of their first bags.

    Bags are one drive if their odometry has the same frames, and each begins at most a minute
    after the one before ends, or has a loop to a time of those before.

    Raises
    ------
    FileError : a bag cannot be read.

    """
    extents = {bag: found for bag in bags if (found := _extent(bag, topics))}
    chains = [[bag] for bag in bags if bag not in extents]
    for bag in sorted(extents, key=lambda bag: extents[bag].first):
        chain = next((chain for chain in chains if chain[0] in extents and extents[bag].follows(
            extents[chain[0]], extents[chain[-1]])), None)
        if chain is None:
            chains.append([bag])
        else:
            chain.append(bag)
    return sorted(chains, key=lambda chain: min(map(list(bags).index, chain)))


def _extent(bag: Path, topics: Topics) -> _Extent | None:
    """Return the extent of a bag; None: it has no odometry."""
    frames = ('', '')
    stamps, references = list[int](), list[int]()
    wanted = {topics.odometry: ODOMETRY_TYPE, topics.loops: POSE_TYPE}
    for message in read_messages(bag, wanted, lambda _: None):
        if wanted[message.topic] != message.msgtype:
            continue
        try:
            header = message.data.header
            if message.msgtype == POSE_TYPE:
                references.append(reference_stamp(header.frame_id, ''))
            else:
                stamp = stamp_of(header)
                frames = frames if stamps else (header.frame_id, message.data.child_frame_id)
                stamps = [*stamps[:1], stamp]
        except (MessageError, AttributeError, TypeError, ValueError):
            continue  # it is counted when the bag is read
    if not stamps:
        return None
    return _Extent(frames, read_note(bag), stamps[0], stamps[-1], tuple(references))
