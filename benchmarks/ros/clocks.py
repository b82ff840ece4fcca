# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The demo bag through the real node, with clocks and odometry as they are.

    python benchmarks/ros/clocks.py [BAG [RATE]]

Played once, by the machine's clock: that map is the yardstick. Then with `use_sim_time` and
`/clock` as a bag player sends it, with a clock that pauses for some seconds halfway, messages too
or only the clock, twice in a row, with and without `/clock`, and with a clock, and the messages
with it, that jump back by 20 s halfway. Then with odometry that begins again at the identity
halfway, or is 5e8 m away from there on, and that with no loop from then on.

Said is of each part of the map, one for each time that stamps go back, how far its keyframes are
from where they are in the undisturbed map, at worst and as RMSE, and its error to the truth,
aligned, beside those of the undisturbed map and of the odometry. Loops that are sent again are
known: what was played twice is odometry the second time. Where loops join two parts, the map is
compared, too, with the L1 optimum of the same factors and of what nobody told the node: that each
keyframe at which a part begins is where the robot was at that stamp. Where odometry begins anew,
one step of it is never told: what the loops allow is how far the undisturbed map's own factors,
solved without that step, end from what they say with it.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from peer import KINDS, Peer, arguments
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock

import l1slam_ros as l1
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.graph.parts import odometry_gaps
from l1slam_ros.io.bags.reader import read_messages, read_raw
from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC, TRUTH_TOPIC
from l1slam_ros.io.graphs.saved_map import load_map
from l1slam_ros.io.messages import conversion
from l1slam_ros.io.messages.conversion import stamp_of, stamped_pose
from l1slam_ros.ros.shell.header import header

BAG, RATE = Path('bags/demo'), 20.0
_SECOND = 10**9  # [ns]
_TICK = _SECOND // 20  # [ns] from one message on /clock to the next
_PAUSE, _BACK = 3.0, 20 * _SECOND  # [s], [ns]
_EXACT = 1e-4  # [m], [rad] what is nearer is the same
_NEAR = 0.05  # [m]

# What comes when, in the order it is sent: time on the clock [ns], topic, None: only the clock.
Event = tuple[int, str | None, bytes]


@dataclass(frozen=True)
class Undisturbed:
    """The map that is the yardstick: pose (3,) by stamp [ns], graph, stamps (n,) [ns]."""

    poses: dict[int, Array]
    graph: FactorGraph
    stamps: Indices


