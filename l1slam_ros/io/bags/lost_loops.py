# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Warnings about loops of a bag that are not in its graph: refused, or on a topic that was not read.

A map without its loops is not a success, so the sentence names the topic of the loops.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from l1slam_ros.io.bags.reader import TopicSummary, bag_summary, read_messages
from l1slam_ros.io.bags.topics import (
    ABSOLUTE_TOPIC,
    FALSE_LOOP_TOPIC,
    ODOMETRY_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
)
from l1slam_ros.io.files import counted
from l1slam_ros.io.messages.front_ends import LOOP_TYPES

# Roughly the frame of a loop; what is wrong with it is reported when the topic is read.
_LOOP_FRAME = re.compile(r'.+@[0-9]+\.[0-9]+')
# Number of messages of a topic that are searched for such a frame.
_FIRST = 100


class LoopCount:
    """
    Counts the loops of a bag.

    Attributes
    ----------
    came, refused : topic -> number of loops, and of those that cannot be used

    """

    def __init__(self) -> None:
        self.came, self.refused = Counter[str](), Counter[str]()
        self._first = ''

    def refuse(self, topic: str, reason: str) -> None:
        """Count a loop that cannot be used."""
        self.refused[topic] += 1
        self._first = self._first or reason

    def only(self, topic: str) -> None:
        """Drop the counts of other topics."""
        for count in self.came, self.refused:
            for other in count.keys() - {topic}:
                del count[other]

    def sentences(self, lost: int, path: Path, read: Collection[str],
                  odometry: str) -> Iterator[str]:
        """
        Yield a sentence if most loops were lost, and one if there are loops that were not read.

        Parameters
        ----------
        lost : number of loops that are not in the graph for reasons that were not counted here
        path : the bag
        read : the topics that were read
        odometry : that of the odometry

        """
        came = self.came.total()
        lost = self.refused.total() + lost
        if 2 * lost > came:
            reason = f', the first: {self._first}' if self._first else ''
            yield (f'{lost:,} of {counted(came, "loop")} on {" and ".join(sorted(self.came))} '
                   f'did not get into the map{reason}')
        if lost >= came and (found := _unread(path, read, odometry)):
            there = ' and '.join(f'{counted(topic.count, "message")} on {topic.name}'
                                 for topic, _ in found)
            yield (f'no loop is in the map, but there are loops in {there}; expected '
                   f'{" or ".join(option for _, option in found)}')


def unused_scans(path: Path) -> list[str]:
    """Return a sentence on the laser scans of a bag, in which loops can be found; none: none."""
    scans = [topic for topic in bag_summary(path).topics
             if topic.msgtype == SCAN_TYPE and topic.count]
    there = ' and '.join(f'{counted(topic.count, "scan")} on {topic.name}' for topic in scans)
    options = ' or '.join(f'--scans {topic.name}' for topic in scans)
    return [f'no loop is in the map, but there are {there}; `l1slam solve` with {options} finds '
            'loops in them'] if scans else []


def _unread(path: Path, read: Collection[str],
            odometry: str) -> list[tuple[TopicSummary, str]]:
    """Return the topics with loops that were not read, and the options that would read them."""
    topics = bag_summary(path).topics
    others = [topic for topic in topics if topic.name not in read and topic.count]
    shaped = _with_loop_frames(path, {
        topic.name: min(topic.count, _FIRST) for topic in others if topic.msgtype == POSE_TYPE
        and topic.name not in (FALSE_LOOP_TOPIC, ABSOLUTE_TOPIC)})
    sources = [topic.name for topic in topics if topic.msgtype == ODOMETRY_TYPE]
    found = []
    for topic in others:
        if topic.name in shaped or topic.msgtype in LOOP_TYPES:
            nearest = max([odometry, *sources], key=lambda name: _shared(name, topic.name))
            beside = f' --odom-topic {nearest}' if nearest != odometry else ''
            found.append((topic, f'--loop-topic {topic.name}{beside}'))
    # First the loops of the robot whose odometry was read.
    return sorted(found, key=lambda one: -_shared(odometry, one[0].name))


def _shared(name: str, other: str) -> int:
    """Return the number of leading parts that two topics share, such as the name of a robot."""
    parts = list(zip(name.split('/')[:-1], other.split('/')[:-1], strict=False))
    return next((k for k, (a, b) in enumerate(parts) if a != b), len(parts))


def _with_loop_frames(path: Path, left: dict[str, int]) -> set[str]:
    """Return the topics with a loop among the first messages; left : number to read of each."""
    seen, shaped = Counter[str](), set[str]()
    for message in read_messages(path, left.keys(), lambda _: None) if left else ():
        # The bag may define the type otherwise.
        header = getattr(message.data, 'header', None)
        if _LOOP_FRAME.fullmatch(str(getattr(header, 'frame_id', ''))):
            shaped.add(message.topic)
        seen[message.topic] += 1
        if all(topic in shaped or seen[topic] >= count for topic, count in left.items()):
            break
    return shaped
