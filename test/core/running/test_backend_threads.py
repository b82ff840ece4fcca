# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Threads that meet at the back end: what one of them sees is whole, whatever the others do."""

import os
import sys
import threading
import time
from dataclasses import fields, replace

import numpy as np
import pytest
from problems import EVERY, covariance6, drive_on, loop, odometry, straight

from l1slam_ros.core.bordered.front import Front
from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.online.keyframes import KeyframeOptions
from l1slam_ros.core.robust import batch
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.improve import Improvement, improve
from l1slam_ros.core.running.keeper import updates, work
from l1slam_ros.core.running.keeper.workers import Background, Worker
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.solvers.optimality import l1_cost

DEADLINE = 30.0
# [s] What another thread would do at once if nothing held it up.
MOMENT = 0.3


class Meeting:
    """A place in one thread where another one is let in; if a lock holds it off, not for long."""

    def __init__(self):
        self.reached, self.seen = threading.Event(), threading.Event()

    def __call__(self):
        self.reached.set()
        self.seen.wait(MOMENT)

    def look(self, what):
        """Return what another thread sees there."""
        assert self.reached.wait(DEADLINE)
        result = what()
        self.seen.set()
        return result


def drive(backend, first, last):
    drive_on(backend, straight(last), first, covariance6(1e-4 * np.eye(3)), 1.0, 1.0)


def meanwhile(work):
    thread = threading.Thread(target=work)
    thread.start()
    return thread


@pytest.mark.skipif(sys.platform != 'linux', reason='elsewhere threads have no priority')
def test_work_behind_makes_way_for_updates(monkeypatch):
    def nice():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def noting(name, carry_out):
        def noted(*given):
            of_workers[name] = nice()
            carry_out(*given)

        return noted

    of_workers = {}
    for name in 'make_map', 'judge_all':
        monkeypatch.setattr(work, name, noting(name, getattr(work, name)))
    with Backend(EVERY) as backend:
        drive(backend, 0, 3)
        backend.add_loop(loop(1.0, 3.0, [2, 0, 0], covariance6(1e-2 * np.eye(3))))
        while backend.update(DEADLINE) is not None:
            pass
        updating = nice()
    assert of_workers.keys() == {'make_map', 'judge_all'}
    assert min(of_workers.values()) > updating


def test_nobody_sees_a_keyframe_without_its_odometry(monkeypatch):
    backend = Backend(EVERY)
    meeting = Meeting()
    add_poses = FactorGraph.add_poses
    drive(backend, 0, 1)

    def slowly(graph, *given, **how):
        add_poses(graph, *given, **how)
        meeting()

    monkeypatch.setattr(FactorGraph, 'add_poses', slowly)
    adding = meanwhile(lambda: drive(backend, 1, 2))
    state = meeting.look(backend.snapshot)
    adding.join()
    assert len(state.stamps) - len(state.graph.between) == 1
    assert len(backend.snapshot().stamps) == 2


def test_nobody_sees_the_front_of_one_map_with_the_poses_of_another(monkeypatch):
    backend, meeting = Backend(EVERY), Meeting()
    drive(backend, 0, 30)
    backend.update(DEADLINE)
    backend.add_loop(loop(1.0, 30.0, (28.9, 0.0, 0.0), 1e-8 * np.eye(6)))

    class Slow(Improvement):
        def __getattribute__(self, name):
            if name == 'judgement':
                meeting()  # it is being taken over
            return super().__getattribute__(name)

    def slowly(*arguments):
        made = improve(*arguments)
        return Slow(**{field.name: getattr(made, field.name) for field in fields(made)})

    monkeypatch.setattr(work, 'improve', slowly)
    # The first one leaves the loop to the front.
    updating = meanwhile(lambda: [backend.update(DEADLINE) for _ in range(2)])
    seen = meeting.look(backend.snapshot)
    updating.join()
    after = backend.snapshot()
    assert after.loop_states().state.tolist() == [ACCEPTED]
    assert (seen.poses == seen.state.optimised.poses).all() or (
        seen.state.optimised.poses != after.state.optimised.poses).any()


def test_what_has_come_is_in_the_map_before_any_work_behind_begins(monkeypatch):
    """On one core whoever publishes it would share that with the work."""
    backend, told = Backend(EVERY), []
    drive(backend, 0, 30)
    while backend.update(DEADLINE) is not None:
        pass
    drive(backend, 30, 60)

    def work_behind(*_):
        told.append('work behind')
        time.sleep(MOMENT)

    monkeypatch.setattr(updates, 'carry_out', work_behind)
    improvement = backend.update(MOMENT / 2, taken=lambda: told.append(
        len(backend.snapshot().views[0].poses)))
    assert told[:2] == [60, 'work behind']
    # What it says of itself is when the map was there, and not the wait after that.
    assert improvement.seconds < MOMENT / 2
    backend.close()


