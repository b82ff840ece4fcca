# SPDX-License-Identifier: Apache-2.0
"""The services of the node, and what the thread of the orders does for each."""

from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from l1slam_ros.core.errors import DoubtfulError, OptionError
from l1slam_ros.core.online.backend import Backend, Stopped
from l1slam_ros.io.graphs.saved_map import load_map, save_map
from l1slam_ros.io.sentences import doubt_sentence
from l1slam_ros.ros.threads.orders import Orders


class MapServices:
    """
    `~/optimize`, `~/reset`, `~/save`, `~/load` and `~/pause`.

    Parameters
    ----------
    node : to create them on
    backend : what they act on
    orders : where they place their work
    save_path : returns the file of `~/save` and `~/load` as it is set now
    pause : called, at once, with whether updates shall pause
    stopped : asked whether the node is ending

    """

    def __init__(self, node: Node, backend: Backend, orders: Orders,
                 save_path: Callable[[], str], pause: Callable[[bool], None], stopped: Stopped):
        self._backend, self._orders = backend, orders
        self._save_path, self._pause, self._stopped = save_path, pause, stopped
        # A group of their own: a service that awaits its answer would block its whole group.
        group = ReentrantCallbackGroup()
        for name, work in (('optimize', self._optimise), ('reset', self.reset),
                           ('save', self._save), ('load', self._load)):
            node.create_service(Trigger, f'~/{name}', self._trigger(name, work),
                                callback_group=group)
        node.create_service(SetBool, '~/pause', self._set_pause, callback_group=group)

    def _trigger(
        self, name: str, work: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Awaitable[Trigger.Response]]:
        async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            result = await self._orders.place(f'~/{name}', work)
            response.success, response.message = result.success, result.message
            return response

        return answer

    def _set_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pause(request.data)
        response.success = True
        response.message = 'updates pause' if request.data else 'updates go on'
        return response

    def _optimise(self) -> str:
        improvement = self._backend.settle(self._stopped)
        if improvement is None:
            return 'there are no factors yet'
        doubts = improvement.judgement.doubts
        if doubts:
            stamps = self._backend.snapshot().stamps
            raise DoubtfulError(doubt_sentence(doubts, np.arange(len(stamps)), stamps))
        return (f'L1 cost {improvement.cost_before:.6g} -> {improvement.cost:.6g}, '
                f'{improvement.status.value}, {improvement.seconds:.2f} s')

    def reset(self) -> str:
        """Empty the map; the thread of the orders calls it."""
        self._backend.reset()
        return 'the map is empty'

    def _save(self) -> str:
        path = self._file()
        return f'{save_map(path, self._backend.snapshot())} keyframes saved to {path}'

    def _load(self) -> str:
        path = self._file()
        graph, poses, stamps = load_map(path)
        self._backend.restore(graph, poses, stamps)
        return f'{len(poses)} keyframes loaded from {path}'

    def _file(self) -> Path:
        path = self._save_path()
        if not path:
            raise OptionError('the parameter save_path is empty, expected the name of a .g2o file')
        return Path(path)
