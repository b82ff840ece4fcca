# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Finding the topics of a bag with the pose graph of another front end, such as slam_toolbox."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from l1slam_ros.io.bags.reader import bag_summary
from l1slam_ros.io.bags.topics import DEFAULT_TOPICS, Topics
from l1slam_ros.io.messages.edge_graph import EdgeGraph
from l1slam_ros.io.messages.front_ends import FRONT_ENDS, FrontEnd, front_end_of


@dataclass(frozen=True)
class Foreign:
    """
    The topics of a front end's graph with their types, and `main`, by which messages name it.

    is_whole : the whole graph is taken, not only its loops.
    """

    graph: type[EdgeGraph]
    topics: dict[str, str]
    main: str
    is_whole: bool


def foreign_graph(paths: Sequence[Path], topics: Topics) -> tuple[Topics, Foreign | None]:
    """
    Return the topics to read, and the graph of another front end if they have one.

    If the bags, all of one drive, have no messages on the default topic of the odometry, but those
    of exactly one front end whose messages include its odometry, that graph is read, with all its
    robots.
    """
    types = {topic.name: topic.msgtype for path in paths for topic in bag_summary(path).topics
             if topic.count}
    for name, is_whole in (topics.odometry, True), (topics.loops, False):
        front_end = front_end_of(types.get(name, ''))
        if front_end is not None:
            return topics, Foreign(front_end.graph, _beside(name, types, front_end), name,
                                   is_whole)
    found = [one for one in FRONT_ENDS if one.is_found
             and one.loops_or_keyframes() & set(types.values())]
    if topics.odometry != DEFAULT_TOPICS.odometry or topics.odometry in types or len(found) != 1:
        return topics, None
    of_type = {name: kind for name, kind in types.items() if kind in found[0].topics.values()}
    main = min(name for name, kind in of_type.items() if kind in found[0].loops_or_keyframes())
    return replace(topics, odometry=main), Foreign(found[0].graph, of_type, main, True)


def _beside(main: str, types: dict[str, str], front_end: FrontEnd) -> dict[str, str]:
    """Return the topics of a front end that share the namespace of `main`, and their types."""
    space = main.rpartition('/')[0]
    return {name: kind for name, kind in types.items()
            if kind in front_end.topics.values() and name.rpartition('/')[0] == space}
