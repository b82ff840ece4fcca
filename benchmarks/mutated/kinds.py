# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Small sound inputs of every kind that is read, and the commands that read them."""

import bz2
import gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

import l1slam_ros as l1
from l1slam_ros.cli.main import main as command
from l1slam_ros.io.graphs.saved_map import save_map

POSES = 30
NOTE = '{keyframes: every, covariance: increment}'
TYPES = get_typestore(Stores.ROS2_JAZZY)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
# The fields of pose_graph_tools_msgs.
POSE_GRAPH = 'pose_graph_tools_msgs/msg/PoseGraph'
TYPES.register({name: fields for key, text in {
    f'{POSE_GRAPH}Node': 'std_msgs/Header header\nint32 robot_id\nuint64 key\n'
        'geometry_msgs/Pose pose\n',
    f'{POSE_GRAPH}Edge': 'std_msgs/Header header\nuint64 key_from\nuint64 key_to\n'
        'int32 robot_from\nint32 robot_to\nint32 type\ngeometry_msgs/Pose pose\n'
        'float64[36] covariance\n',
    POSE_GRAPH: 'std_msgs/Header header\nPoseGraphNode[] nodes\nPoseGraphEdge[] edges\n',
}.items() for name, fields in get_types_from_msg(text, key).items()})
_EXTRA = """\
EQUIV 3 20
RGBD_DATA 0 1 image.png
EDGE_PRIOR_SE2 4 1 2 .1 4 0 0 4 0 9
EDGE_PRIOR_SE2_XY 9 3 2 4 0 4
VERTEX_SE2 1000 3 3 0
EDGE_SE2 5 1000 1 1 0 9 0 0 9 0 9
EDGE_SE2 7 1000 1 0 0 9 0 0 9 0 9
EDGE_SE2 25 1000 0 1 0 9 0 0 9 0 9
"""
_SPACE = 'EDGE_SE3_XYZPRIOR 4 0 1 2 3 4 0 0 4 0 4\nEDGE_SE3_PRIORXY 9 1 2 4 0 4\n'


class Option(NamedTuple):
    """An option of some commands: one of its texts is taken."""

    commands: tuple[str, ...]
    text: tuple[str, ...]


_READ = 'solve', 'merge', 'convert', 'info', 'plot', 'corrupt'
_OPTIONS = (
    Option(('solve', 'merge'), ('--no-robust', '--robust')),
    Option(('solve', 'merge'), ('--norm l2', '--norm huber', '--norm group-l1', '--norm l1')),
    Option(('solve',), ('--loop-norm huber', '--loop-norm l2')),
    Option(('solve',), ('--solver primal-dual', '--solver interior-point')),
    Option(('solve',), ('--start file', '--start odometry')),
    Option(('solve',), ('--outer 3', '--inner 20')),
    Option(('solve',), ('--output {folder}/o.g2o', '--output {folder}/o.jrl',
                        '--output {folder}/o.tum', '--output {folder}/o')),
    Option(('solve',), ('--report {folder}/o.html', '--plot {folder}/o.png')),
    Option(('solve',), ('--json',)),
    Option(_READ, ('--information 25', '--information 1e300', '--information 1e-300')),
    Option(_READ, ('--rotation-information angle',)))
_SOLVE = 'solve {input} --quiet'
_ALL = (_SOLVE, _SOLVE, 'info {input}', 'convert {input} {folder}/out.g2o',
        'convert {input} {folder}/out', 'convert {input} {folder}/out.jrl',
        'plot {input} --output {folder}/out.png',
        'merge {input} {sound}/plane/graph.g2o --output {folder}/both.g2o --quiet',
        'merge {sound}/plane/graph.g2o {input} --output {folder}/both.g2o --quiet',
        'corrupt {input} {folder}/worse.g2o --false-loops 3 --kind grouped')
_PLANE = 'solve {sound}/plane/graph.g2o --quiet '


class Kind(NamedTuple):
    """
    A kind of input.

    folder : of its files; input : the one that a command names; damaged : a pattern of those that
    are damaged, empty for all
    """

    name: str
    folder: str
    input: str
    commands: tuple[str, ...] = _ALL
    damaged: str = ''
    options: tuple[Option, ...] = _OPTIONS


