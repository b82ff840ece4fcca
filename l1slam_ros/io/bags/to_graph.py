# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Building a graph from a bag with the code of the node, so that live and offline graphs are equal.

If the topic of the loops has pose graphs of another front end, their loops are taken; if that of
the odometry has, the whole graph.

This module also reads true poses from a topic.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import (
    KeyframeOptions,
    OdometryOptions,
)
from l1slam_ros.core.online.options import GraphBuilderOptions
from l1slam_ros.io.bags.bag_files import files_of
from l1slam_ros.io.bags.damaged.walk import BagMessage
from l1slam_ros.io.bags.foreign_topics import Foreign, foreign_graph
from l1slam_ros.io.bags.from_graph import (
    GRAPH_NOTE,
    LEFT_OUT,
    SPACE_NOTE,
    TURNED_LOOPS,
    TURNED_STEPS,
    VERBATIM_NOTE,
)
from l1slam_ros.io.bags.lost_loops import LoopCount, unused_scans
from l1slam_ros.io.bags.reader import bag_summary, read_messages, read_note
from l1slam_ros.io.bags.topics import (
    ABSOLUTE_TOPIC,
    DEFAULT_TOPICS,
    LOOP_TOPIC,
    ODOMETRY_TYPE,
    REJECTED_LOOP_TOPIC,
    TRUSTED_LOOP_TOPIC,
    Topics,
)
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.graphs.left_out import SLIP, nothing_left_out
from l1slam_ros.io.messages import conversion
from l1slam_ros.io.messages.front_ends import LOOP_TYPES
from l1slam_ros.io.trajectory import Reference

_EVERY = KeyframeOptions(0.0, 0.0, 0.0)
# Possible types of a topic with true poses.
_POSES = ('geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PoseWithCovarianceStamped',
          'geometry_msgs/msg/TransformStamped', 'nav_msgs/msg/Odometry')


def graph_from_bag(path: Path, options: GraphBuilderOptions | None, topics: Topics,
                   dimension: int = 2, more: Sequence[Path] = ()) -> GraphRecord:
    """
    Build a graph from the messages of a bag, damaged or not.

    Parameters
    ----------
    path : a rosbag2 directory, .mcap, .db3 or .bag
    options : how messages become keyframes; None: the node's defaults. A note in the bag replaces
        values that are defaults
    topics : of the odometry and the loops
    dimension : of the poses, 2 or 3; a note in the bag that says 3 comes first
    more : further bags of the same drive, see `drives`; errors name the first bag

    Raises
    ------
    FileError : the bag cannot be read, holds no graph, or does not have the topics.

    """
    note = read_note(path)
    in_space = dimension == 3 or note.get('dimension') == SPACE_NOTE['dimension']
    options = _noted_options(options or GraphBuilderOptions(), note)
    topics, foreign = foreign_graph((path, *more), topics)
    growing = _Growing(se3 if in_space else se2, options, topics, foreign,
                       note.get('messages') == VERBATIM_NOTE['messages'])
    damage: list[str] = []
    read = topics.types() | (foreign.topics if foreign else {})
    for message in read_messages(path, read, damage.append, more):
        growing.take(message)
    record = growing.record('; '.join(damage))
    # The note counts messages. Of several files a damaged one leaves a gap, and the count is off.
    counted_all = not damage or not more and len(files_of(path)[0]) == 1
    if options.keyframe == _EVERY and counted_all:
        record = replace(record, graph=turned(record.graph, _noted_turns(record.graph, note)),
                         left_out=_noted_left_out(record.graph, note))
    if record.graph.n_poses < 2:
        raise FileError(path, '; '.join([
            f'{counted(record.graph.n_poses, "keyframe")} from {topics.odometry}; '
            'expected 2 or more',
            *_alternatives(path, topics.odometry, ODOMETRY_TYPE, *LOOP_TYPES),
            *record.skipped, *damage]))
    lost = growing.lost(path)
    for topic in sorted(topics.types().keys() - DEFAULT_TOPICS.types().keys() - growing.seen):
        if topics.with_loops or not lost:
            raise FileError(path, '; '.join([
                f'no messages on {topic}; expected {topics.types()[topic]}',
                *_alternatives(path, topic, topics.types()[topic]), *damage]))
        lost = [f'no messages on {topic}', *lost]
    scans = unused_scans(path) if record.graph.between.is_odometry.all() else ()
    return replace(record, damage='; '.join([*damage, *lost]), skipped=(*record.skipped, *scans))


