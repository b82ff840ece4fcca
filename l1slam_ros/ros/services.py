# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The services of the node, which a thread of jobs carries out, and the thread that saves the map.

The thread that saves waits only for a moment in which no factor is appended, not for services or
for the solver.
"""

import threading
import time
from collections.abc import Awaitable, Callable

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from l1slam_ros.core.errors import DoubtfulError, Interrupted
from l1slam_ros.core.robust.batch_map import shared_offset
from l1slam_ros.core.running.backend import Backend, Stopped
from l1slam_ros.core.running.improve import Improvement
from l1slam_ros.core.running.snapshot import Snapshot
from l1slam_ros.io.graphs.map_file import MapFile
from l1slam_ros.io.sentences import doubt_sentence, offset_sentence
from l1slam_ros.ros.threads.failures import Failures
from l1slam_ros.ros.threads.job_queue import JobQueue

# [s] Period of the check whether there is something to save.
_LOOK = 0.1


class MapServices:
    """
    `~/optimize`, `~/reset`, `~/save`, `~/load` and `~/pause`.

    Parameters
    ----------
    node : to create them on
    backend : the map that they act on
    jobs : where they queue their work
    map_file : of `~/save` and `~/load`
    failures : records failures of autosaves
    pause : called at once with whether updates are to pause
    stopped : asked whether the node is ending

    """

    def __init__(self, node: Node, backend: Backend, jobs: JobQueue, map_file: MapFile,
                 failures: Failures, pause: Callable[[bool], None], stopped: Stopped):
        self._backend = backend
        self._jobs = jobs
        self._map_file = map_file
        self._failures = failures
        self._pause = pause
        self._stopped = stopped
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._keep_saving, name='autosave', daemon=True)
        # A callback group of their own: a service that awaits its result blocks its group.
        group = ReentrantCallbackGroup()
        for name, work in (('optimize', self._optimise), ('reset', self._reset),
                           ('save', map_file.save), ('load', map_file.load)):
            node.create_service(Trigger, f'~/{name}', self._trigger(name, work),
                                callback_group=group)
        node.create_service(SetBool, '~/pause', self._set_pause, callback_group=group)

    def _trigger(
        self, name: str, work: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Awaitable[Trigger.Response]]:
        async def answer(_: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
            return await self._jobs.put(f'~/{name}', work)

        return answer

    def _set_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pause(request.data)
        response.success = True
        response.message = 'updates pause' if request.data else 'updates go on'
        return response

    def _optimise(self) -> str:
        improvement, now = self._settled()
        if improvement is None:
            return 'there are no factors yet'
        judgement = improvement.judgement
        if doubts := judgement.doubts:
            stamps = now.stamps
            raise DoubtfulError(doubt_sentence(doubts, np.arange(len(stamps)), stamps))
        odometry, loops = (f'{times:.2g}' for times in np.sqrt(judgement.variance))
        noise = '' if odometry == loops == '1' else (
            f'; errors are {odometry} (odometry) and {loops} (loops) times what is stated')
        graph = now.graph.subset(np.arange(len(judgement.accepted)))
        offset = shared_offset(graph, improvement.poses, judgement)
        return '; '.join([
            f'L1 cost {improvement.cost_before:.6g} -> {improvement.cost:.6g}, '
            f'{improvement.status.value}, {improvement.seconds:.2f} s{noise}',
            *offset_sentence(graph.manifold, offset)])

    def _settled(self) -> tuple[Improvement | None, Snapshot]:
        """Solve to the optimum, again if the map is replaced; return the result and a snapshot."""
        while True:
            try:
                improvement = self._backend.settle(self._stopped)
            except Interrupted:
                if self._stopped():
                    raise
                continue
            now = self._backend.snapshot()
            if improvement is None or improvement.map == now.map:
                return improvement, now

    def _reset(self) -> str:
        self._backend.reset()
        return 'the map is empty'

    def begin_anew(self, why: str) -> None:
        """Save the map, then empty it: for a reason other than `~/reset`."""
        self._jobs.put(why, lambda: self._autosave(self._backend.reset))

    def start(self) -> None:
        """Start the thread that saves the map periodically."""
        self._thread.start()

    def close(self) -> None:
        """Save the map a last time if it has changed."""
        self._ending.set()

    def is_closed(self, seconds: float) -> bool:
        """Return whether that is done within `seconds`."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def is_saving(self) -> bool:
        """Return whether the map is being saved, or is about to be."""
        return self._map_file.is_saving or (self._ending.is_set() and self._thread.is_alive())

    def _keep_saving(self) -> None:
        again = 0.0
        while not self._ending.wait(_LOOK):
            if self._map_file.is_due() and (began := time.monotonic()) >= again:
                self._autosave(periodic=True)
                again = 2 * time.monotonic() - began  # at most half of the time is spent saving
        self._autosave()

    def _autosave(self, taken: Callable[[], None] = lambda: None, periodic: bool = False) -> str:
        try:
            self._map_file.autosave(taken, periodic)
        except Exception as error:
            self._failures.note('autosave', error)
        else:
            self._failures.over('autosave')
        return 'saved'
