# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The thread that does all the work of `scan_loops`: scans first, the grid when none waits."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import LaserScan

from l1slam_ros.core.errors import L1SlamError, MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.front_end import ScanFrontEnd
from l1slam_ros.core.scans.odometry import Step
from l1slam_ros.core.scans.points import Mount, Scan
from l1slam_ros.io.messages.conversion import odometry_in
from l1slam_ros.ros.scans.map_drawer import MapDrawer
from l1slam_ros.ros.scans.messages import covariance_in, path_in, scan_in
from l1slam_ros.ros.scans.mounting import RobotFrames
from l1slam_ros.ros.scans.options import ScanLoopsOptions
from l1slam_ros.ros.scans.placing import Placing
from l1slam_ros.ros.scans.publishing import ScanPublisher
from l1slam_ros.ros.scans.scan_odometry import IncrementalOdometry
from l1slam_ros.ros.scans.scan_queue import ScanQueue
from l1slam_ros.ros.threads.failures import Failures

# Largest number of messages that wait for this thread.
_BACKLOG = 20_000
# [s] So often, at most, the path is read while there is nothing else to do, and where there is a
# new keyframe; and the map looked at. To read it takes as long as some scans do.
_READ = 1.0
_FRESH = 0.2
_LOOK = 0.1
_REPEAT_WARNING = 5.0  # [s]
# [s] Pause after an error, so that one which recurs does not keep a core busy.
_BREATH = 0.05
# Number of scans whose costs are kept.
_COSTS = 1000