class _Growing:
    """A graph that grows message by message."""

    def __init__(self, manifold: Manifold, options: GraphBuilderOptions, topics: Topics,
                 foreign: Foreign | None, verbatim: bool):
        self._builder = GraphBuilder(manifold, options, verbatim)
        self._topics = topics
        self._types = topics.types()
        self._map_frame = ''
        self._foreign = foreign
        self._graph = foreign.graph() if foreign else None
        self._loops = LoopCount()
        self.seen: set[str] = set()

    def take(self, message: BagMessage) -> None:
        """Add a message to the graph, or count it as refused with the reason."""
        topic = message.topic
        expected = self._types.get(message.topic, message.msgtype)
        self.seen.add(topic)
        try:
            if self._foreign and self._foreign.topics.get(topic) == message.msgtype:
                self._add_graph(message.data, topic)
                return
            if topic != self._topics.odometry and topic in (self._topics.loops,
                                                            TRUSTED_LOOP_TOPIC):
                self._loops.came[topic] += 1
            if message.msgtype != expected:
                raise MessageError('type', f'{message.msgtype} on {topic}; expected {expected}')
            elif topic == self._topics.odometry:
                self._builder.add_odometry(conversion.odometry_sample(message.data))
            else:
                is_loop = topic in (self._topics.loops, REJECTED_LOOP_TOPIC)
                name = LOOP_TOPIC if is_loop else topic
                self._builder.add_loop(conversion.loop_in(
                    name.removeprefix('/'), message.data, self._builder.robots[0].base_frame.name,
                    self._map_frame))
                if topic == ABSOLUTE_TOPIC:  # the first absolute pose names the map frame
                    self._map_frame = message.data.header.frame_id.removeprefix('/')
        except MessageError as error:
            self._refuse(topic, error.cause, str(error))
        except (AttributeError, TypeError, ValueError):
            # The bag has another definition of the type: it is damaged, or of another ROS.
            self._refuse(topic, 'fields',
                         f'a message on {topic}; expected the fields of {expected}')

    def _refuse(self, topic: str, cause: str, sentence: str) -> None:
        self._builder.notes.refuse(cause, sentence)
        if topic in self._loops.came:
            self._loops.refuse(topic, sentence)

    @property
    def _is_graph(self) -> bool:
        return self._foreign is not None and self._foreign.is_whole

    def _add_graph(self, message: Any, topic: str) -> None:
        assert self._foreign is not None and self._graph is not None
        for found in self._graph.take(message, topic):
            self._loops.came[self._foreign.main] += 1
            if not isinstance(found, LoopClosure):
                # A whole graph needs no stamps, and may have several robots.
                if not (self._is_graph and found.cause in ('keyframe', 'robot')):
                    self._refuse(self._foreign.main, found.cause, str(found))
            elif not self._is_graph:
                self._builder.add_loop(found)

    def lost(self, path: Path) -> list[str]:
        """Return sentences on the loops that are not in the graph, if these are most."""
        loops, odometry = self._builder.loops, self._topics.odometry
        if self._is_graph:  # it has nothing from other topics
            self._loops.only(odometry)
            return list(self._loops.sentences(0, path, {odometry}, odometry))
        late = sum(not (one.loop.struck or one.loop.is_absolute) for one in loops.waiting.all())
        return list(self._loops.sentences(loops.lost + late, path, self._types, odometry))

    def record(self, damage: str) -> GraphRecord:
        """Return the graph; damage : a sentence on the bag, or empty."""
        builder = self._builder
        if self._is_graph and self._graph is not None:
            graph, ids = self._graph.graph(builder.graph.manifold, builder.options)
            return GraphRecord(graph, None, ids, None,
                               (*builder.notes.sentences(), *self._graph.sentences()), damage)
        builder.finish()
        builder.add_due_loops()
        skipped = builder.notes.sentences()
        if (stream := builder.robots[0].stream).held:
            skipped.append(f'the last message is not used: {stream.reason()}')
        if waiting := len(builder.loops.waiting):
            skipped.append(f'{counted(waiting, "loop")} not used: the odometry ends before '
                           f'{"its" if waiting == 1 else "their"} times')
        return GraphRecord(builder.graph, None, np.arange(builder.graph.n_poses),
                           builder.keyframe_stamps, tuple(skipped), damage)