class Robot(Peer):
    """A peer that plays, by a clock of its own where that is wanted."""

    def __init__(self, sim_time: bool, path: Path):
        self.path = path
        super().__init__({'save_path': path, 'use_sim_time': str(sim_time).lower()})
        self.clock = self.node.create_publisher(Clock, '/clock', 10) if sim_time else None

    def play(self, events: Iterator[Event], rate: float) -> None:
        """Send events, so much faster than the clock in them runs."""
        before, due = None, time.monotonic()
        for now, topic, data in events:
            due += max(now - (now if before is None else before), 0) / _SECOND / rate
            before = now
            self.listen(due - time.monotonic())
            if topic is not None:
                self.publishers[topic].publish(data)
            elif self.clock is not None:
                self.clock.publish(Clock(clock=header('', now).stamp))

    def finish(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps (n,) and poses (n, 3) of the map once all that was sent is in it."""
        self.until(lambda: int(self.said['odom.received']) == count)
        self.call('optimize')
        self.until_calm('updates')
        assert self.end() == 0
        poses = self.newest().poses
        pose3 = np.array([stamped_pose(pose)[1] for pose in poses])
        return np.array([stamp_of(pose.header) for pose in poses]), se2.from_pose3(pose3)

    def saved(self) -> tuple[FactorGraph, Indices]:
        """Return the graph of what is accepted in the saved map, and the stamps (n,) [ns]."""
        saved = load_map(self.path)[0]
        accepted = saved.judgement.accepted
        return saved.builder.graph.subset(accepted), saved.builder.stamps


def joined(graph: FactorGraph, stamps: Indices) -> Array | None:
    """Return the optimum (n, 3) of a graph, its parts joined; None: no loops do."""
    if component_labels(graph).any():
        return None
    for begin in np.flatnonzero(np.diff(stamps) < 0) + 1:
        (same,) = np.flatnonzero(stamps[:begin] == stamps[begin])
        graph.add_between(np.array([same]), np.array([begin]), np.zeros((1, 3)),
                          np.eye(3)[None] / _EXACT**2)
    return l1.solve(graph, robust=False).poses


def without_step(graph: FactorGraph, stamps: Indices, stamp: int) -> Array:
    """Return how far the optimum moves (n,) [m] without the odometry to the time `stamp`."""
    factors, keyframe = graph.between, np.searchsorted(stamps, stamp)
    lost = factors.is_odometry & (factors.j == keyframe)
    with_it, without = (l1.solve(some, robust=False).poses
                        for some in (graph, graph.subset(~lost)))
    return np.linalg.norm(with_it[:, :2] - without[:, :2], axis=1)


def with_clock(messages: list[Event]) -> Iterator[Event]:
    """Yield messages between ticks of the clock that they were recorded by."""
    tick = messages[0][0]
    for message in messages:
        while tick <= message[0]:
            yield tick, None, b''
            tick += _TICK
        yield message


def pausing(messages: list[Event], everything: bool) -> Iterator[Event]:
    """Yield messages with a clock that stands for some seconds; everything: messages wait, too."""
    middle = messages[len(messages) // 2][0]
    stopped = False
    for now, topic, data in with_clock(messages):
        if now >= middle and not stopped:
            stopped = True
            if everything:
                time.sleep(_PAUSE)
        if topic is None and not everything and middle <= now < middle + _PAUSE * _SECOND:
            yield middle, None, b''
        else:
            yield now, topic, data


def jumping(messages: list[Event]) -> Iterator[Event]:
    """Yield messages until halfway, then from some time before that on."""
    middle = messages[len(messages) // 2][0]
    yield from with_clock([one for one in messages if one[0] < middle])
    yield from with_clock([one for one in messages if one[0] >= middle - _BACK])


def moved(messages: list[Event], frame: tuple[float, float, float],
          loops: bool = True) -> Iterator[Event]:
    """Yield messages whose odometry is in another frame from halfway on; loops : then, too."""
    middle, start = messages[len(messages) // 2][0], None
    for now, topic, data in messages:
        if now < middle or (topic == LOOP_TOPIC and loops):
            yield now, topic, data
        elif topic == ODOMETRY_TOPIC:
            message = deserialize_message(data, Odometry)
            pose = se2.from_pose3(stamped_pose(message)[1][None])
            start = pose if start is None else start
            pose3 = se2.to_pose3(se2.compose(np.array([frame]), se2.between(start, pose)))[0]
            position, turn = message.pose.pose.position, message.pose.pose.orientation
            position.x, position.y, turn.z, turn.w = pose3[[0, 1, 5, 6]].tolist()
            yield now, topic, serialize_message(message)


def main() -> None:
    """Measure, and print."""
    given = arguments(__doc__, bag=BAG, rate=RATE)
    bag, rate = given.bag, given.rate
    rclpy.init()
    messages: list[Event] = [(m.time, m.topic, m.data) for m in read_raw(bag, KINDS)]
    plays: dict[str, tuple[bool, Callable[[], Iterator[Event]]]] = {
        'once, the yardstick': (False, lambda: iter(messages)),
        'once again': (False, lambda: iter(messages)),
        'with /clock': (True, lambda: with_clock(messages)),
        'all pauses': (True, lambda: pausing(messages, True)),
        'the clock pauses': (True, lambda: pausing(messages, False)),
        'twice': (False, lambda: iter(messages * 2)),
        'twice, with /clock': (True, lambda: (
            e for _ in range(2) for e in with_clock(messages))),
        'back by 20 s': (True, lambda: jumping(messages)),
        'odometry restarts': (False, lambda: moved(messages, (0.0, 0.0, 0.0))),
        'odometry is 5e8 m away': (False, lambda: moved(messages, (5e8, 1e5, 1.0))),
        'and has no loops': (False, lambda: moved(messages, (5e8, 1e5, 1.0), loops=False)),
    }
    truth = dict(stamped_pose(m.data) for m in read_messages(bag, [TRUTH_TOPIC]))
    measured: dict[int, tuple[Array, ...]] = {}
    for _, topic, data in messages:
        if topic == ODOMETRY_TOPIC:
            sample = conversion.odometry_in(data)[1]
            measured[sample.stamp] = sample.pose3[:2], truth[sample.stamp][:2]
    undisturbed: Undisturbed | None = None
    folder = tempfile.TemporaryDirectory()
    for name, (sim_time, events) in plays.items():
        found = list(events())
        with Robot(sim_time, Path(folder.name) / 'map.g2o') as robot:
            robot.play(iter(found) if 'pause' not in name else events(), rate)
            stamps, poses = robot.finish(sum(topic == ODOMETRY_TOPIC for _, topic, _ in found))
        undisturbed = undisturbed or Undisturbed(dict(zip(stamps.tolist(), poses, strict=True)),
                                                 *robot.saved())
        _tell(name, stamps, poses, undisturbed, measured, robot)


def _tell(name: str, stamps: Indices, poses: Array, undisturbed: Undisturbed,
          measured: dict[int, tuple[Array, ...]], robot: Robot) -> None:
    said, (graph, _) = robot.said, robot.saved()
    # A stamp that comes twice is in two parts; each is told of on its own.
    parts = np.split(np.arange(len(stamps)), np.flatnonzero(np.diff(stamps) < 0) + 1)
    print(f'{name}: {len(stamps)} keyframes, {said["accepted_loops"]} loops accepted, '
          f'{said["rejected_loops"]} rejected', flush=True)
    optimum = joined(graph, stamps) if len(parts) > 1 else None
    for part in parts:
        both = [k for k in part if stamps[k] in undisturbed.poses]
        map_, before, odometry, true = (np.array(rows) for rows in zip(*(
            (poses[k, :2], undisturbed.poses[stamps[k]][:2], *measured[stamps[k]]) for k in both),
            strict=True))
        print(f'    of {len(both)}, off by {_far(map_, before)}; to the '
              f'truth {absolute_trajectory_error(map_, true):.3f} m, undisturbed '
              f'{absolute_trajectory_error(before, true):.3f}, '
              f'odometry {absolute_trajectory_error(odometry, true):.3f}', flush=True)
        if optimum is not None:
            print(f'    of the optimum that knows where it began, off by '
                  f'{_far(poses[part, :2], optimum[part, :2])}', flush=True)
    for gap in odometry_gaps(graph) + 1:
        if len(parts) == 1 and not component_labels(graph).any():
            moved = without_step(undisturbed.graph, undisturbed.stamps, int(stamps[gap]))
            print(f'    the undisturbed map without the step that is lost, off by {_of(moved)}',
                  flush=True)


def _far(positions: Array, others: Array) -> str:
    return _of(np.linalg.norm(positions - others, axis=1))


def _of(distances: Array) -> str:
    return (f'at most {distances.max():.3f} m ({np.sqrt(np.mean(distances**2)):.3f} RMSE, '
            f'{np.count_nonzero(distances > _NEAR)} beyond {_NEAR} m)')


if __name__ == '__main__':
    main()