class RunOfScans:
    """
    Matches scan after scan, publishes odometry and loops, and has the grid drawn.

    Parameters
    ----------
    options : returns the current options
    frames : of the robot
    publisher : of odometry and loops
    drawer : of the map
    logger : to warn with

    Attributes
    ----------
    counts : numbers of scans, keyframes, loops and so on
    costs : of the last scans [s]

    """

    def __init__(self, options: Callable[[], ScanLoopsOptions], frames: RobotFrames,
                 publisher: ScanPublisher, drawer: MapDrawer, logger: Any):
        self._options = options
        self._frames = frames
        self._logger = logger
        self._publisher, self._drawer = publisher, drawer
        self.counts = Counter[str]()
        self.costs: deque[float] = deque(maxlen=_COSTS)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Begin without any scan."""
        options = self._options()
        self._front_end = ScanFrontEnd(options, self._frames.mount or Mount())
        self._odometry = IncrementalOdometry(options.keyframe)
        self._placing = Placing()
        self._path = b''
        self._read = 0.0
        self._drawer.begin_anew()

    def set_path(self, data: bytes) -> None:
        """Keep a serialised path until there is time to read it."""
        self._path = data

    def add_known(self, stamp: int, covariance: Array) -> None:
        """Add the covariance (3, 3) of a pose of the path at its stamp [ns]."""
        self._placing.add_known(stamp, covariance)

    def follow(self, scan: Scan, wheels: Array) -> None:
        """Match a scan, with wheel odometry at a pose (3,), and publish the result."""
        began = time.thread_time()
        keyframes = self._front_end.keyframes
        before = keyframes[-1].part if keyframes else 0
        step = self._front_end.add(scan, wheels)
        begins = self._front_end.keyframes[-1].part != before
        pose, covariance = self._odometry.tell(scan.stamp, step, begins)
        self._publisher.odometry(self._frames.base, scan.stamp, pose, covariance)
        self._publisher.wheels_frame(self._frames.wheels, scan.stamp, pose, wheels)
        self._placing.add_odometry(scan.stamp, step.pose)
        self._warn(step, begins)
        if step.keyframe is not None:
            self.place_if_due(_FRESH)
        # Comparisons of keyframes are queued; a few are made with each scan.
        self.look_for_loops()
        self.counts['scans'] += 1
        self.costs.append(time.thread_time() - began)

    def look_for_loops(self) -> bool:
        """Search for loops for a moment; return whether comparisons are left."""
        for loop in self._front_end.loops():
            self._publisher.loop(self._frames.base, self._front_end.keyframes, loop)
            self.counts['loops'] += 1
        self._count()
        return self._front_end.waiting > 0

    def place_if_due(self, seconds: float = _READ) -> None:
        """Use a new path if the last one was used `seconds` ago or earlier."""
        if self._path and time.monotonic() - self._read > seconds:
            self._place()

    def cost(self) -> tuple[float, float]:
        """Return the processor time of the last scans, median and 99% quantile [s]."""
        median, most = np.quantile(list(self.costs) or [0.0], (0.5, 0.99)).tolist()
        return median, most

    def _warn(self, step: Step, begins: bool) -> None:
        if begins:
            self._logger.warning(step.said)
        elif step.said:
            self._logger.warning(step.said, throttle_duration_sec=_REPEAT_WARNING)

    def _count(self) -> None:
        keyframes = self._front_end.keyframes
        self.counts['keyframes'] = len(keyframes)
        self.counts['parts'] = keyframes[-1].part + 1 if keyframes else 0
        self.counts['comparisons'] = self._front_end.waiting

    def _place(self) -> None:
        """Give the poses of the keyframes in the path to the front end and the grid."""
        self._placing.set_path(*path_in(self._path))
        self._path = b''
        self._read = time.monotonic()
        keyframes = self._front_end.keyframes
        poses = self._placing.place(keyframes)
        if not len(poses):
            return
        placed = keyframes[: len(poses)]
        self._front_end.place(poses, self._placing.spread(placed))
        joined = self._placing.joined(placed)
        self._drawer.follow(self._placing.frame, placed[-1].stamp, {
            number: (keyframe.points, pose)
            for number, (keyframe, pose) in enumerate(zip(placed, poses, strict=True))
            if keyframe.part in joined})


class FrontEndThread:
    """
    Uses messages in the order of their arrival.

    Parameters
    ----------
    node : to log with
    options : returns the current options
    publisher : of odometry and loops
    drawer : of the map
    failures : records unexpected errors
    static : whether /tf_static is subscribed to

    Attributes
    ----------
    refused : cause -> number of messages that could not be used
    queue : the scans that wait
    run : the matching of scans

    """

    def __init__(self, node: Node, options: Callable[[], ScanLoopsOptions],
                 publisher: ScanPublisher, drawer: MapDrawer, failures: Failures, static: bool):
        self._logger = node.get_logger()
        self._options = options
        self._drawer, self._failures = drawer, failures
        self._frames = RobotFrames(options, self._logger, static)
        self.refused = Counter[str]()
        self.queue = ScanQueue(lambda: options().backlog)
        self._restarts = self.queue.restarts
        self.run = RunOfScans(options, self._frames, publisher, drawer, self._logger)
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=_BACKLOG)
        self._woken = threading.Event()
        self._closing = False
        self._uses = {'scan': self._on_scan, 'odom': self._on_odometry, 'path': self.run.set_path,
                      'pose_with_covariance': self._on_covariance, '/tf_static': self._on_static}
        self._thread = threading.Thread(target=self._work, name='front end', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def put(self, topic: str, data: bytes) -> None:
        """Queue a serialised message; any thread may call this."""
        self._inbox.append((topic, data))
        self._woken.set()

    def close(self, seconds: float) -> bool:
        """End the thread; return whether it ended within some seconds."""
        self._closing = True
        self._woken.set()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        more = False
        while not self._closing:
            self._woken.wait(0.0 if more else _LOOK)
            self._woken.clear()
            try:
                more = self._turn()
                self._failures.over('front end')
            except Exception as error:
                self._failures.note('front end', error)
                time.sleep(_BREATH)

    def _turn(self) -> bool:
        """Do the next piece of work; return whether there may be more."""
        while self._inbox:
            topic, data = self._inbox.popleft()
            try:
                self._uses[topic](data)
            except L1SlamError as error:
                self._refuse(error)
        if self.queue.restarts != self._restarts:
            self._logger.warning('the stamps of odom went back: scans and map begin anew')
            self._begin_anew()
        if self._frames.find_mount():
            self._begin_anew()
        mounted = self._frames.mount is not None
        if mounted and (taken := self.queue.take(self._options().scan_wait)):
            self.run.follow(*taken)
            self._warn_of_left_out()
            return True
        self.run.place_if_due()
        more = self.run.look_for_loops()
        return self._drawer.work() or more

    def _on_scan(self, data: bytes) -> None:
        message = deserialize_message(data, LaserScan)
        self.queue.add_scan(scan_in(message, self._options().range_max))
        self._frames.laser = message.header.frame_id.removeprefix('/')

    def _on_odometry(self, data: bytes) -> None:
        frame, sample = odometry_in(data)
        self._frames.hear_odometry(frame, sample.frame)
        self.queue.add_wheels(sample.stamp, se2.from_pose3(sample.pose3[None])[0])

    def _on_covariance(self, data: bytes) -> None:
        self.run.add_known(*covariance_in(
            deserialize_message(data, PoseWithCovarianceStamped)))

    def _on_static(self, data: bytes) -> None:
        from tf2_msgs.msg import TFMessage

        self._frames.hear_static(deserialize_message(data, TFMessage))

    def _refuse(self, error: L1SlamError) -> None:
        self.refused[error.cause if isinstance(error, MessageError) else 'unusable'] += 1
        self._logger.warning(f'refused: {error}', throttle_duration_sec=_REPEAT_WARNING)

    def _begin_anew(self) -> None:
        self.run.begin_anew()
        self._restarts = self.queue.restarts

    def _warn_of_left_out(self) -> None:
        if left := self.queue.counts['left_out']:
            self._logger.warning(f'{left} scans were dropped: they come faster than they can be '
                                 'matched; expected a slower laser, or a faster machine',
                                 once=True)
