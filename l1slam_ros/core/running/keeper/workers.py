# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Threads that carry out work; their callers decide which work, and when.

In: pieces of work, as functions. Out: that they have ended, or the error that they raised.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.running.improve import Check

# [s] How often a waiting thread checks whether to stop.
LOOK = 0.05

# A function that is called often during work and raises if the work is to stop.
Stopped = Callable[[], bool]


def until(over: Stopped, check: Check = lambda: None) -> Check:
    """Return a check that calls another check, and raises `Interrupted` when `over()` is true."""
    def checked() -> None:
        check()
        if over():
            raise Interrupted

    return checked


@contextmanager
def held(lock: threading.Lock, check: Callable[[], None]) -> Iterator[None]:
    """Hold a lock; check : called now and then while another thread has it, may raise."""
    while not lock.acquire(timeout=LOOK):
        check()
    try:
        yield
    finally:
        lock.release()


class Calm:
    """
    Pauses background work in favour of work that a caller waits for.

    There is one interpreter lock, and to get it back from threads that compute may take longer
    than the work. For one thread at a time: `with calm:`.
    """

    def __init__(self) -> None:
        self._over = threading.Event()
        self._over.set()

    def __enter__(self) -> None:
        self._over.clear()

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def kept(self, check: Check) -> Check:
        """Return a check that waits for its end, too, unless the other raises."""
        def checked() -> None:
            check()
            while not self._over.wait(LOOK):
                check()

        return checked


class Requests:
    """Counts the threads that ask for something; true while any does."""

    def __init__(self) -> None:
        self._count = 0
        self._none = threading.Condition()

    def __bool__(self) -> bool:
        return self._count > 0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Ask for it."""
        with self._none:
            self._count += 1
        try:
            yield
        finally:
            with self._none:
                self._count -= 1
                self._none.notify_all()

    def wait(self) -> None:
        """Wait until nobody asks."""
        with self._none:
            self._none.wait_for(lambda: not self._count)


class PoliteLock:
    """A lock for `with` whose holder can let a thread that waits for it go first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting = Requests()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            with self._waiting.one():
                self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def let_others(self) -> None:
        """
        Give a thread that waits for it the time to take it; the caller has released it.

        If none waits this does nothing: who gives the interpreter's lock away without need may
        wait for a switch interval, 5 ms, until it is given back.
        """
        if self._waiting:
            time.sleep(0)


class Worker:
    """
    Does one piece of work at a time, in a thread that ends with it.

    Parameters
    ----------
    name : of its threads
    done : called when some work has ended, however it did

    Attributes
    ----------
    busy : whether it is at work
    failed : whether the last work that came to an end of its own raised an error

    """

    def __init__(self, name: str, done: Callable[[], None]):
        self._name, self._done = name, done
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None
        self._starting = threading.Lock()
        self.busy = self.failed = False

    def start(self, work: Callable[[], None]) -> None:
        """Begin some work, unless some is under way, or what the last one raised is not told."""
        if self.busy or self._error is not None:
            return
        self.busy = True
        # Not a daemon: those are torn down within a compiled loop when the process ends.
        self._thread = threading.Thread(target=self._run, args=(work,), name=self._name)
        # Of a thread that already works, its starter would wait twice for the interpreter's lock:
        # to learn that it runs, and to go on. That is twice the switch interval, or 10 ms.
        with self._starting:
            self._thread.start()

    def join(self) -> None:
        """Wait for the end of what is under way."""
        if self._thread is not None:
            self._thread.join()

    def check(self) -> None:
        """Raise what the last work raised, once."""
        error = self._error
        self._error = None
        if error is not None:
            raise error

    def _run(self, work: Callable[[], None]) -> None:
        with self._starting:
            pass
        try:
            work()
            self.failed = False
        except Interrupted:  # its result is not wanted any more
            pass
        except Exception as error:
            self._error = error
            self.failed = True
        self.busy = False
        self._done()


class Workers:
    """
    The two background workers: one makes maps, one judges loops.

    Parameters
    ----------
    done : called when one of them has ended some work

    """

    def __init__(self, done: Callable[[], None]):
        self._done = done
        self._ended = threading.Event()
        self.mapper, self.judge = Worker('map', self.tell), Worker('judge', self.tell)

    @property
    def busy(self) -> bool:
        """Whether any is at work."""
        return self.mapper.busy or self.judge.busy

    @property
    def failing(self) -> bool:
        """Whether the last work of any of them failed, told or not."""
        return self.mapper.failed or self.judge.failed

    def tell(self) -> None:
        """Wake the threads that wait for the end of some work."""
        self._ended.set()
        self._done()

    def wait(self, seconds: float) -> None:
        """Wait so long for the end of some work."""
        self._ended.wait(seconds)
        self._ended.clear()

    def join(self) -> None:
        """Wait for the end of all work."""
        self.mapper.join()
        self.judge.join()

    def check(self) -> None:
        """Raise what the last work of one of them raised, once."""
        self.mapper.check()
        self.judge.check()


class Background:
    """
    Calls an update each time it is woken, and once more when it has not been for a while.

    Parameters
    ----------
    update : called with whether nothing has come for a while, and a function that tells it to
        stop; returns whether more may be to do later
    pause : [s] that is a while

    """

    def __init__(self, update: Callable[[bool, Stopped], bool], pause: float):
        self._update, self._pause = update, pause
        self._woken = threading.Event()
        self._closing = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name='updates', daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether there is the thread; a process that was forked has none."""
        return self._thread.is_alive()

    def wake(self) -> None:
        """Look whether there is something to do."""
        self._woken.set()

    def close(self) -> None:
        """Stop what is at work and end; raise what an update raised: it was the last one then."""
        self._closing = True
        self._woken.set()
        self._thread.join()
        error = self._error
        self._error = None
        if error is not None:
            raise error

    def _work(self) -> None:
        pause: float | None = None
        try:
            while not self._closing:
                idle = not self._woken.wait(pause)
                # In this order, or the call to close is lost.
                self._woken.clear()
                if not self._closing:
                    pause = self._pause if self._updated(idle) else None
        except Exception as error:
            self._error = error

    def _updated(self, idle: bool) -> bool:
        """Tell whether more may be to do later."""
        try:
            return self._update(idle, lambda: self._closing)
        except Interrupted:  # by what wakes this thread when it is done
            return False
