# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Threads that meet at the back end: it answers while it works, loses nothing, and ends."""

import os
import threading
import time

import numpy as np
import pytest
from backends import EVERY, drive, play, played, settled, simulated, states
from heard import loop
from worlds import whitened

import l1slam_ros as l1

DEADLINE = 60.0
# [s] What another thread would do at once if nothing held it up.
MOMENT = 0.3


class Watched(type(EVERY.solver)):
    """Options of the solver; who reads them to solve by them calls `meet` first."""

    meet = staticmethod(lambda: None)

    def __getattribute__(self, name):
        if name in ('outer_iterations', 'norm'):
            Watched.meet()
        return super().__getattribute__(name)


@pytest.fixture
def options():
    """Return options of a back end whose solver is watched."""
    yield l1.BackendOptions(EVERY.keyframe, EVERY.odometry, solver=Watched())
    Watched.meet = staticmethod(lambda: None)


def fail():
    """Stand for a solver that fails."""
    raise MemoryError('no more')


class Held:
    """A place where a thread that works is held until it is told to go on."""

    def __init__(self):
        self.reached, self.goes_on = threading.Event(), threading.Event()

    def __call__(self):
        if threading.current_thread() is not threading.main_thread():
            self.reached.set()
            assert self.goes_on.wait(DEADLINE)


@pytest.fixture(scope='module')
def graph(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp('world'), 150, 320, '--seed', 1).graph


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = threading.active_count()
    yield
    wait_until(lambda: threading.active_count() <= before)


def meanwhile(work):
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def wait_until(holds):
    end = time.monotonic() + DEADLINE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.001)


def close_loop(backend):
    backend.add_loop(loop(1.0, 29.0, (28.0, 0.0, 0.0), 1e-4 * np.eye(6)))


def test_in_the_background_what_comes_is_judged_and_the_threads_end(graph):
    before = threading.active_count()
    with l1.Backend(EVERY, background=True) as backend:
        play(backend, graph)
        wait_until(lambda: set(states(backend).values()) == {'accepted'})
        wait_until(lambda: backend.behind().at_rest)
        # Some loops may have bent it first where all together would not.
        best = l1.solve(graph, robust=False).cost
        assert np.abs(whitened(graph, backend.poses)).sum() < 1.01 * best
        # A map that takes the place of another is woken for too.
        backend.restore(backend.saved())
        wait_until(lambda: backend.behind().at_rest)
        assert threading.active_count() > before
    assert threading.active_count() == before
    drive(backend, 30, 32)
    assert backend.update() is not None and len(backend.poses) == 152


def test_answers_come_while_an_improvement_is_computed(options):
    """And an update does not wait for it."""
    held = Watched.meet = Held()
    with l1.Backend(options, background=True) as backend:
        drive(backend, 0, 30)
        assert held.reached.wait(DEADLINE)
        close_loop(backend)
        drive(backend, 30, 33)
        assert backend.update(DEADLINE) is not None
        assert len(backend.poses) == backend.counts().sizes['keyframes'] == 33
        assert backend.robot().stamp == 32 * 10**9
        # The judge, which nothing holds, may have looked at it already.
        assert len(states(backend)) == 1 and backend.behind().loops <= 1
        saved = backend.saved()
        held.goes_on.set()
        wait_until(lambda: backend.behind().at_rest)
        assert set(states(backend).values()) == {'accepted'}
        np.testing.assert_allclose(backend.poses[:, 0], np.arange(33.0), atol=1e-3)
    restored = l1.Backend(EVERY)
    restored.restore(saved)
    settled(restored)
    np.testing.assert_allclose(restored.poses, backend.poses, atol=1e-4)


def test_what_fails_in_the_background_is_raised_at_the_end(options):
    reached = threading.Event()
    Watched.meet = lambda: reached.set() or fail()
    with pytest.raises(MemoryError, match='no more'), \
            l1.Backend(options, background=True) as backend:
        drive(backend, 0, 5)
        assert reached.wait(DEADLINE)
    backend.close()
    assert len(backend.poses) == 5


def test_what_fails_is_raised_by_each_update_until_it_is_over(options):
    backend = l1.Backend(options)
    drive(backend, 0, 3)
    settled(backend)
    before = backend.poses
    drive(backend, 3, 30)
    close_loop(backend)
    Watched.meet = fail
    for call in (backend.update, backend.update, backend.settle):
        with pytest.raises(MemoryError, match='no more'):
            call()
        assert backend.behind().failing
    np.testing.assert_array_equal(backend.poses[:3], before)
    Watched.meet = staticmethod(lambda: None)
    settled(backend)
    assert not backend.behind().failing and len(backend.poses) == 30
    assert set(states(backend).values()) == {'accepted'}