KINDS = (
    Kind('g2o in the plane', 'plane', 'graph.g2o', damaged='graph.g2o'),
    Kind('g2o in space', 'space', 'graph.g2o', damaged='graph.g2o'),
    Kind('g2o with all else', 'extra', 'graph.g2o', damaged='graph.g2o'),
    Kind('solved g2o', 'solved', 'graph.g2o', damaged='graph.g2o'),
    Kind('g2o without information', 'bare', 'graph.g2o', tuple(
        f'{words} --information {x}' for words in _ALL for x in (25, 1e-25, 1e-9, 1e9, 1e28))),
    Kind('TORO', 'toro', 'graph.graph'),
    Kind('packed g2o', 'packed', 'graph.g2o.gz'),
    Kind('packed TORO', 'packed_toro', 'graph.toro.bz2'),
    Kind('JRL', 'jrl', 'graph.jrl'),
    Kind('JRL in space', 'jrl3', 'graph.jrl'),
    Kind('packed JRL', 'packed_jrl', 'graph.jrl.gz'),
    Kind('JRL in CBOR', 'cbor', 'graph.cbor'),
    Kind('CARMEN', 'carmen', 'log.clf', (*_ALL, f'{_SOLVE} --grid {{folder}}/o.pgm')),
    Kind('packed CARMEN', 'packed_carmen', 'log.gz'),
    Kind('mcap', 'mcap', 'bag.mcap'),
    Kind('db3', 'db3', 'bag.db3'),
    Kind('directory of mcap', 'mcap_directory', 'bag'),
    Kind('directory of db3', 'db3_directory', 'bag'),
    Kind('splits', 'splits', 'bag'),
    Kind('packed directory', 'packed_directory', 'bag'),
    Kind('bag in space', 'bag3', 'bag'),
    Kind('bag with scans', 'scans', 'bag', (
        *_ALL, f'{_SOLVE} --scans /scan', f'{_SOLVE} --scans /scan --grid {{folder}}/o.pgm')),
    Kind('bag of a pose graph', 'pose_graph', 'bag', (f'{_SOLVE} --odom-topic /pose_graph',
        *(f'{words} --odom-topic /pose_graph' for words in _ALL))),
    Kind('bag of ROS 1', 'ros1', 'bag.bag'),
    Kind('truth', 'plane', 'graph.g2o.truth.txt', (
        f'{_PLANE} --reference {{input}}',
        f'{_PLANE} --reference {{input}} --plot {{folder}}/o.png',
        'plot {folder}/graph.g2o --output {folder}/o.png'), '*.truth.txt'),
    Kind('truth as TUM', 'tum', 'truth.tum', (f'{_PLANE} --reference {{input}}',)),
    Kind('truth as CSV', 'csv', 'truth.csv', (f'{_PLANE} --reference {{input}}',)),
    Kind('files beside a graph', 'beside', 'graph.g2o', damaged='*.txt'),
    Kind('file of loops', 'loops', 'loops.txt', (
        'merge {sound}/plane/graph.g2o {sound}/toro/graph.graph --loops {input} --quiet '
        '--output {folder}/o.g2o',)),
    Kind('parameters', 'parameters', 'node.yaml', tuple(
        f'{what} --params-file {{input}}' for what in (
            _PLANE, 'solve {sound}/mcap/bag.mcap --quiet', 'info {sound}/bag3/bag',
            'convert {sound}/db3/bag.db3 {folder}/o.g2o'))),
    Kind('saved map', 'map', 'map.g2o', ('load {input}', 'load {input}', *_ALL)),
    Kind('saved map in space', 'map3', 'map.g2o', ('load {input}', 'load {input}', *_ALL)))


