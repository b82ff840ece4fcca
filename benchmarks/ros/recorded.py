# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A graph over DDS, many times as fast as a robot drives: what is lost, how late poses are, the map.

    python benchmarks/ros/recorded.py GRAPH [RATE]

GRAPH is converted to a bag, and `replay` plays it to the node, both run as shipped, at so many
keyframes a second. A bare subscriber counts, and notes when odometry and the pose of the same
stamp come. Said is what each got, how much later poses came than odometry, by how much the Path is
above the L1 optimum of all factors, as it is five seconds after the last message and at rest, and
what the node takes of a core then.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from peer import KINDS, Peer, arguments, cpu_seconds, heard, spin

from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.bags.topics import LOOP_TOPIC, ODOMETRY_TOPIC
from l1slam_ros.io.graphs.graph_file import read_graph_file
from l1slam_ros.io.messages.conversion import stamped_pose
from l1slam_ros.ros.shell.installed import executable

RATE = 400.0
_BAG_RATE = 10.0  # keyframes a second, where a graph has no stamps
_AFTER = 5.0  # [s]
_IDLE = 20.0  # [s]
# As the note says that the conversion leaves in the bag.
_AS_RECORDED = {'keyframe.translation': 0.0, 'keyframe.rotation': 0.0,
                'odometry.covariance_source': 'increment', 'autosave_period': 0.0}


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ['hear']:
        return _hear()
    given = arguments(__doc__, graph=Path, rate=RATE)
    record = read_graph_file(given.graph)
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        write_graph_bag(Path(folder) / 'bag', record)
        ear = subprocess.Popen([sys.executable, __file__, 'hear'], stdout=subprocess.PIPE,
                               text=True)
        try:
            with Peer({'save_path': Path(folder) / 'map.g2o', **_AS_RECORDED}) as peer:
                _play(peer, record.graph, Path(folder) / 'bag', given.rate)
                peer.end()
        finally:
            ear.terminate()
        _tell(json.loads(ear.communicate()[0]), peer.said, record.graph)
    return 0


def _play(peer: Peer, graph: FactorGraph, bag: Path, rate: float) -> None:
    """Play a bag; print what the map is then, and what the node takes."""
    began = time.monotonic()
    subprocess.run([executable('replay'), str(bag), '--rate', str(rate / _BAG_RATE)], check=True)
    print(f'played in {time.monotonic() - began:.1f} s')
    peer.listen(_AFTER)
    _tell_map(peer.newest(), graph, f'{_AFTER:.0f} s later')
    peer.until(lambda: peer.said['behind.at_rest'] == '1')
    peer.listen(1.0)  # its Path
    _tell_map(peer.newest(), graph, 'at rest')
    before = cpu_seconds(peer.process.pid)
    peer.listen(_IDLE)
    share = (cpu_seconds(peer.process.pid) - before) / _IDLE
    print(f'at rest {share:.1%} of a core')


def _tell_map(path: PathMessage, graph: FactorGraph, when: str) -> None:
    """Print how far a map is above the optimum that is near it."""
    poses = graph.manifold.from_pose3(np.array([stamped_pose(at)[1] for at in path.poses]))
    if len(poses) < graph.n_poses:
        print(f'{when}: a Path of {len(poses)} poses, expected {graph.n_poses}')
        return
    cost = l1_cost(whitened_residual(graph, poses))
    best = minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0].cost
    print(f'{when}: L1 cost {cost:.2f}, {cost / best - 1:.3%} above the optimum')


def _hear() -> int:
    """Note when messages come until told to end; print it."""
    rclpy.init()
    node = rclpy.create_node('ear')
    kinds = {**KINDS, 'pose': PoseStamped}
    notes = {topic: heard(node, kind, topic) for topic, kind in kinds.items()}
    spin(node)
    print(json.dumps(notes))
    return 0


def _tell(notes: dict[str, list[tuple[int, int]]], said: dict[str, str],
          graph: FactorGraph) -> None:
    """Print what was lost, and how late poses were."""
    loops = int((~graph.between.is_odometry).sum())
    for topic, sent in ((ODOMETRY_TOPIC, graph.n_poses), (LOOP_TOPIC, loops)):
        print(f'{topic}: {sent} played, a bare subscriber got {len(notes[topic])}, the node '
              f'{said[f"{topic[1:]}.received"]}')
    came = dict(notes[ODOMETRY_TOPIC])
    late = [(at - came[stamp]) * 1e-6 for stamp, at in notes['pose'] if stamp in came]
    p50, p99 = np.percentile(late, (50, 99))
    print(f'{len(late)} poses, after the odometry by {p50:.1f} ms in the median, p99 {p99:.1f}, '
          f'{max(late):.0f} at most')


if __name__ == '__main__':
    sys.exit(main())