def test_nobody_sees_the_front_of_a_map_that_was_replaced(monkeypatch):
    backend, views = Backend(EVERY), Front.views.fget
    drive(backend, 0, 5)
    while backend.update(DEADLINE) is not None:
        pass

    def slowly(front):
        seen = views(front)
        backend.reset()
        return seen

    monkeypatch.setattr(Front, 'views', property(slowly))
    now = backend.snapshot()
    assert len(now.poses) == now.graph.n_poses == 0


def test_nobody_follows_the_end_of_a_map_that_was_replaced(monkeypatch):
    backend, poses_of = Backend(EVERY), Front.poses_of
    drive(backend, 0, 5)
    while backend.update(DEADLINE) is not None:
        pass

    def slowly(front, keyframes):
        seen = poses_of(front, keyframes)
        backend.reset()
        drive(backend, 100, 102)
        return seen

    drive(backend, 5, 6)
    with monkeypatch.context() as patched:
        patched.setattr(Front, 'poses_of', slowly)
        with pytest.raises(Interrupted):
            backend.update(DEADLINE)
    now = backend.snapshot()
    np.testing.assert_allclose(now.poses[:, 0], [100, 101])
    np.testing.assert_allclose(now.map_to_odom, np.zeros((1, 3)))


def test_what_was_made_of_a_map_that_was_replaced_is_not_adopted(monkeypatch):
    backend, meeting = Backend(EVERY), Meeting()
    drive(backend, 0, 5)
    ended = []

    def slowly(problem, options, budget, check, exact):
        made = improve(problem, options, budget)  # deaf to what it is told
        meeting()
        return made

    def update():
        try:
            ended.append(backend.update(DEADLINE))
        except Interrupted as interrupted:
            ended.append(interrupted)

    monkeypatch.setattr(work, 'improve', slowly)
    updating = meanwhile(update)
    meeting.look(backend.reset)
    updating.join()
    assert isinstance(ended[0], Interrupted) and not len(backend.snapshot().poses)
    drive(backend, 100, 102)
    np.testing.assert_allclose(backend.snapshot().poses[:, 0], [100, 101])


def test_messages_and_updates_do_not_wait_while_the_next_state_is_worked_out():
    backend, seen = Backend(EVERY), []
    drive(backend, 0, 5)
    backend.settle()

    def transition(state, factors):
        seen.append((state, len(factors)))
        if len(seen) <= 3:
            other = meanwhile(lambda: (drive(backend, 4 + len(seen), 5 + len(seen)),
                                       backend.update(0.0)))
            other.join(DEADLINE)
            assert not other.is_alive()
        return state._replace(made=float(len(seen)))

    with backend.calm:
        backend._keeper.change(backend.snapshot().map, transition)
    # Each time the state was another one by then; the fourth time nothing could come in.
    assert [count for _, count in seen] == [4, 5, 6, 7]
    assert len({id(state) for state, _ in seen}) == 4
    assert backend._keeper.state.made == 4.0


def test_what_a_person_says_while_the_next_state_is_worked_out_holds():
    backend = Backend(EVERY)
    drive(backend, 0, 9)
    found = loop(1, 9, (8.0, 0.0, 0.0), covariance6(1e-4 * np.eye(3)))
    backend.add_loop(found)
    backend.settle()
    row = int(backend.snapshot().loop_rows[0])
    assert backend.snapshot().judgement.accepted[row]

    def refused(state, factors):
        other = meanwhile(lambda: (backend.add_loop(replace(found, trusted=True)),
                                   backend.snapshot()))
        other.join(MOMENT)
        judgement = state.table.judgement(state.of_all)
        accepted = judgement.accepted.copy()
        accepted[row] = False
        return state._replace(table=state.table.judged(
            replace(judgement, accepted=accepted), factors))

    with backend.calm:
        backend._keeper.change(backend.snapshot().map, refused)
    assert backend._keeper.look()[1].trusted[row]
    assert backend._keeper.state.table.accepted[row]


def patient(problem, options, budget, check, exact):
    """Stand for an update of a huge map: it ends when it is told to."""
    while True:
        check()


