# SPDX-License-Identifier: Apache-2.0
"""
The thread that takes messages in.

Each time that rclpy's executor wakes, it makes a wait set anew of all that a node has, services,
timers and events: 1.5 ms, ten times what a message of the odometry costs. The wait set here is
made once, of subscriptions alone. What DDS has queued up is taken over first, some microseconds a
message, before anything is made of it: a queue of DDS that is full drops messages without a word.
Messages of all topics are used in the order they came: a loop that was sent before the stamps of
the odometry went back is of the time before.
"""

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from l1slam_ros.ros.inputs.traffic import Traffic
from l1slam_ros.ros.threads.failures import Failures

_DEPTH = 1000
# So many are used before DDS is asked for more.
_AT_ONCE = 100
# More are left to DDS, to drop: ten seconds of a fast topic, some megabytes.
_BACKLOG = 10_000
# [s] So long others run Python's code before a message may come in, and so long they wait once one
# has: by turns of one length a busy machine would hand each message to and fro.
_OTHERS_TURN, _OWN_TURN = 5e-4, 0.05
# [s] What raises each time it is called shall not keep a core busy.
_BREATH = 0.05


class _Apart(ReentrantCallbackGroup):  # type: ignore[misc]
    """Leaves all in it to others than the executor."""

    def can_execute(self, _: Any) -> bool:
        return False


class _Input(NamedTuple):
    subscription: Any
    traffic: Traffic
    callback: Callable[[Any, int], None]


class _Message(NamedTuple):
    """A message, what rclpy says about it, and when it came [ns]."""

    received: int
    input: _Input
    content: Any
    information: Any


class Intake:
    """
    Calls back with each message of some topics, and how many more wait behind it.

    It has a thread of its own.

    Parameters
    ----------
    node : to subscribe with
    failures : where to tell what a callback raised
    tick : called after messages, and again after as many seconds as it returns

    Attributes
    ----------
    topics : name -> how its messages come
    active : whether anything is called; messages that come meanwhile are gone

    """

    def __init__(self, node: Node, failures: Failures, tick: Callable[[], float]):
        self._node, self._failures, self._tick = node, failures, tick
        self._group, self.active, self._closing = _Apart(), False, False
        self._inputs: list[_Input] = []
        self._queue: deque[_Message] = deque()
        self._guard = GuardCondition(None, None, context=node.context)
        self._thread = threading.Thread(target=self._work, name='intake', daemon=True)
        self.topics: dict[str, Traffic] = {}

    def subscribe(self, kind: Any, topic: str, callback: Callable[[Any, int], None],
                  raw: bool = False) -> None:
        """Subscribe to a topic; raw : the callback gets the bytes of each message."""
        guarded = self._failures.guarded(topic, callback)
        subscription = self._node.create_subscription(
            kind, topic, guarded, QoSProfile(depth=_DEPTH), raw=raw, callback_group=self._group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        traffic = self.topics[topic] = Traffic(subscription.get_publisher_count)
        self._inputs.append(_Input(subscription, traffic, guarded))

    def start(self) -> None:
        """Begin; there is nothing to subscribe to any more."""
        self._thread.start()

    def wake(self) -> None:
        """Let `tick` be called now."""
        self._guard.trigger()

    def look_at_events(self) -> None:
        """
        Call back what has happened to the subscriptions: publishers whose QoS does not match.

        To be called now and then: who waits for such events wakes for each message.
        """
        context = self._node.context
        events = [event for one in self._inputs for event in one.subscription.event_handlers]
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
        with context.handle, self._guard.handle:
            waiting = rclpy_implementation.WaitSet(
                len(self._inputs), 1, 0, 0, 0, 0, context.handle)
            seconds = math.inf
            while not self._closing and context.ok():
                try:
                    sys.setswitchinterval(_OTHERS_TURN)
                    self._wait(waiting, 0.0 if self._queue else seconds)
                    sys.setswitchinterval(_OWN_TURN)
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
        for one in self._inputs:
            waiting.add_subscription(one.subscription.handle)
        waiting.add_guard_condition(self._guard.handle)
        waiting.wait(-1 if math.isinf(seconds) else max(round(seconds * 1e9), 0))

    def _take(self) -> None:
        """Take over what has come of every topic."""
        for one in self._inputs:
            subscription = one.subscription
            with subscription.handle:
                while len(self._queue) < _BACKLOG and (taken := subscription.handle.take_message(
                        subscription.msg_type, subscription.raw)) is not None:
                    content, information = taken
                    self._queue.append(_Message(
                        information['received_timestamp'], one, content, information))

    def _use(self) -> None:
        """Call back with some of the messages in the order they came."""
        until = max((message.received for message in self._queue), default=0)
        # While one topic was emptied, older messages may have come of those before.
        self._take()
        if len(self._queue) > 1:
            self._queue = deque(sorted(self._queue, key=itemgetter(0)))
        for _ in range(_AT_ONCE):
            if not self._queue or self._queue[0].received > until:
                return
            message = self._queue.popleft()
            message.input.traffic.note(message.information)
            if self.active:
                message.input.callback(message.content, len(self._queue))
