# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A queue of the work of services, which a thread of its own carries out in order."""

import queue
import threading
from collections.abc import Callable

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from l1slam_ros.core.errors import Interrupted, L1SlamError
from l1slam_ros.ros.threads.failures import Failures, reason

# [s] How long a failure of a service is shown, as it may not be called again.
_REMEMBERED = 60.0


class JobQueue:
    """
    A queue of jobs from service callbacks, carried out in the order they came.

    A callback awaits the future of `put`, so the executor goes on with other callbacks. Every job
    is answered, even if it raises, and then the next one is carried out.

    Parameters
    ----------
    node : whose executor runs the callbacks
    failures : records unexpected errors
    done : called after each job

    """

    def __init__(self, node: Node, failures: Failures, done: Callable[[], None]):
        self._node = node
        self._failures = failures
        self._done = done
        # Name, work, and the future of the answer; None ends the thread.
        self._queue: queue.SimpleQueue[tuple[str, Callable[[], str], Future] | None] = (
            queue.SimpleQueue())
        self._thread = threading.Thread(target=self._work, name='services', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def put(self, name: str, work: Callable[[], str]) -> Future:
        """Queue work that returns a sentence; return the future of the service's answer."""
        future = Future(executor=self._node.executor)
        self._queue.put((name, work, future))
        return future

    def close(self, seconds: float) -> bool:
        """End the thread after what is queued; return whether it ended within some seconds."""
        self._queue.put(None)
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            name, work, future = job
            future.set_result(self._carry_out(name, work))
            if (executor := self._node.executor) is not None:
                executor.wake()  # it checks for the answer only when it wakes

    def _carry_out(self, name: str, work: Callable[[], str]) -> Trigger.Response:
        try:
            sentence = work()
            self._done()
        except Interrupted:
            return Trigger.Response(success=False, message='the node is ending')
        except Exception as error:
            # Our own errors are faults of the call, not of the node: only the caller gets them.
            if not isinstance(error, L1SlamError | OSError):
                self._failures.note(name, error, _REMEMBERED)
            return Trigger.Response(success=False, message=reason(error))
        self._failures.over(name)
        return Trigger.Response(success=True, message=sentence)