@pytest.mark.parametrize('interrupt', ['reset', 'restore', 'settle', 'stopped'])
def test_an_update_is_interrupted_at_once(monkeypatch, interrupt):
    backend = Backend(EVERY)
    stopped = threading.Event()
    begun = threading.Event()
    drive(backend, 0, 5)
    now = backend.saved()

    def update():
        with pytest.raises(Interrupted):
            backend.update(DEADLINE, lambda: begun.set() or stopped.is_set())

    monkeypatch.setattr(work, 'improve', patient)
    updating = meanwhile(update)
    assert begun.wait(DEADLINE)
    # What needs no solver does not interrupt it, and is not held up.
    assert len(backend.snapshot().poses) == 5 and updating.is_alive()
    drive(backend, 5, 6)
    assert backend.counts()[0]['keyframes'] == 6 and updating.is_alive()
    if interrupt == 'settle':
        assert backend.settle().cost == pytest.approx(0.0, abs=1e-6)
    elif interrupt == 'restore':
        backend.restore(now)
    elif interrupt == 'reset':
        backend.reset()
    else:
        stopped.set()
    updating.join(DEADLINE)
    assert not updating.is_alive()


def test_at_rest_nothing_is_looked_at_until_something_comes(monkeypatch):
    backend = Backend(EVERY)
    drive(backend, 0, 30)

    def settle():
        for count in range(100):
            if backend.update(DEADLINE) is None:
                return count
        raise AssertionError('never at rest')

    assert settle() > 0
    looked = []
    standing = backend._keeper.standing
    monkeypatch.setattr(backend._keeper, 'standing', lambda: looked.append(1) or standing())
    revisions = backend.revisions
    backend.counts()
    looked.clear()
    assert backend.update(DEADLINE) is None
    backend.counts()
    assert not looked and backend.revisions is revisions
    backend.add_loop(loop(1.0, 30.0, (28.9, 0.0, 0.0), 1e-4 * np.eye(6)))
    assert backend.revisions.now > revisions.now
    assert settle() > 0 and backend.loop_states().state.tolist() == [ACCEPTED]
    drive(backend, 30, 31)
    assert settle() > 0 and len(backend.snapshot().poses) == 31
    # A loop that waits for odometry which makes no keyframe.
    backend.set_options(BackendOptions(KeyframeOptions(1e6, 0.0, 0.0), EVERY.odometry))
    backend.add_loop(loop(2.0, 33.0, (30.9, 0.0, 0.0), 1e-4 * np.eye(6)))
    assert settle() == 0
    drive(backend, 32, 33)
    assert settle() > 0 and len(backend.loop_states().rows) == 2


def test_a_map_of_nothing_is_not_asked_whether_it_hangs_on_its_norm(monkeypatch):
    """To compiled loops it would be memory of others."""
    asked, least_squares = [], batch._least_squares
    monkeypatch.setattr(batch, '_least_squares', lambda graph, *rest: (
        asked.append(graph.n_poses) or least_squares(graph, *rest)))
    backend = Backend(EVERY)
    for count in 5, 0, 1:
        drive(backend, 0, count)
        while backend.update(DEADLINE) is not None:
            pass
        backend.reset()
    assert asked == [5]


def test_a_settle_lets_a_fork_through_and_comes_to_its_end(monkeypatch):
    backend = Backend(EVERY)
    begun = threading.Event()
    solve = updates.optimise
    calls = []
    drive(backend, 0, 5)

    def slowly(problem, options, check):
        calls.append(1)
        begun.set()
        while len(calls) == 1:
            check()
        return solve(problem, options, check)

    monkeypatch.setattr(updates, 'optimise', slowly)
    found = []
    settling = meanwhile(lambda: found.append(backend.settle()))
    assert begun.wait(DEADLINE)
    with backend.alone(urgent=True):
        assert not found
    settling.join(DEADLINE)
    assert len(calls) == 2 and found[0].cost == pytest.approx(0.0, abs=1e-6)


# In the background


def wait_until(holds):
    end = time.monotonic() + DEADLINE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.001)


def of_threads():
    return [thread for thread in threading.enumerate() if thread.name == 'updates']


def test_in_the_background_what_comes_is_judged_and_the_thread_ends():
    with Backend(EVERY, background=True) as backend:
        drive(backend, 0, 30)
        backend.add_loop(loop(1.0, 30.0, (28.9, 0.0, 0.0), 1e-4 * np.eye(6)))
        wait_until(lambda: backend.loop_states().state.tolist() == [ACCEPTED])
        wait_until(lambda: backend.update() is None)
        now = backend.saved()
        # A map that takes the place of another is woken for too.
        backend.restore(now)
        wait_until(lambda: backend.snapshot().state.optimised.at_rest)
        assert len(of_threads()) == 1
    assert not of_threads()
    drive(backend, 30, 31)
    assert backend.update() is not None


