# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Callbacks, services and the solver side by side: who waits for whom, and in which order."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from node_bench import begin, call, loop, odometry
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

import l1slam_ros as l1
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.keeper import updates, work
from l1slam_ros.io.messages import conversion
from l1slam_ros.ros import publishing
from l1slam_ros.ros.threads import solver_thread

DEADLINE = 60.0


@pytest.fixture
def compiling(monkeypatch):
    """Let compiling last until the event that is returned is set, or the node ends."""
    finish = threading.Event()

    def fill_cache(report, stopped, steps):
        report(1, 2)
        while not stopped() and not finish.wait(0.01):
            pass

    monkeypatch.setattr(solver_thread, 'fill_cache', fill_cache)
    monkeypatch.setattr(solver_thread, '_WORTH_TELLING', 0.0)
    return finish


def test_while_the_solver_is_compiled_all_else_is_served(bench, compiling, tmp_path, capfd):
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 4)
    b.until(lambda: len(b.received['pose']) == 4, 'odometry is answered')
    assert call(b, 'save').message.startswith('4 keyframes saved')
    assert call(b, 'pause', SetBool.Request(data=False)).success
    assert call(b, 'reset').success and call(b, 'load').success
    b.until(lambda: b.status()[1] == 'compiling the solver: 1 of 2', 'it says how far it is')
    said = []
    b.until(lambda: said.append(capfd.readouterr().err)
            or 'compiling the solver, once on a machine: 1 of 2' in ''.join(said), 'it is logged')
    waiting = begin(b, 'optimize')
    b.drive(4, 6)
    b.until(lambda: b.status()[2]['odom.received'] == '6', 'odometry is taken in')
    assert not waiting.done() and not b.received['path']
    compiling.set()
    b.until(waiting.done, 'optimize is answered')
    assert waiting.result().success
    b.until(lambda: len(b.path().poses) == 6, 'the map with all that came meanwhile')


def test_the_node_ends_while_the_solver_is_compiled(bench, compiling):
    b = bench()
    assert b.backend.close(DEADLINE)


