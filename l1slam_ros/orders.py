# SPDX-License-Identifier: Apache-2.0
"""Work that a service asks for and the solver's thread does, between two updates."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.task import Future

from l1slam_ros.core.errors import L1SlamError


@dataclass(frozen=True)
class Answer:
    """What a service replies."""

    success: bool
    message: str


class Orders:
    """
    A queue of orders from service callbacks to the worker.

    A callback awaits `place`, so the executor goes on with other callbacks meanwhile.

    Parameters
    ----------
    node : whose executor runs the callbacks
    wake : wakes the worker

    """

    def __init__(self, node: Node, wake: threading.Event):
        self._node, self._wake = node, wake
        self._queue: deque[tuple[Callable[[], str], Future]] = deque()

    def place(self, work: Callable[[], str]) -> Future:
        """Queue some work, which returns a sentence; the future's result is an `Answer`."""
        future = Future(executor=self._node.executor)
        self._queue.append((work, future))
        self._wake.set()
        return future

    def carry_out(self) -> bool:
        """Do all the work that is queued; return whether there was any. The worker calls it."""
        found = bool(self._queue)
        while self._queue:
            work, future = self._queue.popleft()
            try:
                answer = Answer(True, work())
            except (L1SlamError, OSError) as error:
                answer = Answer(False, str(error))
            future.set_result(answer)
        return found
