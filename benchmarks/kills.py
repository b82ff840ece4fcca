# SPDX-License-Identifier: Apache-2.0
"""
A node that is killed again and again: what it loses, and what its map is worth in the end.

    python benchmarks/kills.py [KILLS]

A simulated world is played into `backend` as a process, which saves its map by itself. It is
killed with SIGKILL at random moments, every other time while it writes, and started again; then
all is played that came after the last keyframe of the map that it has loaded. Said are the
restarts that did not load, how much was lost at most, and the cost in the end beside that of a run
without kills.
"""

import argparse
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Its own domain: nobody else's messages are counted.
os.environ.setdefault('ROS_DOMAIN_ID', '95')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.bags.reader import read_raw
from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.messages.conversion import stamp_of
from l1slam_ros.ros.demo import executable

KILLS, POSES, EDGES = 60, 3000, 4800
_PERIOD = 1.0  # [s] from autosave to autosave
_RATE = 30.0  # [Hz] of the odometry
_LONGEST = 3.0  # [s] from the first message to the kill
_PATIENCE = 300.0  # [s]
_SAVE = 5e-6  # [s] it takes at least to save a keyframe
_AGAIN = 2 * 10**9  # [ns] before the last keyframe: loops since then are sent again
_KINDS = {ODOMETRY_TOPIC: Odometry, LOOP_TOPIC: PoseWithCovarianceStamped}


class Player:
    """Plays a bag into the node, which it starts, kills and starts again."""

    def __init__(self, bag: Path, path: Path, rng: np.random.Generator):
        self.messages = [(m.topic, m.time, m.data) for m in read_raw(bag, _KINDS)]
        self.path, self.rng = path, rng
        self.sent: dict[int, float] = {}  # stamp [ns] of odometry -> when it was sent [s]
        self.last = 0  # stamp of the last keyframe of the map that was loaded [ns]
        self.lost: list[float] = []
        self.inside = 0
        self.node: Any = None
        self.process: Any = None

    def start(self) -> None:
        """Start the node; where there is a map, take its last keyframe from its Path."""
        self.process = subprocess.Popen(
            [executable('backend'), '--ros-args', '--log-level', 'error',
             *(part for name, value in {
                 'save_path': self.path, 'autosave_period': _PERIOD, 'load_on_start': 'true',
                 'keyframe.translation': 0.0, 'keyframe.rotation': 0.0, 'keyframe.period': 0.0,
                 'odometry.covariance_source': 'increment'}.items()
               for part in ('-p', f'{name}:={value}'))])
        self.node, self.maps = rclpy.create_node('player'), []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(PathMessage, 'path', self.maps.append, latched)
        self.publishers = {topic: self.node.create_publisher(kind, topic, QoSProfile(depth=1000))
                           for topic, kind in _KINDS.items()}
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values()))
        if self.path.exists():
            assert self.until(lambda: bool(self.maps)), 'a map was not loaded'
            self.last = stamp_of(self.maps[-1].poses[-1].header)

    def until(self, condition: Callable[[], bool], seconds: float = _PATIENCE) -> bool:
        """Listen until something holds; return whether it did within some seconds."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline or self.process.poll() is not None:
                return False
            rclpy.spin_once(self.node, timeout_sec=0.02)
        return True

    def play(self, seconds: float) -> bool:
        """Play on from the last keyframe for some time; return whether that was all."""
        end, due = time.monotonic() + seconds, time.monotonic()
        for topic, stamp, data in self.messages:
            odometry = topic == ODOMETRY_TOPIC
            if stamp <= self.last - (0 if odometry else _AGAIN):
                continue
            if odometry:
                due += 1 / _RATE
                self.until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
                if time.monotonic() > end:
                    return False
                self.sent[stamp] = time.monotonic()
            self.publishers[topic].publish(data)
        return True

    def kill(self, inside: bool) -> None:
        """Kill the node, inside of a save or at any moment, start it again, note what is lost."""
        before = self._being_written()
        if inside:
            deadline = time.monotonic() + 2 * _PERIOD
            while not self._being_written() - before and time.monotonic() < deadline:
                pass  # a small map is written in two milliseconds
            size = len(self.maps[-1].poses) if self.maps else 0
            time.sleep(self.rng.uniform(0, _SAVE * size))
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        killed = time.monotonic()
        self.inside += bool(self._being_written() - before)
        self.node.destroy_node()
        self.start()
        self.lost.append(max((killed - when for stamp, when in self.sent.items()
                              if stamp > self.last), default=0.0))
        self.sent.clear()

    def _being_written(self) -> set[str]:
        return {name for name in os.listdir(self.path.parent) if name.endswith('.tmp')}

    def finish(self) -> str:
        """Play to the end and optimise; return the sentence of the node."""
        self.play(_PATIENCE)
        assert self.until(lambda: len(self.maps[-1].poses) == POSES)
        client = self.node.create_client(Trigger, '/backend/optimize')
        assert self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        assert self.until(future.done)
        self.process.send_signal(signal.SIGINT)
        self.process.wait()
        self.node.destroy_node()
        return str(future.result().message)


def _run(bag: Path, path: Path, kills: int) -> str:
    player = Player(bag, path, np.random.default_rng(kills))
    player.start()
    for k in range(kills):
        if player.play(player.rng.uniform(0.2, _LONGEST)):
            print(f'played to the end after {k} kills: make the world larger')
            break
        player.kill(inside=k % 2 == 1)
        print(f'kill {k + 1}: {len(player.maps[-1].poses) if player.maps else 0} keyframes '
              f'loaded, {player.lost[-1]:.2f} s lost', flush=True)
    if kills:
        print(f'{len(player.lost)} kills, {player.inside} of them inside of a save; at most '
              f'{max(player.lost):.2f} s lost, autosave every {_PERIOD} s')
    return player.finish()


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('kills', type=int, nargs='?', default=KILLS)
    kills = parser.parse_args().kills
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