def test_callbacks_need_no_compiled_code(tmp_path):
    """A node that only listens, saves and tells: without numba, which cannot be imported."""
    done = subprocess.run([sys.executable, '-c', """
import sys
sys.modules['numba'] = None
from pathlib import Path
from problems import loop, odometry
from l1slam_ros.ros import node
from l1slam_ros.io.node_options import NodeOptions
import l1slam_ros as l1
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.io.graphs.saved_map import load_map, save_map
backend = Backend(NodeOptions())
for k in range(20):
    backend.add_odometry(odometry(k + 1.0, (k, 0.0, 0.0)))
backend.add_loop(loop(1.0, 20.0, (19.0, 0.0, 0.0)))
assert backend.loop_states().state.tolist() == [1] and backend.counts()[0]['keyframes'] == 20
path = Path(sys.argv[1])
assert save_map(path, backend.saved()).startswith('20 keyframes')
backend.restore(load_map(path)[0])
assert len(backend.snapshot().poses) == 20
""", str(tmp_path / 'map.g2o')], capture_output=True, text=True, timeout=DEADLINE,
                          cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr


def test_orders_are_carried_out_in_the_order_they_came(bench):
    b = bench()
    begin, done = threading.Event(), []
    jobs = [b.backend._jobs.put('first', lambda: str(begin.wait(DEADLINE)))]
    for k in range(20):
        jobs.append(b.backend._jobs.put('next', lambda k=k: str(done.append(k))))
    begin.set()
    b.until(lambda: all(job.done() for job in jobs), 'all are answered')
    assert done == list(range(20))
    assert all(job.result().success for job in jobs)


def patient(problem, options, budget, check, exact):
    """Stand for an update of a huge map: it ends when it is told to."""
    while True:
        check()


def test_services_do_not_wait_for_an_update(bench, monkeypatch, tmp_path):
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    began, improve = threading.Event(), work.improve
    monkeypatch.setattr(work, 'improve', lambda *a: began.set() or patient(*a))
    b.drive(3, 5)
    b.until(began.is_set, 'an update that takes for ever')
    assert call(b, 'save').message.startswith('5 keyframes')
    assert call(b, 'optimize').success
    b.until(lambda: len(b.path().poses) == 5, 'the optimised map')
    assert call(b, 'reset').success
    b.until(lambda: len(b.path().poses) == 0, 'the map is empty')
    assert call(b, 'load').success
    b.until(lambda: len(b.path().poses) == 5, 'the map is back')
    assert call(b, 'pause', SetBool.Request(data=True)).success
    b.until(lambda: not b.backend._backend._updates._update_lock.locked(), 'the update stops')
    monkeypatch.setattr(work, 'improve', improve)
    assert call(b, 'pause', SetBool.Request(data=False)).success
    b.drive(5, 8)
    b.until(lambda: len(b.path().poses) == 8, 'updates go on')


def test_the_path_does_not_wait_for_the_work_behind_an_update(bench, monkeypatch):
    b, began = bench(**{'update.budget': 600.0}), threading.Event()
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    monkeypatch.setattr(work, 'improve', lambda *a: began.set() or patient(*a))
    b.drive(3, 40)
    b.until(began.is_set, 'an update that takes for ever')
    b.until(lambda: len(b.path().poses) > 3, 'the Path of what had come')


def test_updates_do_not_wait_for_the_path_of_a_large_map(bench, monkeypatch):
    monkeypatch.setattr(publishing, '_LARGE', 2)
    b = bench()
    goes_on = threading.Event()
    made = publishing.path_bytes
    b.drive(0, 4)
    b.until(lambda: len(b.path().poses) == 4, 'a map, by the thread of a large one')
    monkeypatch.setattr(
        publishing, 'path_bytes', lambda *of: goes_on.wait(DEADLINE) and made(*of))
    b.drive(4, 9)
    b.until(lambda: len(b.backend._backend.snapshot().state.optimised.poses) == 9,
            'the map has all keyframes')
    assert len(b.path().poses) == 4
    goes_on.set()
    b.until(lambda: len(b.path().poses) == 9, 'the Path has them, too')


def test_a_backlog_is_taken_over_from_dds_and_answered_at_its_end(bench, monkeypatch):
    """More than the thousand messages that DDS queues up come while the first are in work."""
    b = bench()
    permits, decoded = threading.Semaphore(0), conversion.odometry_in
    monkeypatch.setattr(
        conversion, 'odometry_in', lambda data: permits.acquire() and decoded(data))

    def stand(first, last):
        for k in range(first, last):
            b.publishers['/odom'].publish(odometry((k + 1) * 10**7, 0.0))

    stand(0, 900)
    permits.release(150)
    b.until(lambda: b.backend._inputs.traffic['odom'].received > 150, 'some are used')
    stand(900, 1800)
    permits.release(1800)
    b.until(lambda: b.status()[2].get('odom.received') == '1800', 'all are used')
    assert b.status()[2]['odom.lost'] == '0'
    b.until(lambda: b.received['pose'] and b.received['pose'][-1].header.stamp.sec == 18,
            'the newest is answered')
    assert len(b.received['pose']) <= 150 + 5


@pytest.mark.skipif(sys.platform != 'linux', reason='elsewhere threads have no priority')
def test_what_works_behind_makes_way_for_messages(bench):
    b = bench()
    b.until(lambda: b.received['/diagnostics'], 'the node is up')
    nice = {thread.name: os.getpriority(os.PRIO_PROCESS, thread.native_id)
            for thread in threading.enumerate()}
    assert nice['MainThread'] == nice['intake'] == nice['solver'] < nice['services']


def test_messages_of_all_topics_are_used_in_the_order_they_came(bench, monkeypatch):
    b = bench()
    go_on = threading.Event()
    used = []
    backend = b.backend._backend
    monkeypatch.setattr(backend, 'add_odometry', lambda s, _: used.append(
        s.stamp) or go_on.wait())
    monkeypatch.setattr(backend, 'add_loop', lambda one: used.append(one.stamp))
    sent = [10**9 * k for k in range(1, 41)]
    for k, stamp in enumerate(sent):
        if k % 3 == 2:
            b.send('/loop_closures', loop(stamp, frame='base_link@0.500000000'))
        else:
            b.send('/odom', odometry(stamp, 0.0))
    go_on.set()
    b.until(lambda: len(used) == len(sent), 'all are used')
    assert used == sent


def test_optimize_is_done_though_the_map_is_replaced_meanwhile(bench, monkeypatch):
    """By a parameter that lets all loops be judged anew: it is no end of the node."""
    b = bench()
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    began, optimise = threading.Event(), updates.optimise

    def interrupted(problem, options, check):
        while not began.is_set():
            began.set()
            while True:
                check()
        return optimise(problem, options, check)

    monkeypatch.setattr(updates, 'optimise', interrupted)
    answer = begin(b, 'optimize')
    b.until(began.is_set, 'it is at work')
    assert b.backend.set_parameters([Parameter('robust.enabled', value=False)])[0].successful
    b.until(answer.done, 'optimize is answered')
    assert answer.result().success, answer.result().message


def test_optimize_answers_of_the_map_there_is_where_one_is_emptied_behind_it(bench, monkeypatch):
    b = bench()
    b.drive(0, 3)
    b.until(lambda: len(b.path().poses) == 3, 'a map')
    settle = Backend.settle

    def settled(backend, stopped):
        improvement = settle(backend, stopped)
        if improvement is not None:
            backend.reset()
        return improvement

    monkeypatch.setattr(Backend, 'settle', settled)
    assert call(b, 'optimize').message == 'there are no factors yet'


def test_what_a_full_queue_has_dropped_is_said_to_be_lost(bench, monkeypatch):
    b = bench()
    go_on, decoded = threading.Event(), conversion.odometry_in
    monkeypatch.setattr(conversion, 'odometry_in', lambda data: go_on.wait() and decoded(data))
    for k in range(3000):
        b.publishers['/odom'].publish(odometry((k + 1) * 10**9, 0.0))
    go_on.set()
    b.until(lambda: int(b.status()[2].get('odom.received', 0)) >= 1000, 'a part comes')
    b.until(lambda: sum(int(b.status()[2][f'odom.{name}']) for name in ('received', 'lost'))
            == 3000, 'all are accounted for')
    _, _, values = b.status()
    assert int(values['odom.lost']) > 0 and float(values['odom.rate']) > 0
    assert values['loop_closures.received'] == '0'


def test_no_executor_is_woken_by_a_message(bench):
    """Each time it would make its wait set anew, ten times the work of a message."""
    b = bench(**{'robust.enabled': False})
    b.until(lambda: b.received['/diagnostics'], 'the node is up')
    took = [one for one in (*b.backend.subscriptions, *(
        event for one in b.backend.subscriptions for event in one.event_handlers))
        if b.executor.can_execute(one)]
    assert {one.topic_name for one in took if hasattr(one, 'topic_name')} <= {
        '/clock', '/parameter_events'} and all(hasattr(one, 'topic_name') for one in took)


def test_of_robots_that_nobody_named_only_the_first_are_kept(bench):
    b = bench(robots=['r1', 'r2'])
    b.send('/r1/odom', odometry(10**9, 0.0))
    for k in range(60):
        b.send('/r1/loop_closures', loop(5 * 10**9, frame=f'x{k}/base_link@1.000000000'))
    b.until(lambda: b.count('refused.robot') == 60, 'they are counted')
    assert len(b.backend._inputs._strangers) == 21


def keyframes(path):
    return l1.read_graph(path)[0].n_poses if path.exists() else 0


def test_the_map_is_saved_whatever_a_service_works_at(bench, tmp_path, monkeypatch):
    path, optimise = tmp_path / 'map.g2o', updates.optimise
    begun, finish = threading.Event(), threading.Event()

    def slow(*arguments):
        begun.set()
        finish.wait(DEADLINE)
        return optimise(*arguments)

    monkeypatch.setattr(updates, 'optimise', slow)
    b = bench(save_path=str(path), autosave_period=0.2)
    b.drive(0, 3)
    b.until(lambda: keyframes(path) == 3, 'the map is saved')
    waiting = begin(b, 'optimize')
    b.until(begun.is_set, 'it works')
    b.drive(3, 5)
    b.until(lambda: keyframes(path) == 5, 'the map is saved again')
    finish.set()
    b.until(waiting.done, 'optimize is answered')
