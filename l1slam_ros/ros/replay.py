# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
`replay`: plays a bag onto topics, paced by the times its messages were recorded.

Messages are published as the bytes they are in the bag; nothing is decoded.
"""

import argparse
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from l1slam_ros.core.errors import FileError, L1SlamError, OptionError
from l1slam_ros.io.bags.damaged.walk import BagMessage
from l1slam_ros.io.bags.reader import BagSummary, TopicSummary, bag_summary, read_raw
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.progress import Progress, say
from l1slam_ros.ros.shell.arguments import split
from l1slam_ros.ros.shell.header import header
from l1slam_ros.ros.threads.failures import reason

_BAD_INPUT = 2
_DAMAGED = 3
_DEPTH = 1000
# A publisher sends nothing to whom it has not met. A node is met one subscription at a time, and
# several may subscribe to one topic: none has come for this long [s] before messages go out.
_REST = 1.0
_SOON, _AGAIN = 2.0, 30.0  # [s] when it is said that nobody subscribes, and how often from then on
_CLOCK_PERIOD = 0.01  # [s] of the bag's time
_PAUSE = 0.05  # [s] longest sleep at a time, so that an interrupt is seen


class Player:
    """
    Publishes the messages of one bag.

    Parameters
    ----------
    node : to publish with
    summary : of the bag
    topics : only these; None: all whose type is installed here
    remap : topic in the bag -> topic to publish on
    clock : publish /clock too

    Raises
    ------
    OptionError : a topic that the bag does not have, or whose type is not installed.

    """

    def __init__(self, node: Node, summary: BagSummary, topics: Sequence[str] | None,
                 remap: dict[str, str], clock: bool):
        self._node = node
        names = {topic.name for topic in summary.topics}
        for name in [*(topics or ()), *remap]:
            if name not in names:
                raise OptionError(f'the bag has no topic {name}; it has '
                                  f'{", ".join(sorted(names))}')
        self.publishers: dict[str, Publisher] = {}
        for topic in summary.topics:
            if topics is not None and topic.name not in topics:
                continue
            kind = _message_class(topic.msgtype)
            name = remap.get(topic.name, topic.name)
            try:
                if kind is None:
                    raise OptionError(f'the type {topic.msgtype} is not installed')
                self.publishers[topic.name] = node.create_publisher(kind, name, _profile(topic))
            except Exception as error:  # of names, and of two types of one, rclpy raises anything
                why = f'{topic.name} cannot be played onto {name}: {reason(error)}'
                if topics is not None or topic.name in remap:
                    raise OptionError(why) from error
                node.get_logger().warning(f'{why}; it is left out')
        self._clock = node.create_publisher(Clock, '/clock', 10) if clock else None

    def wait_for_subscribers(self, longest: float | None, nodes: Collection[str] = ()) -> None:
        """
        Wait until anybody subscribes and each of some nodes does, then until nobody else does.

        longest : [s] then play all the same; None: as long as it takes; 0: do not wait at all;
        nodes : their names, without namespaces

        """
        if longest == 0:
            return
        began = time.monotonic()
        say = began + _SOON
        while absent := self._who_is_absent(nodes):
            now = time.monotonic()
            if longest is not None and now > began + longest:
                self._node.get_logger().warning(
                    f'{absent} did not subscribe for {longest:g} s; playing all the same')
                return
            if now > say:
                say = now + _AGAIN
                names = ', '.join(publisher.topic_name for publisher in self.publishers.values())
                self._node.get_logger().info(f'waiting for {absent} to subscribe to {names}')
            _sleep_until(now + _PAUSE)
        self._wait_for_others()

    def _who_is_absent(self, nodes: Collection[str]) -> str:
        """Return who does not subscribe to any topic yet, in words; empty: all are there."""
        if not self._count_subscriptions():
            return ' and '.join(nodes) or 'a node'
        if not nodes:
            return ''
        there = {info.node_name for publisher in self.publishers.values()
                 for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name)}
        return ' and '.join(name for name in nodes if name not in there)

    def _count_subscriptions(self) -> int:
        return sum(publisher.get_subscription_count() for publisher in self.publishers.values())

    def _wait_for_others(self) -> None:
        known = self._count_subscriptions()
        quiet = time.monotonic() + _REST
        while time.monotonic() < quiet:
            _sleep_until(time.monotonic() + _PAUSE)
            if (count := self._count_subscriptions()) > known:
                known = count
                quiet = time.monotonic() + _REST

    def play(self, messages: Iterable[BagMessage], rate: float, progress: Progress) -> None:
        """Publish the messages, `rate` times as fast as they were recorded."""
        first = None
        began = time.monotonic()
        shown = 0.0
        next_clock = 0.0
        for message in messages:
            first = message.time if first is None else first
            recorded = (message.time - first) / NANOSECONDS
            while self._clock is not None and next_clock <= recorded:
                _sleep_until(began + next_clock / rate)
                now = header('', first + round(next_clock * NANOSECONDS)).stamp
                self._clock.publish(Clock(clock=now))
                next_clock += _CLOCK_PERIOD
            _sleep_until(began + recorded / rate)
            self.publishers[message.topic].publish(message.data)
            progress.advance(recorded - shown)
            shown = recorded
        self._wait_until_received()

    def _wait_until_received(self) -> None:
        """Wait until every subscriber has the last messages, or is gone."""
        moment = Duration(seconds=_PAUSE)
        while not all(p.wait_for_all_acked(moment) for p in self.publishers.values()):
            _sleep_until(time.monotonic())  # an interrupt is seen between the waits


def _profile(topic: TopicSummary) -> QoSProfile:
    """Return how a topic is published: what was kept for who comes late is kept here, too."""
    # Transforms that stay are sent by many publishers, each keeping its own.
    kept = _DEPTH if topic.name.endswith('/tf_static') else min(topic.kept, _DEPTH)
    if kept:
        return QoSProfile(depth=kept, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=_DEPTH)


def _sleep_until(moment: float) -> None:
    """Sleep until a `time.monotonic()` [s]; raise when ROS is shut down meanwhile."""
    while (rest := moment - time.monotonic()) > 0:
        time.sleep(min(rest, _PAUSE))
        if not rclpy.ok():
            raise ExternalShutdownException()
    if not rclpy.ok():
        raise ExternalShutdownException()


def _message_class(msgtype: str) -> type | None:
    """Return the class of `package/msg/Name`, None where it is not installed."""
    package, _, name = msgtype.replace('/', '.').rpartition('.')
    try:
        kind: type = getattr(import_module(package), name)
    except (ImportError, AttributeError, ValueError):
        return None
    return kind


def _play(arguments: argparse.Namespace, tell: Callable[[str], None]) -> None:
    """Play a bag once, or again and again with --loop; tell : is given what is damaged."""
    summary = bag_summary(arguments.bag)
    if arguments.start * NANOSECONDS > summary.duration:
        raise OptionError(f'--start is {arguments.start:g}, expected at most the '
                          f'{summary.duration / NANOSECONDS:g} s of the bag')
    start = summary.start + round(arguments.start * NANOSECONDS)
    stop = None
    if arguments.duration is not None:
        stop = start + round(arguments.duration * NANOSECONDS)
    # Without /rosout: a line that is logged just when a signal comes would be an error there.
    node = rclpy.create_node('replay', enable_rosout=False)
    try:
        player = Player(node, summary, arguments.topics, arguments.remap, arguments.clock)
        if not player.publishers:
            raise FileError(arguments.bag, 'no topic of this bag can be played')
        player.wait_for_subscribers(arguments.wait, arguments.nodes)
        seconds = max(summary.duration / NANOSECONDS - arguments.start, 0)
        again = True
        while again:
            messages = read_raw(arguments.bag, list(player.publishers), tell, start=start,
                                stop=stop)
            with Progress(min(seconds, arguments.duration or seconds), 's') as progress:
                player.play(messages, arguments.rate, progress)
            again = arguments.loop
    finally:
        node.destroy_node()


def _remapping(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f'{text!r}, expected old:=new')
    return old, new


def _number(expected: str, allowed: Callable[[float], bool]) -> Callable[[str], float]:
    def number(text: str) -> float:
        with suppress(ValueError):
            if allowed(value := float(text)) and value < float('inf'):
                return value
        raise argparse.ArgumentTypeError(f'{text}, expected a number {expected}')

    return number


_positive = _number('above 0', lambda value: value > 0)
_not_negative = _number('of 0 or more', lambda value: value >= 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='replay', description="Publish a bag's messages at the pace of their recording.",
        epilog='Arguments of ROS come after --ros-args.')
    add = parser.add_argument
    add('bag', type=Path, help='.mcap, .db3, .bag (ROS 1) or a rosbag2 directory')
    add('--wait', type=_not_negative, metavar='SECONDS',
        help='longest time to wait for subscribers; 0: do not wait (default: wait as long as it '
             'takes)')
    add('--nodes', nargs='+', default=[], metavar='NODE',
        help='wait until each of these nodes subscribes, not just any node')
    add('--rate', type=_positive, default=1.0, metavar='FACTOR',
        help='factor on the pace of the recording (default: %(default)g)')
    add('--start', type=_not_negative, default=0.0, metavar='SECONDS',
        help='skip this much at the begin of the bag')
    add('--duration', type=_positive, metavar='SECONDS', help='play only this much of the bag')
    add('--loop', action='store_true', help='play again and again')
    add('--remap', type=_remapping, nargs='+', default=[], metavar='OLD:=NEW',
        help='publish topic OLD of the bag as NEW')
    add('--topics', nargs='+', metavar='TOPIC', help='play only these topics of the bag')
    add('--clock', action='store_true', help='also publish /clock')
    return parser


def _init(arguments: list[str]) -> None:
    try:
        rclpy.init(args=arguments)
    except Exception as error:  # whatever ROS cannot read of them
        raise OptionError(reason(error)) from error


def main() -> int:
    """Play; return the exit code: 0, 2 for bad input, 3 where only a part could be read."""
    own, ros = split(sys.argv[1:])
    arguments = _parser().parse_args(own)
    arguments.remap = dict(arguments.remap)
    damages: list[str] = []

    def tell(damage: str) -> None:
        # Once, however often the bag is played.
        if damage not in damages:
            say(damage, 'replay')
            damages.append(damage)

    try:
        _init(ros)
        _play(arguments, tell)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:
        if rclpy.ok():
            raise
        # A signal has shut ROS down just when something was published.
    except (L1SlamError, OSError) as error:
        say(str(error), 'replay')
        return _BAD_INPUT
    finally:
        rclpy.try_shutdown()
    return _DAMAGED if damages else 0
