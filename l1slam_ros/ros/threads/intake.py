# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Messages of topics -> who uses them, in a thread that does nothing else.

Each time that rclpy's executor wakes, it makes a wait set anew of all that a node has, services,
timers and events: 1.5 ms, ten times what a message of the odometry costs. The wait set here is
made once, of subscriptions alone. What DDS has queued up is taken over first, some microseconds a
message, before anything is made of it: a queue of DDS that is full drops messages without a word.
Messages of all topics are used in the order they came: a loop that was sent before the stamps of
the odometry went back is of the time before. None of it is compiled code.
"""

import math
import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.qos_overriding_options import QoSOverridingOptions

from l1slam_ros.core.errors import OptionError
from l1slam_ros.ros.threads.failures import Failures, reason

_DEPTH = 1000
# So many are used before DDS is asked for more.
_AT_ONCE = 100
# More are left to DDS, to drop: ten seconds of a fast topic, some megabytes.
_BACKLOG = 10_000
# [s] What raises each time it is called shall not keep a core busy.
_BREATH = 0.05
# [s] The rate of messages is that of so long.
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
    unheard : returns a sentence if there are others, whose messages do not come; see `unheard_by`

    Attributes
    ----------
    received, lost : how many messages
    last : what `values` returned last
    other_source : whether the numbers began anew with the last one: of another publisher, or of
        one that was restarted
    mixed : whether messages of several publishers came by turns

    """

    def __init__(self, publishers: Callable[[], int], unheard: Callable[[], str] = str):
        self.received = self.lost = 0
        self.last: dict[str, str] = {}
        self.other_source = self.mixed = False
        self.publishers, self.unheard = publishers, unheard
        # The last number of each publisher, of who spoke last in front.
        self._numbers: list[int] = []
        self._marks = deque([(time.monotonic(), 0)])

    def note(self, information: Mapping[str, int | None]) -> None:
        """Count a message; information : what rclpy says about it."""
        self.received += 1
        self.other_source = False
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
            self.mixed |= nearest != numbers[0]
            numbers.remove(nearest)
            self.lost += number - nearest - 1
        else:
            self.other_source = bool(numbers)
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
        self.last = {
            'received': str(self.received), 'rate': f'{rate:.1f}', 'lost': str(self.lost)}
        return self.last


def unheard_by(node: Node, subscription: Any) -> str:
    """Return a sentence if a topic has publishers whose QoS a subscription does not take."""
    name = subscription.topic_name
    if node.count_publishers(name) <= subscription.get_publisher_count():
        return ''
    reasons = [why for why in (
        qos_check_compatible(publisher.qos_profile, subscription.qos_profile)
        for publisher in node.get_publishers_info_by_topic(name))
        if why[0] == QoSCompatibility.ERROR]
    return (f'{len(reasons)} of the publishers of {name} cannot be heard: '
            f'{reasons[0][1].removeprefix("ERROR: ").rstrip(";").lower()}; expected the same QoS, '
            f'or qos_overrides.{name}.subscription.reliability: best_effort') if reasons else ''


class _Apart(ReentrantCallbackGroup):  # type: ignore[misc]
    """Leaves all in it to others than the executor."""

    def can_execute(self, _: Any) -> bool:
        return False


class _Topic(NamedTuple):
    name: str
    subscription: Any
    traffic: Traffic
    use: Callable[[Any], None]


class _Message(NamedTuple):
    """A message, what rclpy says about it, and when it came [ns]."""

    received: int
    topic: _Topic
    content: Any
    information: Any


