# SPDX-License-Identifier: Apache-2.0
"""A thread that updates whenever there is something new, for who has no timer of their own."""

import threading
from collections.abc import Callable

from l1slam_ros.core.errors import Interrupted


class Background:
    """
    Calls an update again and again, from each time it is woken until nothing is left to do.

    Parameters
    ----------
    update : called with a function that tells it to stop; returns None where nothing was left

    """

    def __init__(self, update: Callable[[Callable[[], bool]], object]):
        self._update = update
        self._woken = threading.Event()
        self._closing = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name='updates', daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Look whether there is something to do."""
        self._woken.set()

    def close(self) -> None:
        """Stop what is at work and end; raise what an update raised: it was the last one then."""
        self._closing = True
        self._woken.set()
        self._thread.join()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _work(self) -> None:
        try:
            while True:
                self._woken.wait()
                # In this order, or the call to close is lost.
                self._woken.clear()
                if self._closing:
                    return
                self._until_nothing_is_left()
        except Exception as error:
            self._error = error

    def _until_nothing_is_left(self) -> None:
        try:
            while self._update(lambda: self._closing) is not None:
                pass
        except Interrupted:
            # By what wakes this thread when it is done.
            return
