# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What an update that does not wait leaves to others, and what a worker leaves to an update."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from problems import EVERY, drive_on, straight

from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.keeper import keeper, updates, work, workers
from l1slam_ros.core.running.keeper.keeper import Keeper


@pytest.mark.parametrize('background, longest', [(True, updates._LEAST_TIME), (False, 5.0)])
def test_an_update_that_does_not_wait_takes_factors_for_a_moment(
        monkeypatch, background, longest):
    given = []

    def take(keeper, deadline, in_vain):
        given.append(deadline - time.monotonic())

    monkeypatch.setattr(Keeper, 'take_what_has_come', take)
    with Backend(EVERY, background=background) as backend:
        drive_on(backend, straight(3))
        backend.update(5.0)
    assert longest / 2 < max(given) <= longest


@pytest.mark.parametrize('each, taken', [(0.001, 7), (0.003, 2), (0.004, 1), (0.02, 1)])
def test_an_update_begins_with_no_more_factors_than_it_has_time_for(monkeypatch, each, taken):
    now = []
    monkeypatch.setattr(keeper.time, 'monotonic', lambda: each * len(now))

    def take(_):
        now.append(each)
        return True

    with Backend(EVERY) as backend:
        monkeypatch.setattr(Keeper, '_take_some', take)
        backend._keeper.take_what_has_come(0.0071)
        assert len(now) == taken
        monkeypatch.undo()


class Growing:
    """A front, and the keeper of a graph that grows by so many factors during each pass."""

    def __init__(self, *grows):
        self._grows = list(grows)
        self.rows = 0
        self.closed = False
        self.factors = 0

    def look(self):
        self.factors += self._grows.pop(0)
        table = SimpleNamespace(for_new_front=lambda *_: np.ones(self.factors, np.int64))
        return SimpleNamespace(table=table), None, None

    def take(self, factors, what):
        self.rows += len(what)
        return len(what) * ['look']


@pytest.mark.parametrize('grows, left', [
    ((60, 0), 0), ((60, 30, 12, 5, 2, 0), 0), ((60, 30, 12, 12), 12), ((0,), 0), ((5, 6), 6)])
def test_a_new_front_catches_up_as_long_as_less_is_left(grows, left):
    graph = Growing(*grows)
    looks = work._caught_up(graph, graph, np.ones(0, bool), False, lambda: None)
    assert len(looks) == graph.rows == graph.factors - left
    assert not graph._grows


def test_a_front_that_is_full_catches_up_no_more():
    graph = Growing(60)
    graph.closed = True
    assert work._caught_up(graph, graph, np.ones(0, bool), False, lambda: None) == []


def test_the_interpreter_lock_is_given_away_only_for_a_thread_that_waits(monkeypatch):
    given = []
    monkeypatch.setattr(workers.time, 'sleep', lambda seconds: given.append(seconds))
    lock = workers.PoliteLock()
    with lock:
        pass
    lock.let_others()
    assert not given
    with lock:
        waiting = threading.Thread(target=lock.__enter__)
        waiting.start()
        while not lock._waiting:
            pass
        lock.let_others()
    assert given == [0]
    waiting.join()
    lock.let_others()
    assert given == [0]
