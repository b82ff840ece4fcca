# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
`make demo`: plays the demo bag into the real nodes, draws their map, and compares with the truth.

`scan_loops` finds loops in the recorded scans and draws the grid; `backend` makes the map of these
loops, of those that the recording holds, ten false ones among them, and of the wheels. These and
`replay` run as processes of their own, with the parameters as shipped, but that the scans of a
recording that is played fast may wait; this one only listens, as any other ROS program would. It
counts no seconds, so it works on a busy machine: it waits for the whole recording to be in the map
and for the node to say that nothing changes any more.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, aligned_positions
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.spanning_tree import odometry_poses
from l1slam_ros.io.bags.reader import bag_summary
from l1slam_ros.io.bags.to_graph import read_truth_topic
from l1slam_ros.io.bags.topics import SCAN_TOPIC, TRUTH_TOPIC
from l1slam_ros.io.files import stamp_from_text
from l1slam_ros.io.formats import read_input
from l1slam_ros.io.graphs.side_files import read_pairs
from l1slam_ros.io.plot import Ground, MapDrawing, plot_maps
from l1slam_ros.ros.scans.messages import path_in
from l1slam_ros.ros.shell.domain import go_where_nobody_is
from l1slam_ros.ros.shell.installed import executable

Process = subprocess.Popen[bytes]

BAG = Path('bags/demo')
BACKEND, FRONT_END = 'backend', 'scan_loops'  # the executables, and the nodes
PICTURE = Path('demo/map.png')
RATE = 10.0
# Played faster than recorded, no scan is to be left out, nor lost on the way.
_OF_SCANS = 'qos_overrides./scan.subscription'
IN_TURN = ('--ros-args', '-p', 'backlog:=1000', '-p', f'{_OF_SCANS}.reliability:=reliable',
           '-p', f'{_OF_SCANS}.depth:=1000')
# The map is final when the node has said so often [diagnostics, one a second] the same of it.
CALM = 3
OF_THE_MAP = ('keyframes', 'factors', 'updates', 'l1_cost')
# The gate leaves out one true loop in a thousand; of which loops, depends on those that the scans
# add. More than this part of the recorded ones is a fault.
SUSPECT = 0.01
# Given up only when nothing has moved for so long [s].
PATIENCE = 120.0
END = 60.0  # [s] longest that a process may take to end when it is told to
_INTERRUPTED = 130
_TELL = 10.0  # [s] how often it is said how far things are


class DemoError(Exception):
    """The demo cannot go on, or did not show what it is to show; the message says why."""


@dataclass(frozen=True)
class Recording:
    """
    What the bag holds.

    stamps : (n,) [ns]; odometry, truth : (n, 2) positions [m]; loops : (m, 2) rows of these;
    is_false : (m,) bool, the loops that the file beside the bag calls false; scans : how many.
    """

    stamps: Indices
    odometry: Array
    truth: Array
    loops: Indices
    is_false: np.ndarray
    scans: int

    @property
    def loop_stamps(self) -> list[tuple[int, int]]:
        """The stamps of both ends of each loop [ns]."""
        return [(int(i), int(j)) for i, j in self.stamps[self.loops]]


def read_recording(path: Path) -> Recording:
    """Read the demo bag; loops as rows of `stamps`."""
    record, truth = read_input(path), read_truth_topic(path, TRUTH_TOPIC)
    graph = record.graph
    positions, loops = graph.manifold.positions, graph.between.pairs[~graph.between.is_odometry]
    false, _ = read_pairs(path, 'false')
    is_false = (loops[:, None] == false).all(axis=2).any(axis=1)
    scans = sum(topic.count for topic in bag_summary(path).topics if topic.name == SCAN_TOPIC)
    return Recording(record.times, positions(odometry_poses(graph)), positions(truth.poses),
                     loops, is_false, scans)


@dataclass
class Heard:
    """
    What the back end and the front end published.

    path : the last one, serialised; states : loop (reference, end) [ns] -> what has become of it;
    sentence : of its diagnostics; calm : how many of these in a row said the same of the map, with
    no other news in between; ground : the last grid of the front end; scans : how many it has
    used; comparisons : how many it has still to make, at least.
    """

    path: bytes = b''
    ground: OccupancyGrid | None = None
    scans: int = 0
    states: dict[tuple[int, int], str] = field(default_factory=dict)
    sentence: str = 'nothing yet'
    calm: int = 0
    comparisons: int = 0

    @property
    def stamps(self) -> list[int]:
        """The stamps of the map's keyframes [ns]."""
        stamps: list[int] = path_in(self.path)[1].tolist() if self.path else []
        return stamps

    def count_judged(self, loops: list[tuple[int, int]]) -> int:
        """Return how many of some loops are in the map or refused."""
        return sum(self.states.get(loop, 'waiting') != 'waiting' for loop in loops)

    def found(self, loops: list[tuple[int, int]]) -> list[str]:
        """Return what has become of all loops but these."""
        known = set(loops)
        return [state for ends, state in self.states.items() if ends not in known]


