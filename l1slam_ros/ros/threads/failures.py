# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Failures in the node: logged once in full, then kept for as long as they last."""

import math
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from l1slam_ros.core.errors import L1SlamError

_REPEAT = 5.0  # [s] shortest time between two log lines about one failure


class Failures:
    """
    The lasting failures, by what fails: an update, a service, the callback of a topic.

    Any thread may call it.

    Parameters
    ----------
    logger : of the node
    running : returns whether ROS is running. A signal can shut it down during any call, and the
        error of that call is then not a failure

    """

    def __init__(self, logger: Any, running: Callable[[], bool]):
        self._logger, self._running = logger, running
        self._lasting: dict[str, tuple[str, float]] = {}
        self._known: set[tuple[object, ...]] = set()

    @property
    def lasting(self) -> dict[str, str]:
        """What fails -> why."""
        now = time.monotonic()
        return {what: why for what, (why, until) in self._lasting.copy().items() if now < until}

    @property
    def sentence(self) -> str:
        """What fails, and why, for the diagnostics; empty if nothing does."""
        return '; '.join(f'{what} failed: {why}' for what, why in self.lasting.items())

    def note(self, what: str, error: Exception, seconds: float = math.inf) -> None:
        """
        Record a failure; the traceback is logged the first time that it comes from that line.

        seconds : how long it is kept, unless it is over before
        """
        if not self._running():
            return
        self._lasting[what] = reason(error), time.monotonic() + seconds
        # To report a failure must not fail, for example for want of memory.
        with suppress(Exception):
            self._tell(what, error)

    def over(self, what: str) -> None:
        """Remove a failure: it works again."""
        if self._lasting:
            self._lasting.pop(what, None)

    def guarded(self, what: str, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that records any error of the given one."""

        def guard(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.note(what, error)
            else:
                self.over(what)

        return guard

    def _tell(self, what: str, error: Exception) -> None:
        line = f'{what} failed: {reason(error)}'
        frames = traceback.extract_tb(error.__traceback__)
        kind = (what, type(error), *(frames[-1][:2] if frames else ()))
        if not isinstance(error, L1SlamError) and kind not in self._known:
            self._known.add(kind)
            line += '\n' + ''.join(traceback.format_exception(error)).rstrip()
            self._logger.error(line)
        else:
            self._logger.error(line, throttle_duration_sec=_REPEAT)


def reason(error: Exception) -> str:
    """Return the message of an error on one line, with its type if it is not one of ours."""
    text = ' '.join(str(error).split())
    if isinstance(error, L1SlamError | OSError):
        return text or type(error).__name__
    return f'{type(error).__name__}: {text}' if text else type(error).__name__