def write_kinds(folder: Path) -> None:
    """Write one sound input of each kind; check that its first command is content with it."""
    for kind in KINDS:
        (folder / kind.folder).mkdir(exist_ok=True, parents=True)

    def run(words: str) -> None:
        code = command(words.format(f=folder).split())
        if code not in (0, 4):
            raise SystemExit(f'{words}: {code}')

    size = f'--poses {POSES} --edges {POSES + 15} --seed 1'
    run(f'simulate {{f}}/plane/graph.g2o {size} --false-loops 2')
    run(f'simulate {{f}}/space/graph.g2o {size} --world building')
    run(f'simulate {{f}}/bag3/bag {size} --world sphere')
    run('simulate {f}/scans/bag --poses 60 --edges 75 --scans')
    plane = (folder / 'plane/graph.g2o').read_text()
    with (folder / 'space/graph.g2o').open('a') as file:
        file.write(_SPACE)
    (folder / 'extra/graph.g2o').write_text(plane + _EXTRA)
    (folder / 'bare/graph.g2o').write_text(''.join(
        f'{" ".join(line.split()[:6])}\n' for line in plane.splitlines()))
    run('solve {f}/extra/graph.g2o --output {f}/solved/graph.g2o --quiet')
    for suffix, name in (('jrl', 'plane'), ('jrl3', 'space')):
        run(f'convert {{f}}/{name}/graph.g2o {{f}}/{suffix}/graph.jrl')
    run('convert {f}/plane/graph.g2o {f}/cbor/graph.cbor')
    run('convert {f}/plane/graph.g2o {f}/mcap_directory/bag')
    toro = plane.replace('_SE2', '2') + 'EQUIV 3 20\n'
    (folder / 'toro/graph.graph').write_text(toro)
    (folder / 'packed_toro/graph.toro.bz2').write_bytes(bz2.compress(toro.encode()))
    (folder / 'packed/graph.g2o.gz').write_bytes(gzip.compress(plane.encode()))
    (folder / 'packed_jrl/graph.jrl.gz').write_bytes(
        gzip.compress((folder / 'jrl/graph.jrl').read_bytes()))
    _write_beside(folder, plane)
    _write_log(folder)
    _write_bags(folder)
    _write_maps(folder)
    for kind in KINDS:
        words = kind.commands[0].format(input=folder / kind.folder / kind.input, sound=folder,
                                        folder=folder / kind.folder)
        if not words.startswith('load'):
            run(words)
    run('plot {f}/plane/graph.g2o --output {f}/map.png')
    (folder / 'map.png').unlink()


def _write_beside(folder: Path, plane: str) -> None:
    edges = [line.split() for line in plane.splitlines() if line.startswith('EDGE')]
    loops = [f'{i} {j}' for _, i, j, *_ in edges if int(j) - int(i) != 1]
    graph = folder / 'beside/graph.g2o'
    graph.write_text(plane)
    for what, lines in (('trusted', loops[:4]), ('struck', loops[4:6]), ('false', loops[6:8]),
                        ('stamps', [f'{k} {1000 + k / 10}' for k in range(POSES)])):
        Path(f'{graph}.{what}.txt').write_text('\n'.join([*lines, '']))
    truth = (folder / 'plane/graph.g2o.truth.txt').read_text().splitlines()
    rows = [line.split() for line in truth if line[0] != '#']
    (folder / 'tum/truth.tum').write_text(''.join(
        f'{1000 + int(k) / 10} {x} {y} 0 0 0 {np.sin(float(t) / 2)} {np.cos(float(t) / 2)}\n'
        for k, x, y, t in rows))
    (folder / 'csv/truth.csv').write_text('stamp, x, y, theta\n' + ''.join(
        f'{1000 + int(k) / 10}, {x}, {y}, {t}\n' for k, x, y, t in rows))
    (folder / 'loops/loops.txt').write_text(''.join(
        f'EDGE_SE2 1:{k} 2:{k} 0 0 0 50 0 0 50 0 100\n' for k in range(0, POSES, 4)))
    (folder / 'parameters/node.yaml').write_bytes(
        (Path(__file__).parents[2] / 'config/backend.yaml').read_bytes())


def _write_log(folder: Path) -> None:
    """Write scans of a square room, along its walls and back."""
    lines = []
    angles = np.deg2rad(np.arange(90) * 2 - 89)
    for k in range(24):
        x, y, theta = 2 * np.cos(k / 4), 2 * np.sin(k / 4), k / 4 + np.pi / 2
        c, s = np.cos(theta + angles), np.sin(theta + angles)
        ranges = np.minimum((5 - np.sign(c) * x) / abs(c), (4 - np.sign(s) * y) / abs(s))
        pose = f'{x:.3f} {y:.3f} {theta:.3f}'
        lines.append(f'FLASER 90 {" ".join(f"{r:.2f}" for r in ranges)} {pose} {pose} '
                     f'{1000 + k / 4} host {k / 4}\n')
    (folder / 'carmen/log.clf').write_text(''.join(lines))
    (folder / 'packed_carmen/log.gz').write_bytes(gzip.compress(''.join(lines).encode()))


