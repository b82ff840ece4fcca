# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Worlds as files, made by `l1slam simulate` or by NumPy."""

import math
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np

from l1slam_ros.cli.main import main


def made(path, poses, edges, *more):
    """Simulate a world at a path, without a word; return the path."""
    with redirect_stdout(StringIO()):
        assert main(['simulate', str(path), '--poses', str(poses), '--edges', str(edges),
                     *map(str, more)]) == 0
    return path


def graph_file(folder, lines):
    """Write a graph of these lines; return its path."""
    path = folder / 'graph.g2o'
    path.write_text('\n'.join(lines) + '\n')
    return path


def truth_of(path):
    """Return the true poses of a world in the plane, (n, 3)."""
    return np.loadtxt(f'{path}.truth.txt')[:, 1:]


def false_of(path):
    """Return the ids of the false loops of a world, a list of pairs."""
    return np.loadtxt(f'{path}.false.txt', dtype=int, ndmin=2).tolist()


def lines_of(path, tag):
    """Return the fields behind the first words of the lines that begin so, as strings."""
    rows = [line.split() for line in Path(path).read_text().splitlines()]
    return [row[1:] for row in rows if row and row[0].startswith(tag)]


def pairs_of(path):
    """Return the ids of the edges of a g2o file, a list of pairs in its order."""
    return [[int(row[0]), int(row[1])] for row in lines_of(path, 'EDGE_SE')]


def edges_of(path):
    """Return i, j, measurement (3,) and information (3, 3) of each edge in the plane."""
    edges = []
    for i, j, *numbers in lines_of(path, 'EDGE_SE2'):
        measurement, upper = np.split(np.array(numbers, float), [3])
        information = np.zeros((3, 3))
        information[np.triu_indices(3)] = upper
        edges.append((int(i), int(j), measurement,
                      information + np.triu(information, 1).T))
    return edges


def compose(a, b):
    """Return a b of poses x, y, theta, (n, 3)."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack((a[..., 0] + cos * b[..., 0] - sin * b[..., 1],
                     a[..., 1] + sin * b[..., 0] + cos * b[..., 1],
                     wrapped(a[..., 2] + b[..., 2])), axis=-1)


def between(a, b):
    """Return a^-1 b of poses x, y, theta, (n, 3)."""
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack((cos * x + sin * y, cos * y - sin * x, wrapped(b[..., 2] - a[..., 2])),
                    axis=-1)


def wrapped(angle):
    """Return angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def whitened(graph, poses):
    """Return the whitened residuals (m, 3) of a graph in the plane at poses (n, 3)."""
    factors, poses = graph.between, np.vstack((poses, np.zeros(3)))  # the last is of the world
    error = between(factors.measurement, between(poses[factors.i], poses[factors.j]))
    return np.einsum('mij,mj->mi', factors.sqrt_information, error)


