# SPDX-License-Identifier: Apache-2.0
"""What the node hears: messages of every topic -> the back end; none of it is compiled code."""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry

from l1slam_ros.core.errors import L1SlamError, MessageError
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.online.backend import Backend
from l1slam_ros.io.messages import cdr
from l1slam_ros.io.messages.base_frame import BaseFrame
from l1slam_ros.io.messages.conversion import (
    absolute_pose,
    false_loop,
    loop_closure,
)
from l1slam_ros.io.messages.pose_graphs import MAP_GRAPH, POSE_GRAPH, PoseGraphs
from l1slam_ros.io.node_options import NodeOptions
from l1slam_ros.ros.inputs.intake import Intake

_REPEAT_WARNING = 5.0  # [s]
# Of a backlog so many messages, the newest, are answered with a pose: nobody waits for the others.
_ANSWERED = 200


class Inputs:
    """
    Appends messages to the back end; what cannot be used is counted.

    Parameters
    ----------
    intake : which takes the messages in
    backend : to append to
    options : of the node
    moved : called after a sample of the odometry that is used, unless so many more wait behind it
        that nobody needs its answer
    logger : of the node

    Attributes
    ----------
    refused : cause -> how many messages could not be used

    """

    def __init__(self, intake: Intake, backend: Backend, options: NodeOptions,
                 moved: Callable[[], None], logger: Any):
        self._backend, self._moved, self._logger = backend, moved, logger
        self._base_frame, self._map_frame = BaseFrame(options.base_frame), options.map_frame
        self.refused: Counter[str] = Counter()
        self._subscribe(intake)

    def _subscribe(self, intake: Intake) -> None:
        for topic, read in (
            ('loop_closures', lambda m: loop_closure(m, self._base_frame.name, False)),
            ('trusted_loop_closures', lambda m: loop_closure(m, self._base_frame.name, True)),
            ('false_loop_closures', lambda m: false_loop(m, self._base_frame.name)),
            ('absolute_poses', lambda m: absolute_pose(m, self._map_frame)),
        ):
            intake.subscribe(PoseWithCovarianceStamped, topic, partial(self._add_loop, read))
        # Pose graphs of other front ends, where their messages are installed.
        for msgtype, topic in (MAP_GRAPH, 'map_graph'), (POSE_GRAPH, 'pose_graph'):
            package, _, name = msgtype.split('/')
            with suppress(ImportError):
                kind = getattr(import_module(f'{package}.msg'), name)
                intake.subscribe(kind, topic, self.graph_reader())
        intake.subscribe(Odometry, 'odom', self._on_odometry, raw=True)

    def graph_reader(self) -> Callable[[Any, int], None]:
        """Return what takes the pose graphs of a topic, message by message."""
        graphs = PoseGraphs()

        def read(message: Any, _: int = 0) -> None:
            for found in graphs.take(message):
                if isinstance(found, LoopClosure):
                    self._add_loop(lambda loop: loop, found)
                else:
                    self._refuse(found)

        return read

    def _on_odometry(self, data: bytes, behind: int) -> None:
        try:
            found = self._base_frame.take(*cdr.odometry(data))
        except L1SlamError as error:
            self._refuse(error)
            return
        if found.anew:
            self._backend.begin_anew()
        for other in found.others:
            self._refuse(other)
        for sample in found.ours:
            self._add_odometry(sample, behind < _ANSWERED)

    def _add_odometry(self, sample: OdometrySample, answered: bool) -> None:
        try:
            if self._backend.add_odometry(sample) is not None and answered:
                self._moved()
        except L1SlamError as error:
            self._refuse(error)

    def _add_loop(self, read: Callable[[Any], LoopClosure], message: Any, _: int = 0) -> None:
        try:
            self._backend.add_loop(read(message))
        except L1SlamError as error:
            self._refuse(error)

    def _refuse(self, error: L1SlamError) -> None:
        self.refused[error.cause if isinstance(error, MessageError) else 'unusable'] += 1
        self._logger.warning(f'refused: {error}', throttle_duration_sec=_REPEAT_WARNING)