def test_what_goes_on_behind_keeps_its_order_while_the_map_grows():
    """Five keyframes with a loop each are enough for the next map, and it is not ordered anew."""
    with Backend(EVERY) as backend:
        drive(backend, 0, 60)
        settled, found = backend.settle(), backend._keeper._front.pattern.found
        drive(backend, 60, 64)
        backend.update(MOMENT)
        assert backend._keeper.state.last is settled
        for k in range(60, 65):
            backend.add_loop(loop(float(k - 20), float(k), (20.0, 0.0, 0.0), 1e-4 * np.eye(6)))
        drive(backend, 64, 65)
        deadline = time.monotonic() + DEADLINE
        while backend._keeper.state.last is settled and time.monotonic() < deadline:
            backend._updates.update(MOMENT, lambda: False, idle=False)
        assert backend._keeper.state.last is not settled
        front = backend._keeper._front
        assert (front.keyframes, front.pattern.found) == (65, found)


def test_a_judgement_that_doubts_itself_is_followed_by_one_from_the_graph_alone(monkeypatch):
    """Not only at rest: what was believed early may keep out what came after it."""
    anew, solve = [], work.robust_solve
    monkeypatch.setattr(
        work, 'robust_solve', lambda *given, **how: anew.append(1) or solve(*given, **how))
    covariance = 1e-4 * np.eye(6)
    with Backend(EVERY) as backend:
        for k, aside in enumerate([0.0] * 20 + [6.0] * 60):
            drive(backend, k, k + 1)
            if k >= 15:  # five that are true, and many that are not, nor alike
                backend.add_loop(loop(float(k - 10), float(k), (10.0, aside * k, 0.0), covariance))
        deadline = time.monotonic() + DEADLINE
        while not anew and time.monotonic() < deadline:
            backend._updates.update(MOMENT, lambda: False, idle=False)
        assert anew and backend.snapshot().judgement.is_refusal_doubted


def test_in_the_background_an_update_never_waits_for_the_workers(monkeypatch):
    begun = threading.Event()
    monkeypatch.setattr(work, 'improve', lambda *a: begun.set() or patient(*a))
    with Backend(EVERY, background=True) as backend:
        drive(backend, 0, 5)
        assert begun.wait(DEADLINE)
        start = time.monotonic()
        assert backend.update(DEADLINE) is not None
        assert time.monotonic() - start < 1.0
        # Nor for its own thread, which leaves the updates to who calls them.
        updates_of = backend._updates.update
        helped = []
        monkeypatch.setattr(backend._updates, 'update', lambda budget, stopped, idle=None, **how: (
            helped.append(idle) or updates_of(budget, stopped, idle, **how)))
        for k in range(5, 15):
            drive(backend, k, k + 1)
            backend.update(0.0)
        assert helped == 10 * [None]
        wait_until(lambda: True in helped)


def test_the_background_looks_again_when_nothing_comes_any_more():
    calls = []
    background = Background(lambda idle, _: calls.append(idle) or not idle, 0.01)
    background.wake()
    wait_until(lambda: calls == [False, True])
    background.close()


def drive_square(backend, side, more, rng):
    """Drive round a square, in steps of 1 m, and see its beginning again at its end."""
    n, sigma = 4 * side, np.array([0.05, 0.05, 0.002])
    steps = np.tile([1.0, 0.0, 0.0], (n + more, 1))
    steps[side - 1::side, 2] = np.pi / 2
    measured = se2.retract(steps, sigma * rng.standard_normal(steps.shape))
    pose, covariance = se2.identity(1), covariance6(np.diag(sigma**2))
    for k, step in enumerate(measured):
        backend.add_odometry(odometry(float(k), pose[0], covariance))
        pose = se2.compose(pose, step[None])
        if k >= n:
            seen = se2.retract(se2.identity(1), sigma * rng.standard_normal((1, 3)))
            backend.add_loop(loop(float(k - n), float(k), seen[0], covariance))


def test_a_square_that_closes_after_3000_keyframes_is_right_soon(rng):
    with Backend(EVERY, background=True) as backend:
        drive_square(backend, 750, 20, rng)
        wait_until(lambda: (backend.loop_states().state == ACCEPTED).sum() == 20)
        wait_until(lambda: backend.update(0.0) is None)
        found = backend.snapshot()
        backend.settle()
        cost, best = (l1_cost(whitened_residual(found.graph, poses))
                      for poses in (found.poses, backend.poses))
    # Some loops may have bent it first where all together would not: it can rest above the best.
    assert cost < 1.2 * best
    assert np.linalg.norm(found.poses[3000, :2]) < 1.0


