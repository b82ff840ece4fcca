# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Updates of a map: the front takes new factors at once, and workers begin the work that is due.

In: a keeper, and calls from any thread. Out: the result of each update. The page
doc/how_a_message_becomes_a_map.md lists the steps in order.

One lock admits one thread at a time to update the map or to settle it. Threads that wait for the
lock are counted, and background work ends early for them. A settle, for which a caller waits, ends
early only for a process that is about to fork or to end.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.running.improve import Check, Improvement, front_of, optimise
from l1slam_ros.core.running.keeper.keeper import Keeper
from l1slam_ros.core.running.keeper.schedule import Moment, due, outrun
from l1slam_ros.core.running.keeper.work import carry_out, take_judgement
from l1slam_ros.core.running.keeper.workers import (
    LOOK,
    Calm,
    Requests,
    Stopped,
    Workers,
    until,
)
from l1slam_ros.core.running.problem import as_numbered, as_one, by_robot

# [s] The time for which an update puts factors into the front, unless it waits longer anyway. It
# begins with no more where the last few took longer than what is left.
_LEAST_TIME = 0.007


class Updates:
    """
    Updates the map of a keeper.

    Parameters
    ----------
    keeper : of the map
    done : called when some background work has ended

    Attributes
    ----------
    calm : background work pauses while it lasts

    """

    def __init__(self, keeper: Keeper, done: Callable[[], None]):
        self._keeper = keeper
        self._workers = Workers(done)
        self.calm = Calm()
        self._update_lock = threading.Lock()
        self._claims, self._urgent = Requests(), Requests()
        # The revisions to which the map was updated last, and at which nothing was left to do.
        self._updated = 0
        self._rested = -1
        # [s] When something had come last.
        self._came = 0.0

    @property
    def failing(self) -> bool:
        """Whether the background work that ended last failed."""
        return self._workers.failing

    @property
    def at_rest(self) -> bool:
        """Whether the last update found nothing left to do, and nothing has come since."""
        return self._rested == self._keeper.revisions.now

    def update(self, budget: float, stopped: Stopped, idle: bool | None = None,
               waits: bool = True, taken: Callable[[], None] = lambda: None) -> Improvement | None:
        """
        See `Backend.update`.

        idle : nothing has come for a while, None: unknown; waits : for the workers, up to `budget`
        """
        start = time.monotonic()
        keeper = self._keeper
        with self._update_lock:
            self._workers.check()
            if self.at_rest:
                return None
            before = keeper.state
            end = start + budget if waits else start
            keeper.take_what_has_come(max(end, start + _LEAST_TIME), self._in_vain)
            seen = keeper.revisions
            # The content of a map that begins is not new.
            came = seen.grown > max(self._updated, keeper.state.began)
            self._updated = seen.now
            self._came = start if came else self._came
            idle = not came if idle is None else idle
            # Before workers begin: on one core they would share it with whoever publishes.
            taken()
            took = time.monotonic() - start
            check = self._check(before.began, stopped)
            while self._begin_due(idle, budget, check):
                self._workers.wait(max(min(LOOK, end - time.monotonic()), 0.0))
                self._workers.check()
                check()
                if time.monotonic() >= end:
                    return self._account(before.began, took)
            # A judgement that was not taken is made once more when the robot stands.
            if (came or not idle or keeper.state.last is not before.last
                    or keeper.state.judged.held):
                return self._account(before.began, took)
            # Work that failed since the check is still to do.
            self._workers.check()
            self._rested = seen.now
        return None

    def _in_vain(self) -> bool:
        """
        Return whether the front is to take nothing.

        This is so if more factors came than it could take, and they are being judged or mapped:
        the front would soon be replaced, and its work would delay theirs.
        """
        if not self._workers.judge.busy and self._keeper.state.pending is None:
            return False
        state, _, size = self._keeper.look()
        return outrun(state, size)

    def _account(self, began: int, took: float) -> Improvement:
        state = self._keeper.state
        if state.began != began:
            raise Interrupted
        return state.account(took)

    def _begin_due(self, idle: bool, budget: float, check: Check) -> bool:
        """Start the work that is due; return whether there is any."""
        # Asked before the state is read: work that ends in between makes other work due.
        busy = self._workers.busy
        now = time.monotonic()
        moment = Moment(now, idle, budget, self._workers.judge.busy, now - self._came)
        state, _, size = self._keeper.look()
        make, judge = due(state, size, moment)
        for worker, piece in ((self._workers.mapper, make), (self._workers.judge, judge)):
            if piece is not None:
                worker.start(partial(
                    carry_out, self._keeper, piece, moment, self.calm.kept(check)))
        return busy or make is not None or judge is not None

    def _check(self, began: int, stopped: Stopped) -> Check:
        """Return a check that raises `Interrupted` when work for a map is no longer wanted."""
        return until(lambda: bool(self._claims or self._urgent) or stopped()
                     or self._keeper.state.began != began)

    def settle(self, stopped: Stopped) -> Improvement | None:
        """See `Backend.settle`."""
        while True:
            with self.alone(check=until(stopped)):
                began = self._keeper.state.began
                try:
                    improvement = self._settled(began, stopped)
                    break
                except Interrupted:
                    if stopped() or self._keeper.state.began != began:
                        raise
            # What could not wait is let through.
            self._urgent.wait()
        self._workers.tell()
        return improvement

    def _settled(self, began: int, stopped: Stopped) -> Improvement | None:
        keeper = self._keeper
        now, _ = keeper.begin_judgement()
        self._updated = keeper.revisions.now
        whole = now.problem()
        if not len(whole.graph.between):
            return None
        turned, order = by_robot(whole)
        check = self.calm.kept(until(
            lambda: bool(self._urgent) or stopped() or keeper.state.began != began))
        improvement = optimise(as_one(turned), keeper.solver, check)
        judgement, poses = as_numbered(order, improvement.judgement, improvement.poses)
        improvement = replace(improvement, poses=poses, judgement=judgement)
        problem = as_one(whole)
        check()
        front = front_of(replace(problem, judgement=judgement), poses,
                         len(whole.graph.between), check)
        improvement = improvement.of_all(whole)
        improvement = replace(
            improvement, judgement=improvement.judgement.with_parts(whole.graph))
        take_judgement(keeper, now, improvement.judgement, improvement.poses, True, True)
        keeper.adopt(improvement, front, improvement.judgement)
        return improvement

    @contextmanager
    def alone(self, urgent: bool = False, check: Check = lambda: None) -> Iterator[None]:
        """
        Let nothing be at work.

        urgent : a settle that is under way makes way, too; check : called now and then while
        another thread has the map for itself, may raise
        """
        with (self._urgent if urgent else self._claims).one():
            while not self._update_lock.acquire(timeout=LOOK):
                check()
            self._workers.join()
        try:
            yield
        finally:
            self._update_lock.release()

    def check(self) -> None:
        """Raise the error that background work has raised, once."""
        self._workers.check()
