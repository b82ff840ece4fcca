# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The node on a small computer: one core, and as much memory as a control group allows.

    python benchmarks/ros/small.py GRAPH GROUPS [RATE [PARAMS]]
    python benchmarks/ros/small.py within GROUPS COMMAND ...

The node runs as shipped on the first core, in the control groups of the folders GROUPS, joined by
colons, which have limits and are made beforehand; all others run elsewhere. GRAPH is played to it
at so many keyframes a second; PARAMS is a params file. Said is how long the start took, how long
updates took until the map that they made was published, how late poses were, the processor's
time, and the most memory that the node had, and the groups. It ends with 1 where the node was
killed.

The second form runs any command, with all that it starts, on the first core in these groups, and
says at the end the most memory that they had.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from peer import Peer, UpdateTimes, arguments, cpu_seconds, heard

from l1slam_ros.io.bags.from_graph import write_graph_bag
from l1slam_ros.io.graphs.graph_file import read_graph_file
from l1slam_ros.ros.shell.installed import executable

RATE = 40.0
DEFAULTS = Path(__file__).parents[2] / 'config' / 'backend.yaml'
_BAG_RATE = 10.0  # keyframes a second, where a graph has no stamps
_EVERY = {'keyframe.translation': 0.0, 'keyframe.rotation': 0.0,
          'odometry.covariance_source': 'increment'}


class Played(Peer):
    """A peer that notes how long updates took."""

    def __init__(self, parameters: dict[str, object], groups: str, params: str):
        self.updates = UpdateTimes()
        super().__init__(parameters, [sys.executable, __file__, 'join', groups],
                         ['--params-file', params])

    def _hear(self, message: object) -> None:
        super()._hear(message)
        self.updates.note(self.said)


def main() -> int:
    """Measure and print."""
    if sys.argv[1:2] == ['join']:
        return _join(sys.argv[2], sys.argv[3:])
    if sys.argv[1:2] == ['within']:
        return _within(sys.argv[2], sys.argv[3:])
    given = arguments(__doc__, graph=Path, groups=str, rate=RATE, params=str(DEFAULTS))
    record = read_graph_file(given.graph)
    os.sched_setaffinity(0, set(range(1, os.cpu_count() or 2)))
    rclpy.init()
    with tempfile.TemporaryDirectory() as folder:
        write_graph_bag(Path(folder) / 'bag', record)
        began = time.monotonic()
        with Played({'save_path': Path(folder) / 'map.g2o', **_EVERY}, given.groups,
                    given.params) as peer:
            print(f'ready after {time.monotonic() - began:.1f} s', flush=True)
            sent = heard(peer.node, Odometry, 'odom')
            poses = heard(peer.node, PoseStamped, 'pose')
            began, cpu = time.monotonic(), cpu_seconds(peer.process.pid)
            player = subprocess.Popen([executable('replay'), str(Path(folder) / 'bag'), '--rate',
                                       str(given.rate / _BAG_RATE)], stderr=subprocess.DEVNULL)
            peer.until(lambda: player.poll() is not None)
            seconds = time.monotonic() - began
            cpu = cpu_seconds(peer.process.pid) - cpu
            peer.until_calm('keyframes')
            _tell(peer, sent, poses, cpu / seconds)
            most = _most(peer.process.pid)
            code = peer.end()
    print(f'the node had at most {most:.0f} MiB, the groups {groups_most(given.groups):.0f} MiB; '
          f'ended with {code}')
    return int(code != 0)


def _join(groups: str, command: list[str]) -> int:
    """Become a command on the first core, in control groups."""
    for group in groups.split(':'):
        (Path(group) / 'cgroup.procs').write_text(str(os.getpid()))
    os.sched_setaffinity(0, {0})
    os.execvp(command[0], command)


def _within(groups: str, command: list[str]) -> int:
    """Run a command on the first core, in control groups; say the most memory they had."""
    code = subprocess.call([sys.executable, __file__, 'join', groups, *command])
    print(f'the groups had at most {groups_most(groups):.0f} MiB; ended with {code}')
    return code


def _tell(peer: Played, sent: list[tuple[int, int]], poses: list[tuple[int, int]],
          share: float) -> None:
    when = dict(sent)
    late = [1e-6 * (at - when[stamp]) for stamp, at in poses if stamp in when]
    print(f'{peer.said["keyframes"]} keyframes, {peer.said["factors"]} factors, '
          f'{share:.0%} of the core; {peer.updates.sentence}; pose after odometry: median '
          f'{np.median(late):.1f} ms, p99 {np.percentile(late, 99):.1f}')
    print(f'the node says: {peer.said["message"]}')


def _most(process: int) -> float:
    """Return the most memory that a process had [MiB]."""
    (line,) = (line for line in Path(f'/proc/{process}/status').read_text().splitlines()
               if line.startswith('VmHWM'))
    return int(line.split()[1]) / 1024


def groups_most(groups: str) -> float:
    """Return the most memory that control groups had [MiB], in either version of them."""
    (file,) = (file for group in groups.split(':')
               for file in (Path(group) / 'memory.max_usage_in_bytes', Path(group) / 'memory.peak')
               if file.exists())
    return int(file.read_text()) / 2**20


if __name__ == '__main__':
    sys.exit(main())
