# SPDX-License-Identifier: Apache-2.0
"""
The thread that takes messages in.

Each time that rclpy's executor wakes, it makes a wait set anew of all that a node has, services,
timers and events: 1.5 ms, ten times what a message of the odometry costs. The wait set here is
made once, of subscriptions alone. What DDS has queued up is taken over first, some microseconds a
message, before anything is made of it: a queue of DDS that is full drops messages without a word.
"""

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
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
# Messages of one topic at most before others have their turn, and before DDS is asked for more.
_AT_ONCE = 100
# More of one topic are left to DDS, to drop: ten seconds of a fast one, some megabytes.
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
    queue: deque[tuple[Any, Any]]


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
        self._inputs.append(_Input(subscription, traffic, guarded, deque()))

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
                    self._wait(waiting, seconds)
                    seconds = min(self._use(), self._tick() if self.active else math.inf)
                    self._failures.over('intake')
                except Exception as error:
                    self._failures.note('intake', error)
                    time.sleep(_BREATH)

    def _wait(self, waiting: Any, seconds: float) -> None:
        """Wait for messages, for so long; take over those that have come."""
        waiting.clear_entities()
        for one in self._inputs:
            waiting.add_subscription(one.subscription.handle)
        waiting.add_guard_condition(self._guard.handle)
        waiting.wait(-1 if math.isinf(seconds) else max(round(seconds * 1e9), 0))
        sys.setswitchinterval(_OWN_TURN)
        ready = waiting.get_ready_entities('subscription')
        for one in self._inputs:
            if one.subscription.handle.pointer in ready:
                self._take(one)

    def _take(self, one: _Input) -> None:
        subscription = one.subscription
        with subscription.handle:
            while len(one.queue) < _BACKLOG and (taken := subscription.handle.take_message(
                    subscription.msg_type, subscription.raw)) is not None:
                one.queue.append(taken)

    def _use(self) -> float:
        """Call back with some messages; return after how many seconds to go on, 0 or infinity."""
        for one in self._inputs:
            for _ in range(min(len(one.queue), _AT_ONCE)):
                message, information = one.queue.popleft()
                one.traffic.note(information)
                if self.active:
                    one.callback(message, len(one.queue))
        return 0.0 if any(one.queue for one in self._inputs) else math.inf
