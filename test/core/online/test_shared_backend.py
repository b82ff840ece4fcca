# SPDX-License-Identifier: Apache-2.0
"""Threads that meet at the back end: what one of them sees is whole, whatever the others do."""

import threading
from dataclasses import fields

import numpy as np
import pytest
from problems import covariance6, loop, odometry

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.online import shared_backend
from l1slam_ros.core.online.backend import BackendOptions, Improvement, improve
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loop_states import ACCEPTED
from l1slam_ros.core.online.shared_backend import SharedBackend

OPTIONS = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
DEADLINE = 30.0
# [s] What another thread would do at once if nothing held it up.
MOMENT = 0.3


def go_on():
    return False


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
    for k in range(first, last):
        backend.add_odometry(odometry(float(k + 1), (float(k), 0.0, 0.0),
                                      covariance6(1e-4 * np.eye(3))))


def meanwhile(work):
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_nobody_sees_a_keyframe_without_its_odometry(monkeypatch):
    backend, meeting, add_poses = SharedBackend(se2, OPTIONS), Meeting(), FactorGraph.add_poses
    drive(backend, 0, 1)

    def slowly(graph, count=1):
        add_poses(graph, count)
        meeting()

    monkeypatch.setattr(FactorGraph, 'add_poses', slowly)
    adding = meanwhile(lambda: drive(backend, 1, 2))
    state = meeting.look(backend.state)
    adding.join()
    assert len(state.stamps) - len(state.factors) == 1
    assert len(backend.state().stamps) == 2


def test_nobody_sees_new_poses_with_an_old_judgement(monkeypatch):
    backend, meeting = SharedBackend(se2, OPTIONS), Meeting()
    drive(backend, 0, 30)
    backend.add_loop(loop(1.0, 30.0, (28.9, 0.0, 0.0), 1e-8 * np.eye(6)))
    before = backend.state()

    class Slow(Improvement):
        def __getattribute__(self, name):
            get = super().__getattribute__
            if name == 'belief' and backend._backend._poses is get('poses'):
                meeting()  # half of it has been taken over
            return get(name)

    def slowly(*arguments):
        made = improve(*arguments)
        return Slow(**{field.name: getattr(made, field.name) for field in fields(made)})

    monkeypatch.setattr(shared_backend, 'improve', slowly)
    updating = meanwhile(lambda: backend.update(DEADLINE, go_on))
    seen = meeting.look(backend.state)
    updating.join()
    after = backend.state()
    assert (before.poses != after.poses).any() and after.loops.state.tolist() == [ACCEPTED]
    new_poses = (seen.poses == after.poses).all()
    assert new_poses == (seen.loops.state == after.loops.state).all()


def test_what_was_made_of_a_map_that_was_replaced_is_not_adopted(monkeypatch):
    backend, meeting = SharedBackend(se2, OPTIONS), Meeting()
    drive(backend, 0, 5)
    ended = []

    def slowly(problem, options, budget, check):
        made = improve(problem, options, budget)  # deaf to what it is told
        meeting()
        return made

    def update():
        try:
            ended.append(backend.update(DEADLINE, go_on))
        except Interrupted as interrupted:
            ended.append(interrupted)

    monkeypatch.setattr(shared_backend, 'improve', slowly)
    updating = meanwhile(update)
    meeting.look(backend.reset)
    updating.join()
    assert isinstance(ended[0], Interrupted) and not len(backend.state().poses)
    drive(backend, 100, 102)
    np.testing.assert_allclose(backend.state().poses[:, 0], [100, 101])


def patient(problem, options, budget, check):
    """Stand for an update of a huge map: it ends when it is told to."""
    while True:
        check()


@pytest.mark.parametrize('interrupt', ['reset', 'restore', 'optimise', 'stopped'])
def test_an_update_is_interrupted_at_once(monkeypatch, interrupt):
    backend, stopped, begun = SharedBackend(se2, OPTIONS), threading.Event(), threading.Event()
    drive(backend, 0, 5)
    now = backend.snapshot()

    def update():
        with pytest.raises(Interrupted):
            backend.update(DEADLINE, lambda: begun.set() or stopped.is_set())

    monkeypatch.setattr(shared_backend, 'improve', patient)
    updating = meanwhile(update)
    assert begun.wait(DEADLINE)
    # What needs no solver does not interrupt it, and is not held up.
    assert len(backend.snapshot().poses) == 5 and updating.is_alive()
    drive(backend, 5, 6)
    assert backend.counts()[0]['keyframes'] == 6 and updating.is_alive()
    if interrupt == 'optimise':
        assert backend.optimise(go_on).cost == pytest.approx(0.0, abs=1e-6)
    elif interrupt == 'restore':
        backend.restore(now.graph, now.poses, now.stamps)
    elif interrupt == 'reset':
        backend.reset()
    else:
        stopped.set()
    updating.join(DEADLINE)
    assert not updating.is_alive()


def test_at_rest_nothing_is_looked_at_until_something_comes(monkeypatch):
    backend = SharedBackend(se2, OPTIONS)
    drive(backend, 0, 30)

    def settle():
        for count in range(100):
            if backend.update(DEADLINE, go_on) is None:
                return count
        raise AssertionError('never at rest')

    assert settle() > 0
    looked = []
    snapshot = backend._backend.snapshot
    monkeypatch.setattr(backend._backend, 'snapshot', lambda: looked.append(1) or snapshot())
    version = backend.version
    backend.counts()
    looked.clear()
    assert backend.update(DEADLINE, go_on) is None
    backend.counts()
    assert not looked and backend.version == version
    backend.add_loop(loop(1.0, 30.0, (28.9, 0.0, 0.0), 1e-4 * np.eye(6)))
    assert backend.version != version
    assert settle() > 0 and backend.loop_states().state.tolist() == [ACCEPTED]
    drive(backend, 30, 31)
    assert settle() > 0 and len(backend.state().poses) == 31
    # A loop that waits for odometry which makes no keyframe.
    backend.set_options(BackendOptions(KeyframeOptions(1e6, 0.0, 0.0), OPTIONS.odometry))
    backend.add_loop(loop(2.0, 33.0, (30.9, 0.0, 0.0), 1e-4 * np.eye(6)))
    assert settle() == 0
    drive(backend, 32, 33)
    assert settle() > 0 and len(backend.loop_states().rows) == 2
