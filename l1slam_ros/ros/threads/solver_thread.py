# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The thread that updates the map periodically, and goes on after any error of an update."""

import gc
import threading
import time
from collections.abc import Callable

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.io.free_memory import give_back_freed_memory
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.parameters import NodeParameters
from l1slam_ros.ros.threads.failures import Failures

# [s] Pause after a failed update; doubled at each further failure, up to the second number.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.2, 10.0


class SolverThread:
    """
    Updates the map of a back end, once in a period.

    Parameters
    ----------
    backend : whose map
    failures : records the errors of updates
    parameters : of the node: how often to update, and how long one update may work

    """

    def __init__(self, backend: Backend, failures: Failures,
                 parameters: NodeParameters[NodeOptions]):
        self._backend = backend
        self._failures = failures
        self._parameters = parameters
        self._woken = threading.Event()
        self._paused = self._closing = False
        self._pause = _FIRST_PAUSE
        self._not_before = 0.0
        self._behind_since = 0.0

    def start(self, tell: Callable[[Improvement | None], None]) -> None:
        """
        Begin.

        tell : publishes what is new; called when an update has taken in what has come, and at its
            end, with what it did, None: nothing
        """
        self._thread = threading.Thread(
            target=self._work, args=(tell,), name='solver', daemon=True)
        self._thread.start()

    def hurry(self) -> None:
        """Begin an update now, even if the last one has just failed."""
        self._not_before = 0.0
        self._woken.set()

    def pause(self, paused: bool) -> None:
        """Pause updates, stopping one that is at work, or resume them."""
        self._paused = paused

    def close(self, seconds: float) -> bool:
        """End the thread; return whether it ended within `seconds`."""
        self._closing = True
        self._woken.set()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def is_closing(self) -> bool:
        """Return whether the node is ending."""
        return self._closing

    @property
    def behind(self) -> float:
        """For how long loops have been waiting to be judged [s]."""
        return time.monotonic() - self._behind_since if self._behind_since else 0.0

    def _work(self, tell: Callable[[Improvement | None], None]) -> None:
        # What has been imported stays: some 100,000 objects, each search of which for garbage
        # would take a tenth of a second.
        gc.collect()
        gc.freeze()
        give_back_freed_memory()
        due = time.monotonic()
        while True:
            # From beginning to beginning: an update is a part of its period.
            due = max(due + self._parameters.options.update.period, time.monotonic())
            self._woken.wait(due - time.monotonic())
            # Woken early it begins now, and the period may have been shortened.
            due = min(due, time.monotonic())
            # In this order, or a call of `close` in between is lost.
            self._woken.clear()
            if self._closing:
                return
            if time.monotonic() < self._not_before:
                continue
            try:
                improvement = self._update(lambda: tell(None))
                tell(improvement)
            except Interrupted:
                continue
            except Exception as error:
                # The last good map stays. A recurring failure must not keep a core busy.
                self._failures.note('update', error)
                self._not_before = time.monotonic() + self._pause
                self._pause = min(2 * self._pause, _LONGEST_PAUSE)
            else:
                # Background work that failed is tried again, and may fail after the update.
                if improvement is None or not self._backend.behind().failing:
                    self._failures.over('update')
                    self._pause = _FIRST_PAUSE

    def _update(self, taken: Callable[[], None]) -> Improvement | None:
        if self._paused:
            return None
        self._behind_since = self._behind_since or time.monotonic()
        improvement = self._backend.update(
            self._parameters.options.update.budget, lambda: self._paused or self._closing, taken)
        if improvement is None or not self._backend.behind().loops:
            self._behind_since = 0.0
        return improvement