def position_error(found, truth):
    """Return the RMSE of positions (n, d) [m] after rigid alignment."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    return float(np.sqrt(((a @ (U @ Vt) - b)**2).sum(axis=1).mean()))


def edge(i, j, measurement, information):
    """Return a line of g2o; information : (3, 3)."""
    numbers = *measurement, *np.asarray(information, float)[np.triu_indices(3)]
    return f'EDGE_SE2 {i} {j} ' + ' '.join(repr(float(number)) for number in numbers)


def torn(path):
    """
    Write a drive whose refused loops agree on another map; return the ids where these end.

    Its halves are joined by 72 loops, all in runs that are off by the same; ids begin with 100.
    """
    made(path, 400, 609)
    truth, half, first, run = truth_of(path), 200, 100, np.arange(8)
    edges = []
    for i, j, measurement, information in edges_of(path):
        if j == i + 1:  # with half of the noise of rotations
            turn = truth[j, 2] - truth[i, 2]
            measurement[2] = turn + wrapped(measurement[2] - turn) / 2
            information[2, 2] *= 4
        if j == i + 1 or (i < half) == (j < half):
            edges.append(edge(first + i, first + j, measurement, information))
    for start in range(9):
        i, j = 5 + 20 * start + run, 210 + 20 * start + run
        off = between(truth[i], compose(np.array([8.0, -6.0, 0.4]), truth[j]))
        edges += [edge(first + i[k], first + j[k], off[k], np.diag([400.0, 400.0, 1e4]))
                  for k in run]
    Path(path).write_text('\n'.join(edges) + '\n')
    return np.array([105, 478])


def off_by(path, offset):
    """Move all loops of a graph in the plane by an offset x, y, theta (3,); return its path."""
    Path(path).write_text('\n'.join(
        edge(i, j, Z if j == i + 1 else compose(Z, np.array(offset)), information)
        for i, j, Z, information in edges_of(path)) + '\n')
    return path


def as_map(path):
    """Give a graph in the plane poses by odometry, stamps, and ids from 0: the node loads it."""
    edges, poses = edges_of(path), [np.zeros(3)]
    first = min(i for i, *_ in edges)
    for measurement in [Z for i, j, Z, _ in sorted(edges, key=lambda e: e[0]) if j == i + 1]:
        poses.append(compose(poses[-1], measurement))
    lines = [f'VERTEX_SE2 {k} {x!r} {y!r} {yaw!r}'
             for k, (x, y, yaw) in enumerate(np.array(poses).tolist())]
    lines += [edge(i - first, j - first, *numbers) for i, j, *numbers in edges]
    Path(path).write_text('\n'.join(lines) + '\n')
    Path(f'{path}.stamps.txt').write_text(''.join(
        f'{k} {1 + k}.000000000\n' for k in range(len(poses))))
    return path


def edited(path, change):
    """Let `change(words, is_odometry)` change the words of each edge of a g2o file, in place."""
    lines = [line.split() for line in path.read_text().splitlines()]
    for line in lines:
        if line and line[0] == 'EDGE_SE2':
            change(line, int(line[2]) == int(line[1]) + 1)
    path.write_text('\n'.join(map(' '.join, lines)) + '\n')
    return path


def drifting(line, is_odometry):
    """Turn odometry by 20 mrad a metre."""
    if is_odometry:
        line[5] = repr(float(line[5]) + 0.02 * math.hypot(float(line[3]), float(line[4])))


def simulated_bag(path, poses, edges, *more):
    """Write a simulated world as a bag without its truth; more : options; return the path."""
    with tempfile.TemporaryDirectory() as name:
        graph = made(Path(name) / 'a.g2o', poses, edges, *more)
        assert main(['convert', str(graph), str(path)]) == 0
    return path


def write_g2o(path, pairs, measured, information, stamps=None, ids=None):
    """
    Write a graph file of edges alone, as other programs do, and stamps beside it; return the path.

    pairs : (m, 2), -1 first: of an absolute pose; measured : (m, 3), or (m, 7) with a quaternion;
    information : (m, d, d), of the angle; stamps : (n,) [ns]; ids : (n,); none: 0 and so on
    """
    size = information.shape[1]
    between, absolute = (('EDGE_SE2', 'EDGE_PRIOR_SE2') if size == 3 else
                         ('EDGE_SE3:QUAT', 'EDGE_SE3_PRIOR'))
    lines = [] if size == 3 else ['PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1']
    for (i, j), pose, matrix in zip(np.array(pairs).tolist(), measured.tolist(), information,
                                    strict=True):
        i, j = (k if ids is None or k < 0 else ids[k] for k in (i, j))
        ends = (between, i, j) if i >= 0 else (absolute, j) if size == 3 else (absolute, j, 0)
        lines.append(' '.join(map(str, (*ends, *pose, *matrix[np.triu_indices(size)].tolist()))))
    path.write_text('\n'.join(lines) + '\n')
    if stamps is not None:
        path.with_name(f'{path.name}.stamps.txt').write_text(''.join(
            f'{k if ids is None else ids[k]} {int(stamp) // 10**9}.{int(stamp) % 10**9:09}\n'
            for k, stamp in enumerate(stamps)))
    return path