class Intake:
    """
    Takes the messages of topics in.

    Parameters
    ----------
    node : to subscribe with
    failures : where to tell what nobody foresaw
    used : called once nothing more waits
    tick : called after messages while active, and again after as many seconds as it returns

    Attributes
    ----------
    active : whether messages are used
    traffic : of each topic by its name

    """

    def __init__(self, node: Node, failures: Failures, used: Callable[[], None],
                 tick: Callable[[], float]):
        self._node = node
        self._failures = failures
        self._used = used
        self._tick = tick
        self._group = _Apart()
        self.active = False
        self._closing = False
        self._topics: list[_Topic] = []
        self.traffic: dict[str, Traffic] = {}
        # As they came, and of each topic in its turn.
        self._queue: deque[_Message] = deque()
        self._new: list[_Message] = []
        self._guard = GuardCondition(None, None, context=node.context)
        self._thread = threading.Thread(target=self._work, name='intake', daemon=True)

    def subscribe(self, kind: Any, name: str, use: Callable[[Any], None],
                   raw: bool = False) -> None:
        """Subscribe to a topic; raw : its messages are used as bytes; `use` may raise."""
        try:
            subscription = self._node.create_subscription(
                kind, name, use, QoSProfile(depth=_DEPTH), raw=raw, callback_group=self._group,
                qos_overriding_options=QoSOverridingOptions.with_default_policies())
        except Exception as error:  # by what is said of its QoS, rclpy raises anything
            if not self._node.context.ok():  # a signal has shut ROS down just now
                raise
            raise OptionError(f'{name} cannot be subscribed to: {reason(error)}') from error
        traffic = Traffic(subscription.get_publisher_count,
                          partial(unheard_by, self._node, subscription))
        self._topics.append(_Topic(name, subscription, traffic, use))
        self.traffic[name] = traffic

    def start(self) -> None:
        """Begin; there is nothing to subscribe to any more."""
        self._thread.start()

    def wake(self) -> None:
        """Look now whether a transform is to be published."""
        self._guard.trigger()

    def look_at_events(self) -> None:
        """
        Call back what has happened to the subscriptions: publishers whose QoS does not match.

        To be called now and then: who waits for such events wakes for each message.
        """
        context = self._node.context
        events = [event for one in self._topics for event in one.subscription.event_handlers]
        with context.handle:
            waiting = rclpy_implementation.WaitSet(0, 0, 0, 0, 0, len(events), context.handle)
            waiting.clear_entities()
            for event in events:
                event.add_to_wait_set(waiting)
            waiting.wait(0)
            for event in events:
                if event.is_ready(waiting):
                    event.callback(event.take_data())

    def close(self, seconds: float) -> bool:
        """End the thread; return whether it ended within some seconds."""
        self._closing = True
        self.wake()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        context = self._node.context
        with context.handle, self._guard.handle, ExitStack() as held:
            # From Kilted on a signal destroys the node in its own thread, and what is waited for
            # must be there until the wait is over.
            for one in self._topics:
                held.enter_context(one.subscription.handle)
            waiting = None
            seconds = math.inf
            while not self._closing and context.ok():
                try:
                    waiting = waiting or rclpy_implementation.WaitSet(
                        len(self._topics), 1, 0, 0, 0, 0, context.handle)
                    self._wait(waiting, 0.0 if self.backlog else seconds)
                    self._take()
                    self._use()
                    seconds = self._tick() if self.active else math.inf
                    self._failures.over('intake')
                except Exception as error:
                    self._failures.note('intake', error)
                    time.sleep(_BREATH)

    def _wait(self, waiting: Any, seconds: float) -> None:
        """Wait for messages, for so long."""
        waiting.clear_entities()
        for one in self._topics:
            waiting.add_subscription(one.subscription.handle)
        waiting.add_guard_condition(self._guard.handle)
        waiting.wait(-1 if math.isinf(seconds) else max(round(seconds * 1e9), 0))

    @property
    def backlog(self) -> int:
        """How many messages wait to be used."""
        return len(self._queue) + len(self._new)

    def _take(self) -> None:
        """Take over what has come of every topic."""
        for topic in self._topics:
            subscription = topic.subscription
            with subscription.handle:
                while self.backlog < _BACKLOG and (taken := subscription.handle.take_message(
                        subscription.msg_type, subscription.raw)) is not None:
                    content, information = taken
                    self._new.append(_Message(
                        information['received_timestamp'], topic, content, information))

    def _use(self) -> None:
        """Use some of the messages in the order they came."""
        if self._new and not self._queue:
            until = max(message.received for message in self._new)
            # While one topic was emptied, older messages may have come of those before.
            self._take()
            self._new.sort(key=itemgetter(0))
            count = bisect_right(self._new, until, key=itemgetter(0))
            self._queue = deque(self._new[:count])
            self._new = self._new[count:]
        for _ in range(min(_AT_ONCE, len(self._queue))):
            _, topic, content, information = self._queue.popleft()
            topic.traffic.note(information)
            if not self.active:
                continue
            try:
                topic.use(content)
            except Exception as error:
                self._failures.note(topic.name, error)
                continue
            self._failures.over(topic.name)
        if not self.backlog:
            self._used()
