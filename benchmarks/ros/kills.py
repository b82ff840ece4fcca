# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A node that is killed again and again: what it loses, and what its map is worth in the end.

    python benchmarks/ros/kills.py [KILLS]

A simulated world is played into `backend` as a process, which saves its map by itself. It is
killed with SIGKILL at random moments, every other time while it writes, and started again; then
all is played that came after the last keyframe of the map that it has loaded. Said are the
restarts that did not load, how much was lost at most, and the cost in the end beside that of a run
without kills.
"""

import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from peer import KINDS, PATIENCE, Peer, arguments

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.bags.reader import read_raw
from l1slam_ros.io.bags.topics import ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.messages.conversion import stamp_of

KILLS = 60
POSES = 3000
EDGES = 4800
_PERIOD = 1.0  # [s] from autosave to autosave
_RATE = 30.0  # [Hz] of the odometry
_LONGEST = 3.0  # [s] from the first message to the kill
_SAVE = 5e-6  # [s] it takes at least to save a keyframe
_AGAIN = 2 * 10**9  # [ns] before the last keyframe: loops since then are sent again


class Player:
    """Plays a bag into the node, which it starts, kills and starts again."""

    def __init__(self, bag: Path, path: Path, rng: np.random.Generator):
        self.messages = [(m.topic, m.time, m.data) for m in read_raw(bag, KINDS)]
        self.path, self.rng = path, rng
        self.sent: dict[int, float] = {}  # stamp [ns] of odometry -> when it was sent [s]
        self.last = 0  # stamp of the last keyframe of the map that was loaded [ns]
        self.lost: list[float] = []
        self.inside = 0
        self.peer: Peer

    def start(self) -> None:
        """Start the node; where there is a map, take its last keyframe from its Path."""
        self.peer = Peer({
            'save_path': self.path, 'autosave_period': _PERIOD, 'load_on_start': 'true',
            'keyframe.translation': 0.0, 'keyframe.rotation': 0.0, 'keyframe.period': 0.0,
            'odometry.covariance_source': 'increment'})
        if self.path.exists():
            self.peer.until(lambda: bool(self.peer.maps))
            self.last = stamp_of(self.peer.newest().poses[-1].header)

    def play(self, seconds: float) -> bool:
        """Play on from the last keyframe for some time; return whether that was all."""
        end, due = time.monotonic() + seconds, time.monotonic()
        for topic, stamp, data in self.messages:
            odometry = topic == ODOMETRY_TOPIC
            if stamp <= self.last - (0 if odometry else _AGAIN):
                continue
            if odometry:
                due += 1 / _RATE
                self.peer.listen(due - time.monotonic())
                if time.monotonic() > end:
                    return False
                self.sent[stamp] = time.monotonic()
            self.peer.publishers[topic].publish(data)
        return True

    def kill(self, inside: bool) -> None:
        """Kill the node, inside of a save or at any moment, start it again, note what is lost."""
        before = self._being_written()
        if inside:
            deadline = time.monotonic() + 2 * _PERIOD
            while not self._being_written() - before and time.monotonic() < deadline:
                pass  # a small map is written in two milliseconds
            size = len(self.peer.newest().poses) if self.peer.maps else 0
            time.sleep(self.rng.uniform(0, _SAVE * size))
        self.peer.end(signal.SIGKILL)
        killed = time.monotonic()
        self.inside += bool(self._being_written() - before)
        self.start()
        self.lost.append(max((killed - when for stamp, when in self.sent.items()
                              if stamp > self.last), default=0.0))
        self.sent.clear()

    def _being_written(self) -> set[str]:
        return {name for name in os.listdir(self.path.parent) if name.endswith('.tmp')}

    def finish(self) -> str:
        """Play to the end and optimise; return the sentence of the node."""
        self.play(PATIENCE)
        self.peer.until(lambda: len(self.peer.newest().poses) == POSES)
        _, sentence = self.peer.call('optimize')
        self.peer.end()
        return sentence


def _run(bag: Path, path: Path, kills: int) -> str:
    player = Player(bag, path, np.random.default_rng(kills))
    player.start()
    for k in range(kills):
        if player.play(player.rng.uniform(0.2, _LONGEST)):
            print(f'played to the end after {k} kills: make the world larger')
            break
        player.kill(inside=k % 2 == 1)
        loaded = len(player.peer.newest().poses) if player.peer.maps else 0
        print(f'kill {k + 1}: {loaded} keyframes loaded, {player.lost[-1]:.2f} s lost', flush=True)
    if kills:
        print(f'{len(player.lost)} kills, {player.inside} of them inside of a save; at most '
              f'{max(player.lost):.2f} s lost, autosave every {_PERIOD} s')
    return player.finish()


def main() -> None:
    """Measure, and print."""
    kills = arguments(__doc__, kills=KILLS).kills
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        world = simulate_world(POSES, EDGES, WorldOptions(), np.random.default_rng(0))
        write_graph_bag(bag, GraphRecord(world.graph, world.odometry, np.arange(POSES)))
        for name, count in ('killed', kills), ('undisturbed', 0):
            (Path(folder) / name).mkdir()
            print(f'{name}: {_run(bag, Path(folder) / name / "map.g2o", count)}')
    rclpy.shutdown()


if __name__ == '__main__':
    main()