def read_truth_topic(path: Path, topic: str, manifold: Manifold = se2) -> Reference:
    """
    Return the true poses on a topic by ascending stamps; of equal stamps the first pose.

    Raises
    ------
    FileError : the bag cannot be read, or has no poses on the topic.

    """
    damage: list[str] = []
    refused: Counter[str] = Counter()
    pose_at: dict[int, Array] = {}
    for message in read_messages(path, [topic], damage.append):
        if message.msgtype not in _POSES:
            raise FileError(path, f'{topic} is of {message.msgtype}; expected one of '
                            f'{", ".join(_POSES)}')
        try:
            stamp, pose3 = conversion.stamped_pose(message.data)
            pose_at.setdefault(stamp, pose3)
        except MessageError as error:
            refused[error.cause] += 1
    skipped = [f'{counted(count, "message")} on {topic} of {path} refused: {cause}'
               for cause, count in refused.items()]
    if not pose_at:
        raise FileError(path, '; '.join([f'no poses on {topic}; expected true poses',
                                         *_alternatives(path, topic, *_POSES), *skipped, *damage]))
    stamps = np.array(sorted(pose_at), np.int64)
    poses = manifold.from_pose3(np.array([pose_at[stamp] for stamp in stamps.tolist()]))
    return Reference(stamps, poses, stamped=True, skipped=(*skipped, *damage))


def _noted_options(options: GraphBuilderOptions, note: dict[str, str]) -> GraphBuilderOptions:
    """Return the options with their defaults replaced by what the note says."""
    every, source = GRAPH_NOTE['keyframes'], GRAPH_NOTE['covariance']
    if note.get('keyframes') == every and options.keyframe == KeyframeOptions():
        options = replace(options, keyframe=_EVERY)
    if note.get('covariance') == source and options.odometry == OdometryOptions():
        options = replace(options, odometry=OdometryOptions(source))
    return options


def _noted_turns(graph: FactorGraph, note: dict[str, str]) -> Mask:
    """Return which factors were inverted when the bag was written, (m,) bool."""
    odometry = graph.between.is_odometry
    turns = np.zeros(len(odometry), bool)
    for name, kind in (TURNED_STEPS, odometry), (TURNED_LOOPS, ~odometry):
        turns[_noted_rows(np.flatnonzero(kind), note, name)] = True
    return turns


def _noted_left_out(graph: FactorGraph, note: dict[str, str]) -> np.ndarray:
    """Return for each factor why the map does not use it, (m,) of `left_out`."""
    odometry = graph.between.is_odometry
    words = nothing_left_out(len(odometry))
    for word, name in LEFT_OUT.items():
        kind = odometry if word == SLIP else ~odometry
        words[_noted_rows(np.flatnonzero(kind), note, name)] = word
    return words


def _noted_rows(rows: Indices, note: dict[str, str], name: str) -> Indices:
    """Return the rows whose numbers are in a note; those a damaged bag has lost are skipped."""
    numbers = [int(word) for word in note.get(name, '').split() if word.isdecimal()]
    return rows[[number for number in numbers if number < len(rows)]]


def _alternatives(path: Path, topic: str, *msgtypes: str) -> list[str]:
    """Return a clause for each of some types that names the other topics with it."""
    others = [(t.msgtype, t.name) for t in bag_summary(path).topics if t.name != topic]
    return [f'{msgtype} is on {", ".join(name for found, name in others if found == msgtype)}'
            for msgtype in msgtypes if msgtype in dict(others)]