def test_what_has_come_is_in_the_map_before_any_work_behind_begins(graph):
    """On one core whoever publishes it would share that with the work."""
    backend, told = l1.Backend(EVERY), []
    drive(backend, 0, 30)
    settled(backend)
    drive(backend, 30, 60)
    assert backend.marginal_covariance(59) is None
    began = time.monotonic()
    improvement = backend.update(MOMENT, taken=lambda: told.append(
        backend.marginal_covariance(59)))
    known, = told
    assert known.shape == (3, 3) and np.linalg.eigvalsh(known)[0] > 0
    np.testing.assert_allclose(known, backend.marginal_covariance(59), rtol=1e-6)
    # Each metre adds its own.
    assert known[0, 0] == pytest.approx(59 * 1e-4, rel=1e-3)
    assert 0 < improvement.seconds <= time.monotonic() - began
    backend.close()


@pytest.mark.parametrize('interrupt', ['reset', 'settle', 'close', 'stopped', 'settle stopped'])
def test_work_is_interrupted_at_once(graph, interrupt):
    """What needs no solver does not interrupt it, and is not held up."""
    backend, stops = played(graph, 0, 100), interrupt.endswith('stopped')
    begun, stop, ended = threading.Event(), threading.Event(), []

    def stopped():
        """Be asked now and then by who works: this takes its time."""
        begun.set()
        stop.wait(MOMENT)
        return stops and stop.is_set()

    def update():
        with pytest.raises(Exception, match='^$') as caught:
            if interrupt == 'settle stopped':
                backend.settle(stopped)
            backend.update(DEADLINE, stopped)
        ended.append(type(caught.value).__name__)

    updating = meanwhile(update)
    assert begun.wait(DEADLINE)
    assert len(backend.poses) == 100 and updating.is_alive()
    if not stops:
        getattr(backend, interrupt)()
    stop.set()
    updating.join(DEADLINE)
    assert ended == ['Interrupted']
    assert len(backend.poses) == (0 if interrupt == 'reset' else 100)
    if interrupt == 'settle':
        best = l1.solve(backend.snapshot().graph).cost
        assert np.abs(whitened(backend.snapshot().graph, backend.poses)).sum() == pytest.approx(
            best, rel=1e-6)


def test_what_one_thread_sees_is_of_one_map_whatever_others_do():
    """Each map has a length of its steps of its own, and the stamps say which one it is."""
    backend, seen, over = l1.Backend(EVERY, background=True), [], threading.Event()

    def is_whole(stamps, poses):
        way = (stamps - stamps[:1]) / 1e9 * (1 + stamps[:1] / 1e12)
        return len(stamps) == len(poses) and np.allclose(poses[:, 0] - poses[:1, 0], way,
                                                         rtol=0, atol=1e-6)

    def read():
        while not over.is_set():
            now = backend.snapshot()
            seen.append(is_whole(now.stamps, now.poses)
                        and now.graph.n_poses == len(now.stamps)
                        and len(now.graph.between) == max(len(now.stamps) - 1, 0))

    readers = [meanwhile(read) for _ in range(2)]
    try:
        for first in range(0, 600, 100):
            for k in range(first, first + 50):
                drive(backend, k, k + 1, step=1 + first / 1e3)
                backend.update(0.0)
            now = backend.snapshot()
            backend.reset()
            assert len(now.stamps) == 50 and is_whole(now.stamps, now.poses)
    finally:
        over.set()
        for reader in readers:
            reader.join(DEADLINE)
        backend.close()
    assert len(seen) > 20 and all(seen)


def test_a_process_that_is_forked_has_a_back_end_at_rest(graph):
    """Threads do not come along, what they have locked does."""
    with played(graph) as plain, l1.Backend(EVERY, background=True) as backend:
        working = meanwhile(plain.settle)
        drive(backend, 0, 5)
        child = os.fork()
        if not child:
            try:
                drive(backend, 5, 7)
                backend.settle()
                backend.close()
            finally:
                os._exit(len(backend.poses))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        working.join(DEADLINE)
        wait_until(lambda: backend.behind().at_rest)
        assert len(backend.poses) == 5 and plain.behind().loops == 0