@pytest.mark.parametrize('end', ['close', 'settle', 'reset'])
def test_the_background_makes_way(monkeypatch, end):
    begun = threading.Event()
    monkeypatch.setattr(work, 'improve', lambda *a: begun.set() or patient(*a))
    with Backend(EVERY, background=True) as backend:
        drive(backend, 0, 5)
        assert begun.wait(DEADLINE)
        ended = meanwhile(getattr(backend, end))
        ended.join(DEADLINE)
        assert not ended.is_alive()
        assert len(of_threads()) == (end != 'close')
    assert not of_threads()


def test_work_behind_waits_while_there_is_calm_and_makes_way_all_the_same():
    backend, solved = Backend(EVERY), []
    drive(backend, 0, 20)
    with backend.calm:
        solving = meanwhile(lambda: solved.append(backend.settle()))
        solving.join(MOMENT)
        assert not solved
    solving.join(DEADLINE)
    assert solved[0] is not None
    drive(backend, 20, 21)
    asked = iter([False] * 4)
    with backend.calm, pytest.raises(Interrupted):
        backend.settle(lambda: next(asked, True))


def test_a_process_that_is_forked_has_a_back_end_at_rest(monkeypatch):
    """Threads do not come along, what they have locked does: numba's lock, for one."""
    begun, numba = threading.Event(), threading.Lock()

    def improve(*arguments):
        with numba:
            begun.set()
            patient(*arguments)

    monkeypatch.setattr(work, 'improve', improve)
    with Backend(EVERY, background=True) as backend:
        drive(backend, 0, 5)
        assert begun.wait(DEADLINE)
        begun.clear()
        child = os.fork()
        if not child:
            try:
                drive(backend, 5, 6)
                backend.settle()
                backend.close()
            finally:
                os._exit(numba.acquire(blocking=False) and len(backend.poses))
        wait_until(lambda: os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 6
        assert begun.wait(DEADLINE)


def test_what_fails_in_the_background_is_raised_at_the_end(monkeypatch):
    failed = threading.Event()

    def fail(*_):
        failed.set()
        raise MemoryError('no more')

    monkeypatch.setattr(work, 'improve', fail)
    with pytest.raises(MemoryError, match='no more'), Backend(EVERY, background=True) as backend:
        drive(backend, 0, 5)
        assert failed.wait(DEADLINE)
    assert not of_threads()
    backend.close()


def test_what_fails_before_an_update_looks_whether_it_is_at_work_is_not_forgotten(monkeypatch):
    begin = Worker.start

    def start(worker, work):
        begin(worker, work)
        worker.join()

    def fail(*_):
        raise ValueError('injected')

    monkeypatch.setattr(Worker, 'start', start)
    backend = Backend(EVERY)
    with monkeypatch.context() as context:
        context.setattr(work, 'improve', fail)
        drive(backend, 0, 3)
        for _ in range(4):
            with pytest.raises(ValueError, match='injected'):
                backend.update()
            assert backend.behind().failing
    while backend.update():
        pass
    assert not backend.behind().failing and len(backend.poses) == 3


def test_work_does_not_begin_before_who_started_it_can_go_on(monkeypatch):
    begun = threading.Event()

    class Slow(threading.Thread):
        def start(self):
            super().start()
            assert not begun.wait(MOMENT)

    monkeypatch.setattr(threading, 'Thread', Slow)
    Worker('slow', lambda: None).start(begun.set)
    assert begun.wait(DEADLINE)


def test_several_threads_may_settle_at_once():
    backend, found = Backend(EVERY), []
    drive(backend, 0, 200)
    backend.add_loop(loop(3.0, 150.0, [147.0, 0.0, 0.0]))

    def settle():
        try:
            found.append(backend.settle())
        except BaseException as error:
            found.append(error)

    threads = []
    for _ in range(6):
        threads.append(meanwhile(settle))
        time.sleep(0.01)
    for thread in threads:
        thread.join(DEADLINE)
    assert [type(one) for one in found] == 6 * [Improvement]
    assert [len(one.poses) for one in found] == 6 * [200]


def test_who_waits_to_settle_can_be_told_to_stop(monkeypatch):
    backend, meeting = Backend(EVERY), Meeting()
    drive(backend, 0, 20)
    optimise = updates.optimise
    monkeypatch.setattr(updates, 'optimise', lambda *given: (meeting(), optimise(*given))[1])
    first = meanwhile(backend.settle)

    def stopped():
        with pytest.raises(Interrupted):
            backend.settle(lambda: True)
        return first.is_alive()

    assert meeting.look(stopped)
    first.join(DEADLINE)
