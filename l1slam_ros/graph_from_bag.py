# SPDX-License-Identifier: Apache-2.0
"""A bag -> a graph, grown by the code that the node grows with: live and offline see one graph."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core import se2
from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.growth import GraphGrowth, GrowthOptions
from l1slam_ros.core.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.io.bag import BagMessage, bag_summary, read_messages, read_note
from l1slam_ros.io.graph_bag import GRAPH_NOTE
from l1slam_ros.io.graph_file import GraphRecord
from l1slam_ros.io.messages import loop_closure, odometry_sample
from l1slam_ros.io.topics import DEFAULT_TOPICS, Topics

_ODOMETRY = 'nav_msgs/msg/Odometry'


def graph_from_bag(path: Path, options: GrowthOptions | None, topics: Topics) -> GraphRecord:
    """
    Grow a graph from the messages of a bag, damaged or not.

    Parameters
    ----------
    path : a rosbag2 directory, .mcap, .db3 or .bag
    options : what makes keyframes of messages; None: what the bag's note says, or the node's
        defaults
    topics : where to look

    Raises
    ------
    FileError : the bag cannot be read, there is no graph in it, or not the topics asked for.

    """
    growing = _Growing(options or _noted_options(path), topics)
    damage: list[str] = []
    for message in read_messages(path, topics.types(), damage.append):
        growing.take(message)
    record = growing.record('; '.join(damage))
    if record.graph.n_poses < 2:
        raise FileError(path, '; '.join([
            f'{record.graph.n_poses} keyframes from {topics.odometry}; expected 2 or more',
            *_alternatives(path, topics.odometry, _ODOMETRY), *record.skipped, *damage]))
    for topic in sorted(topics.types().keys() - DEFAULT_TOPICS.types().keys() - growing.seen):
        raise FileError(path, '; '.join([
            f'no messages on {topic}; expected {topics.types()[topic]}',
            *_alternatives(path, topic, topics.types()[topic]), *damage]))
    return record


class _Growing:
    """A graph that grows message by message, and what was refused on the way."""

    def __init__(self, options: GrowthOptions, topics: Topics):
        self._growth = GraphGrowth(se2, options)
        self._topics, self._types = topics, topics.types()
        self._refused: Counter[str] = Counter()
        self._base_frame = ''
        self.seen: set[str] = set()

    def take(self, message: BagMessage) -> None:
        """Use a message, or count why not."""
        self.seen.add(message.topic)
        try:
            if message.msgtype != self._types[message.topic]:
                raise MessageError('type', message.msgtype)
            if message.topic == self._topics.odometry:
                self._base_frame = self._base_frame or message.message.child_frame_id
                self._growth.add_odometry(odometry_sample(message.message))
            else:
                self._growth.add_loop(loop_closure(
                    message.message, self._base_frame, message.topic == self._topics.trusted))
        except MessageError as error:
            self._refused[error.cause] += 1
        except (AttributeError, TypeError, ValueError):
            # The bag defines the type otherwise: it is damaged there, or of another ROS.
            self._refused['fields'] += 1

    def record(self, damage: str) -> GraphRecord:
        """Return the graph that has grown; damage : of the bag."""
        growth = self._growth
        growth.add_due_loops()
        refused = self._refused + growth.refused
        skipped = [f'{count} messages refused: {cause}' for cause, count in refused.items()]
        if growth.n_waiting:
            skipped.append(f'{growth.n_waiting} loops name times after the last odometry')
        return GraphRecord(growth.graph, None, np.arange(growth.graph.n_poses), growth.stamps,
                           tuple(skipped), damage)


def _noted_options(path: Path) -> GrowthOptions:
    note = read_note(path)
    options = GrowthOptions()
    if note.get('keyframes') == GRAPH_NOTE['keyframes']:
        options = replace(options, keyframe=KeyframeOptions(0.0, 0.0, 0.0))
    if note.get('covariance') == GRAPH_NOTE['covariance']:
        options = replace(options, odometry=OdometryOptions(GRAPH_NOTE['covariance']))
    return options


def _alternatives(path: Path, topic: str, msgtype: str) -> list[str]:
    """Say on which other topics a bag has messages of a type; nothing where on none."""
    others = [t.name for t in bag_summary(path).topics if t.msgtype == msgtype and t.name != topic]
    return [f'{msgtype} is on {", ".join(others)}'] if others else []