def _write_bags(folder: Path) -> None:
    with AnyReader([folder / 'mcap_directory/bag']) as reader:
        recording = [(one.topic, one.msgtype, time, bytes(data))
                     for one, time, data in reader.messages()]
    sqlite, mcap = StoragePlugin.SQLITE3, StoragePlugin.MCAP
    _write_bag(folder / 'db3_directory/bag', recording, sqlite)
    _write_bag(folder / 'packed_directory/bag', recording, mcap, CompressionMode.FILE)
    _write_bag(folder / 'one', recording, sqlite)
    (folder / 'one/one.db3').rename(folder / 'db3/bag.db3')
    _write_bag(folder / 'two', recording, mcap)
    (folder / 'two/two.mcap').rename(folder / 'mcap/bag.mcap')
    (folder / 'splits/bag').mkdir()
    for k in range(3):
        part = folder / f'bag_{k}'
        _write_bag(part, recording[k::3], mcap)
        (part / f'bag_{k}.mcap').rename(folder / f'splits/bag/bag_{k}.mcap')
        text = (part / 'metadata.yaml').read_text()
        (part / 'metadata.yaml').unlink()
    (folder / 'splits/bag/metadata.yaml').write_text(text.replace('  - bag_2.mcap\n', ''.join(
        f'  - bag_{k}.mcap\n' for k in range(3))))
    _write_messages(Rosbag1Writer(folder / 'ros1/bag.bag'), ROS1, [
        (topic, msgtype, time, TYPES.cdr_to_ros1(data, msgtype))
        for topic, msgtype, time, data in recording])
    _write_bag(folder / 'pose_graph/bag', [
        ('/pose_graph', POSE_GRAPH, 10**12,
         bytes(TYPES.serialize_cdr(_pose_graph(), POSE_GRAPH)))], mcap)


def _pose_graph() -> object:
    made = TYPES.types

    def header(seconds: int) -> object:
        return made['std_msgs/msg/Header'](made['builtin_interfaces/msg/Time'](seconds, 0), 'map')

    def pose(x: float) -> object:
        return made['geometry_msgs/msg/Pose'](made['geometry_msgs/msg/Point'](x, 0.0, 0.0),
                                              made['geometry_msgs/msg/Quaternion'](0., 0., 0., 1.))

    ends = [(k, k + 1, 0, 1.0) for k in range(19)] + [(k, k + 9, 1, 9.0) for k in range(0, 10, 2)]
    edge = made[f'{POSE_GRAPH}Edge']
    return made[POSE_GRAPH](
        header(100), [made[f'{POSE_GRAPH}Node'](header(100 + k), 0, k, pose(float(k)))
                      for k in range(20)],
        [edge(header(100), i, j, 0, 0, kind, pose(x), 0.01 * np.eye(6).ravel())
         for i, j, kind, x in ends])


def _write_bag(path: Path, recording: list[tuple], plugin: StoragePlugin,
               mode: CompressionMode = CompressionMode.NONE) -> None:
    writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    if path.parent.name != 'pose_graph':
        writer.set_custom_data('l1slam', NOTE)
    _write_messages(writer, TYPES, recording)


def _write_messages(writer: Rosbag1Writer | Rosbag2Writer, types: Typestore,
                    recording: list[tuple]) -> None:
    with writer:
        known = {}
        for topic, msgtype, time, data in recording:
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=types)
            writer.write(known[topic], time, data)


def _write_maps(folder: Path) -> None:
    """Write the map of a drive around a square, with loops in it, refused, and to come."""
    for dimension, name in ((2, 'map'), (3, 'map3')):
        with l1.Backend(l1.BackendOptions(), dimension) as backend:
            turn = np.array((0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)))
            corner, sides = np.array((0., 0, 0, 1)), ((1, 0), (0, 1), (-1, 0), (0, -1))
            x = y = 0.0
            for k in range(40):
                side = k // 5 % 4
                x, y = x + sides[side][0], y + sides[side][1]
                if k % 5 == 0 and k:
                    corner = np.array((0, 0, corner[2] * turn[3] + corner[3] * turn[2],
                                       corner[3] * turn[3] - corner[2] * turn[2]))
                pose = np.array((x, y, 0, *corner))
                backend.add_odometry(l1.OdometrySample(
                    (100 + k) * 10**9, pose, 0.01 * np.eye(6), 0.01 * np.eye(6)))
            for k in (*range(2, 18, 3), 60):
                backend.add_loop(l1.LoopClosure(
                    (100 + k) * 10**9, (120 + k) * 10**9, np.array((0., 0, 0, 0, 0, 0, 1)),
                    0.01 * np.eye(6)))
            backend.add_loop(l1.LoopClosure(
                103 * 10**9, 130 * 10**9, np.array((1., 0, 0, 0, 0, 0, 1)), 0.01 * np.eye(6)))
            backend.settle()
            save_map(folder / name / 'map.g2o', backend.saved())
