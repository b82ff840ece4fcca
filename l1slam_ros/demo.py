# SPDX-License-Identifier: Apache-2.0
"""
`make demo`: plays the demo bag into the real node, draws its map, and compares with the truth.

`backend` and `replay` run as processes of their own, with the parameters as shipped; this one
only listens to the Path, as any other ROS program would.
"""

import os
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.metrics import absolute_trajectory_error, aligned_positions
from l1slam_ros.io.bag import read_messages
from l1slam_ros.io.files import stamp_from_text
from l1slam_ros.io.messages import stamp_of
from l1slam_ros.io.plot import MapDrawing, plot_maps
from l1slam_ros.io.side_files import false_loops_path, read_false_loops
from l1slam_ros.io.topics import LOOP_TOPIC, ODOMETRY_TOPIC, TRUTH_TOPIC

BAG = Path('bags/demo')
PICTURE = Path('demo/map.png')
RATE = 10.0
# The map is final when the node, which publishes what it improves, has been silent so long [s].
QUIET = 2.0
LONGEST = 120.0  # [s] for the node to come up, and to become quiet


@dataclass
class Heard:
    """The last Path, when each one came, and the loops (reference, end) [ns] not in the map."""

    path: PathMessage | None = None
    times: list[float] = field(default_factory=list)
    refused: set[tuple[int, int]] = field(default_factory=set)


class Listener:
    """Keeps what the back end publishes."""

    def __init__(self, node: Node):
        self.node, self.heard = node, Heard()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(PathMessage, 'path', self._hear, latched)
        every = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(DiagnosticArray, 'loop_status', self._hear_of_loops, every)

    def _hear(self, message: PathMessage) -> None:
        self.heard.path = message
        self.heard.times.append(time.monotonic())

    def _hear_of_loops(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            ends = stamp_from_text(values['reference_stamp']), stamp_from_text(values['stamp'])
            if values['state'] == 'accepted':
                self.heard.refused.discard(ends)
            else:
                self.heard.refused.add(ends)

    def wait_until_quiet(self) -> None:
        """Wait until no Path came for `QUIET` seconds."""
        deadline = time.monotonic() + LONGEST
        times = self.heard.times
        while not times or time.monotonic() - times[-1] < QUIET:
            if time.monotonic() > deadline:
                raise TimeoutError(f'the map has not come to rest within {LONGEST:.0f} s')
            rclpy.spin_once(self.node, timeout_sec=0.1)


@dataclass(frozen=True)
class Recording:
    """
    What the bag holds.

    stamps : (n,) [ns]; odometry, truth : (n, 2) positions [m]; loops : (m, 2) rows of these;
    is_false : (m,) bool, the loops that the file beside the bag calls false.
    """

    stamps: Indices
    odometry: Array
    truth: Array
    loops: Indices
    is_false: np.ndarray


def read_recording(path: Path) -> Recording:
    """Read the demo bag; loops as rows of `stamps`."""
    stamps: list[int] = []
    poses: dict[str, list[tuple[float, float]]] = {ODOMETRY_TOPIC: [], TRUTH_TOPIC: []}
    loops: list[tuple[int, int]] = []
    for topic, _, _, message in read_messages(path):
        if topic == LOOP_TOPIC:
            seconds, _, nanoseconds = message.header.frame_id.split('@')[1].partition('.')
            loops.append((int(seconds + nanoseconds), stamp_of(message.header)))
            continue
        if topic == ODOMETRY_TOPIC:
            stamps.append(stamp_of(message.header))
            message = message.pose
        poses[topic].append((message.pose.position.x, message.pose.position.y))
    pairs = np.searchsorted(stamps, loops)
    false = read_false_loops(false_loops_path(path))
    is_false = (pairs[:, None] == false).all(axis=2).any(axis=1)
    return Recording(np.array(stamps), np.array(poses[ODOMETRY_TOPIC]),
                     np.array(poses[TRUTH_TOPIC]), pairs, is_false)


@contextmanager
def running_backend() -> Iterator[None]:
    """Run `backend` as a process; end it as a user would, by SIGINT, and look at its exit code."""
    backend = subprocess.Popen([executable('backend')])
    try:
        yield
    finally:
        backend.send_signal(signal.SIGINT)
        code = backend.wait(timeout=LONGEST)
    if code:
        raise RuntimeError(f'backend ended with exit code {code}')


def executable(name: str) -> str:
    """Return where this package's executable is: where `ros2 run` looks, or beside Python."""
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        path = Path(prefix) / 'lib' / 'l1slam_ros' / name
        if prefix and path.exists():
            return str(path)
    return str(Path(sysconfig.get_path('scripts')) / name)


def record_map(bag: Path) -> Heard:
    """Play the bag into `backend`; return what it published."""
    rclpy.init()
    try:
        listener = Listener(rclpy.create_node('demo'))
        with running_backend():
            replay = subprocess.Popen([executable('replay'), str(bag), '--rate', str(RATE)])
            while replay.poll() is None:
                rclpy.spin_once(listener.node, timeout_sec=0.1)
            if replay.returncode:
                raise RuntimeError(f'replay ended with exit code {replay.returncode}')
            listener.wait_until_quiet()
        return listener.heard
    finally:
        rclpy.try_shutdown()


def summarise(recording: Recording, heard: Heard, picture: Path) -> str:
    """Draw the map and return what to print about it."""
    assert heard.path is not None
    stamps = np.array([stamp_of(pose.header) for pose in heard.path.poses])
    positions = np.array([(p.pose.position.x, p.pose.position.y) for p in heard.path.poses])
    rows = np.searchsorted(recording.stamps, stamps)
    truth, odometry = recording.truth[rows], recording.odometry[rows]
    errors = (absolute_trajectory_error(odometry, truth),
              absolute_trajectory_error(positions, truth))
    note = f'position error {errors[0]:.2f} m by odometry, {errors[1]:.2f} m optimised'
    ends = recording.stamps[recording.loops]
    refused = np.array([tuple(pair) in heard.refused for pair in ends.tolist()], bool)
    loops, false = np.searchsorted(stamps, ends), recording.is_false
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_maps(picture, [MapDrawing('l1slam_ros demo', positions, odometry,
                                   aligned_positions(truth, positions), loops[~refused & ~false],
                                   rejected=loops[refused], false=loops[~refused & false],
                                   note=note)])
    rate = (len(heard.times) - 1) / max(heard.times[-1] - heard.times[0], 1e-9)
    return '\n'.join((
        f'position error  {errors[0]:.3f} m by odometry, {errors[1]:.3f} m in the map (RMSE)',
        f'graph           {len(stamps)} keyframes, {len(loops)} loops, {false.sum()} of them '
        'false',
        f'refused         {(refused & false).sum()} false loops, {(refused & ~false).sum()} true '
        'ones',
        f'node            {rate:.1f} updates per second',
        f'picture         {picture}'))


def main() -> int:
    """Run the demo from the checkout's top folder; return the exit code."""
    # A domain of its own: the demo neither hears nor disturbs what else runs here.
    os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 100 + 1))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    recording = read_recording(BAG)
    print(summarise(recording, record_map(BAG), PICTURE))
    return 0


if __name__ == '__main__':
    sys.exit(main())
