# SPDX-License-Identifier: Apache-2.0
"""Threads that make way for the one that answers messages."""

import os
import sys
import threading
from collections.abc import Callable

# A core that both want goes to messages at three to one. With much more, on a machine that others
# keep busy, a thread that holds Python's lock would seldom come to run, and messages wait for it.
_NICE = 5


def background(name: str, work: Callable[[], None]) -> threading.Thread:
    """Return a thread that does some work with less priority, as do the threads it starts."""
    def run() -> None:
        if sys.platform == 'linux':  # elsewhere it is the whole process that would be nice
            os.nice(_NICE)
        work()

    return threading.Thread(target=run, name=name, daemon=True)