class Listener:
    """Keeps what the back end publishes, and knows how much of a recording is in its map."""

    def __init__(self, node: Node, recording: Recording):
        self.node = node
        self.recording = recording
        self.heard = Heard()
        self.moved = time.monotonic()
        self._said: dict[str, str] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(PathMessage, 'path', self._hear, latched, raw=True)
        every = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(DiagnosticArray, 'loop_status', self._hear_of_loops, every)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._hear_of_the_map, 10)
        node.create_subscription(OccupancyGrid, 'map', self._hear_ground, latched)

    def _hear(self, data: bytes) -> None:
        self.heard.path = data
        self._move()

    def _hear_ground(self, message: OccupancyGrid) -> None:
        self.heard.ground = message

    def _hear_of_loops(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            ends = stamp_from_text(values['reference_stamp']), stamp_from_text(values['stamp'])
            self.heard.states[ends] = values['state']
        self._move()

    def _hear_of_the_map(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if 'scans' in values:  # the front end's
                counts = int(values['scans']), int(values['comparisons'])
                if counts != (self.heard.scans, self.heard.comparisons):
                    self.heard.scans, self.heard.comparisons = counts
                    self._move()
                continue
            said = {key: values[key] for key in OF_THE_MAP if key in values}
            if not said:
                continue
            # What is wrong is news, but not of the map.
            if status.message != self.heard.sentence:
                self.heard.sentence, self.moved = status.message, time.monotonic()
            if said != self._said:
                self._said = said
                self._move()
            self.heard.calm += 1

    def _move(self) -> None:
        self.heard.calm, self.moved = 0, time.monotonic()

    def is_final(self) -> bool:
        """Return whether all of the recording is in the map, and the map at rest."""
        heard, loops = self.heard, self.recording.loop_stamps
        # As long as it uses scans, or compares them, the front end is not calm.
        return (heard.calm >= CALM and heard.scans > 0 and heard.comparisons == 0
                and heard.stamps[-1:] == [self.recording.stamps[-1]]
                and heard.count_judged(loops) == len(loops))

    def how_far(self) -> str:
        """Return how much of the recording is in the map, and what the node says."""
        heard, loops = self.heard, self.recording.loop_stamps
        return (f'{heard.scans} of {self.recording.scans} scans used, '
                f'{len(heard.stamps)} of {len(self.recording.stamps)} keyframes mapped, '
                f'{heard.count_judged(loops)} of {len(loops)} loops judged; the node says: '
                f'{heard.sentence}')

    def wait(self, nodes: Mapping[str, Process], ready: Callable[[], bool]) -> None:
        """
        Listen until it is ready, saying now and then how far things are.

        Raises
        ------
        DemoError : a node has ended, or nothing has moved for `PATIENCE` seconds.

        """
        self.moved = time.monotonic()
        tell = self.moved + _TELL
        while not ready():
            rclpy.spin_once(self.node, timeout_sec=0.1)
            now = time.monotonic()
            for name, process in nodes.items():
                if process.poll() is not None:
                    raise DemoError(f'{name} ended with exit code {process.returncode}; '
                                    f'{self.how_far()}')
            if now > self.moved + PATIENCE:
                raise DemoError(f'nothing has moved for {PATIENCE:.0f} s; {self.how_far()}')
            if now > tell:
                tell = now + _TELL
                print(f'demo: {self.how_far()}', flush=True)


@contextmanager
def running(name: str, *arguments: str) -> Iterator[Process]:
    """Run an executable as a process; in the end stop it as a user would, by SIGINT."""
    process = Process([executable(name), *arguments])
    try:
        yield process
        process.send_signal(signal.SIGINT)
        code = process.wait(END)
    except subprocess.TimeoutExpired as error:
        raise DemoError(f'{name} was told to end, and did not within {END:.0f} s') from error
    finally:
        process.kill()
        process.wait()
    if code:
        raise DemoError(f'{name} ended with exit code {code}')


def record_map(bag: Path, recording: Recording) -> Heard:
    """Play the bag into both nodes; return what they published."""
    rclpy.init()
    try:
        listener = Listener(rclpy.create_node('demo'), recording)
        with running(BACKEND) as backend, running(FRONT_END, *IN_TURN) as front_end:
            nodes = {BACKEND: backend, FRONT_END: front_end}
            print(f'demo: playing {bag}, {RATE:g} times as fast as recorded', flush=True)
            with running('replay', str(bag), '--rate', str(RATE), '--nodes', *nodes) as replay:
                listener.wait(nodes, lambda: replay.poll() is not None)
            print('demo: waiting until nothing changes in the map any more', flush=True)
            listener.wait(nodes, listener.is_final)
        return listener.heard
    finally:
        rclpy.try_shutdown()


def summarise(recording: Recording, heard: Heard, picture: Path) -> str:
    """Draw the map and return what to print about it."""
    _, stamps, poses = path_in(heard.path)
    positions = poses[:, :2]
    rows = np.searchsorted(recording.stamps, stamps)
    truth, odometry = recording.truth[rows], recording.odometry[rows]
    errors = (absolute_trajectory_error(odometry, truth),
              absolute_trajectory_error(positions, truth))
    note = f'position error {errors[0]:.2f} m by odometry, {errors[1]:.2f} m optimised'
    (refused, suspect), false = left_out(recording, heard), recording.is_false
    left = refused | suspect
    loops = np.searchsorted(stamps, recording.stamps[recording.loops])
    found = heard.found(recording.loop_stamps)
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_maps(picture, [MapDrawing('l1slam_ros demo', positions, odometry,
                                   aligned_positions(truth, positions), loops[~left & ~false],
                                   rejected=loops[left], false=loops[~left & false],
                                   note=note, ground=_ground(heard.ground))])
    return '\n'.join((
        f'position error  {errors[0]:.3f} m by odometry, {errors[1]:.3f} m in the map (RMSE)',
        f'graph           {len(stamps)} keyframes, {len(loops)} loops, {false.sum()} of them '
        'false',
        f'refused         {(refused & false).sum()} false loops, {(refused & ~false).sum()} true '
        'ones',
        *([f'left out        {suspect.sum()} true loops, as suspect'] if suspect.any() else []),
        f'from the scans  {len(found)} more loops, {sum(state != "accepted" for state in found)} '
        'of them not in the map',
        f'picture         {picture}'))


def _ground(message: OccupancyGrid | None) -> Ground | None:
    if message is None:
        return None
    meta = message.info
    origin = np.array([meta.origin.position.x, meta.origin.position.y])
    return Ground(np.array(message.data, np.int8).reshape(meta.height, meta.width).T, origin,
                  meta.resolution)


def left_out(recording: Recording, heard: Heard) -> tuple[np.ndarray, np.ndarray]:
    """Return the loops that are refused, and the true ones that are suspect only, bool each."""
    states = np.array([heard.states.get(loop, '') for loop in recording.loop_stamps])
    suspect = (states == 'suspect') & ~recording.is_false
    return (states != 'accepted') & ~suspect, suspect


def require_the_truth(recording: Recording, heard: Heard) -> None:
    """
    Check that no false loop is in the map, no true one refused, and hardly any left out.

    Raises
    ------
    DemoError : it is not so.

    """
    (refused, suspect), false = left_out(recording, heard), recording.is_false
    if (refused != false).any():
        raise DemoError(f'{(refused & false).sum()} false loops are refused and '
                        f'{(refused & ~false).sum()} true ones, expected all {false.sum()} '
                        'false ones and no true one')
    if suspect.mean() > SUSPECT:
        raise DemoError(f'{suspect.sum()} true loops are left out as suspect, expected at most '
                        f'{SUSPECT:.0%} of {len(suspect)}')


def main() -> int:
    """Run the demo from the checkout's top folder; return the exit code."""
    # What an earlier run drew must not pass for what this one does.
    PICTURE.unlink(missing_ok=True)
    try:
        # The demo neither hears nor disturbs what else runs here.
        print(f'demo: in ROS domain {go_where_nobody_is()}, on this machine only', flush=True)
        recording = read_recording(BAG)
        heard = record_map(BAG, recording)
        print(summarise(recording, heard, PICTURE))
        require_the_truth(recording, heard)
    except (DemoError, L1SlamError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return _INTERRUPTED
    return 0
