# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Drives in the plane with false loops, slips and drift, and what `l1slam solve` finds in them."""

import json
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np
from worlds import (
    between,
    compose,
    edges_of,
    false_of,
    lines_of,
    made,
    position_error,
    truth_of,
    wrapped,
    write_g2o,
)

from l1slam_ros.cli.main import main

SURE = np.diag([400.0, 400.0, 4e4])


@dataclass(frozen=True)
class Drive:
    """
    A graph in the plane.

    pairs : (m, 2) of keyframes, -1 first: of an absolute pose; measured : (m, 3);
    information : (m, 3, 3); false : (m,) bool, which loops are false; truth : (n, 3)
    """

    pairs: np.ndarray
    measured: np.ndarray
    information: np.ndarray
    false: np.ndarray
    truth: np.ndarray

    @property
    def is_odometry(self):
        """(m,) bool."""
        i, j = self.pairs.T
        return (j == i + 1) & (i >= 0)

    def rows(self, which):
        """Return the drive with some of its edges, (m,) bool or (k,)."""
        return replace(self, pairs=self.pairs[which], measured=self.measured[which],
                       information=self.information[which], false=self.false[which])

    def restated(self, odometry, loops):
        """Return the drive where odometry and loops state so many times their sigmas."""
        times = np.where(self.is_odometry, odometry, loops)
        return replace(self, information=self.information / times[:, None, None]**2)

    def seen(self, pairs, noise=0.0, information=SURE, false=False):
        """Return the drive with more edges (k, 2), measured in truth with this error (k, 3)."""
        i, j = np.reshape(pairs, (-1, 2)).T
        exact = between(self.truth[i], self.truth[j])
        measured = compose(exact, np.broadcast_to(noise, exact.shape))
        return self.told(np.stack((i, j), axis=1), measured, information, false)

    def told(self, pairs, measured, information=SURE, false=False):
        """Return the drive with more edges (k, 2) of measurements (k, 3)."""
        return replace(
            self, pairs=np.concatenate((self.pairs, pairs)),
            measured=np.concatenate((self.measured, measured)),
            information=np.concatenate((self.information, np.broadcast_to(
                information, (len(pairs), 3, 3)))),
            false=np.concatenate((self.false, np.full(len(pairs), false))))

    def slipped(self, steps, off):
        """Return the drive, its odometry wrong by `off` (3,) or (s, 3) behind keyframes (s,)."""
        measured = self.measured.copy()
        rows = np.flatnonzero(self.is_odometry & np.isin(self.pairs[:, 0], steps))
        measured[rows] = compose(measured[rows], np.broadcast_to(off, (len(rows), 3)))
        return replace(self, measured=measured)

    def drifting(self, drift):
        """Return the drive whose odometry turns by so much less than it did [rad/m]."""
        measured, rows = self.measured.copy(), self.is_odometry
        measured[rows, 2] -= drift * np.hypot(*measured[rows, :2].T)
        return replace(self, measured=measured)

    def write(self, path):
        """Write the graph; return its path."""
        return write_g2o(path, self.pairs, self.measured, self.information)


def drive_of(truth):
    """Return the drive of which nothing is measured yet."""
    return Drive(np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool),
                 truth)


def chain_of(n):
    """Return the pairs of a chain, (n - 1, 2)."""
    return np.stack((np.arange(n - 1), np.arange(1, n)), axis=1)


def careful(n, edges, seed=0, lies=0, kind='random'):
    """Return a simulated drive, its odometry with half of the noise of rotations."""
    with tempfile.TemporaryDirectory() as name:
        path = made(Path(name) / 'world.g2o', n, edges, '--seed', seed, '--false-loops', lies,
                    '--kind', kind)
        i, j, measured, information = map(np.array, zip(*edges_of(path), strict=True))
        truth, false = truth_of(path), {tuple(pair) for pair in false_of(path)} if lies else set()
    steps = j == i + 1
    turn = truth[j[steps], 2] - truth[i[steps], 2]
    measured[steps, 2] = turn + wrapped(measured[steps, 2] - turn) / 2
    information[steps, 2, 2] *= 4
    pairs = np.stack((i, j), axis=1)
    return Drive(pairs, measured, information,
                 np.array([tuple(pair) in false for pair in pairs.tolist()]), truth)


@dataclass(frozen=True)
class Map:
    """
    A solved drive.

    said : the object of `--json`; poses : (n, 3); accepted, suspect : (m,) bool
    """

    drive: Drive
    said: dict
    poses: np.ndarray
    accepted: np.ndarray
    suspect: np.ndarray

    @property
    def error(self):
        """The RMSE of the positions [m]."""
        return position_error(self.poses[:, :2], self.drive.truth[:, :2])

    @property
    def slips(self):
        """The keyframes behind which the odometry slipped."""
        return [i for i, _ in self.said['slips']]

    @property
    def doubts(self):
        """The kinds of the doubts."""
        return [doubt['kind'] for doubt in self.said['doubts']]

    @property
    def kept(self):
        """How many false loops are in the map."""
        return np.count_nonzero(self.accepted & self.drive.false)

    @property
    def lost(self):
        """How many true edges, odometry too, are not in the map."""
        return np.count_nonzero(~self.accepted & ~self.drive.false)


def solved(drive, norm='l2', trusted=()):
    """Solve a drive, of which a person vouches for some pairs; return its `Map`."""
    with tempfile.TemporaryDirectory() as name:
        path, output = drive.write(Path(name) / 'a.g2o'), Path(name) / 'b.g2o'
        Path(f'{path}.trusted.txt').write_text(''.join(f'{i} {j}\n' for i, j in trusted))
        said = StringIO()
        with redirect_stdout(said), redirect_stderr(StringIO()):
            code = main(['solve', str(path), '--json', '--output', str(output), '--norm', norm])
        poses = np.array([row[1:] for row in lines_of(output, 'VERTEX')], float)
        notes = [line.split() for line in output.read_text().splitlines() if line[0] == '#']
    said = json.loads(said.getvalue())
    # A map that may be wrong is no success, and a doubt is always said.
    assert (said['status'] == 'doubtful') == bool(said['doubts']) == (code == 4)
    # What is not used stands there in comments, each with its row.
    left, suspect = (np.isin(np.arange(len(drive.pairs)), [
        int(words[-1]) for words in notes if words[1] in kinds])
        for kinds in (('rejected', 'suspect', 'slip'), ('suspect',)))
    assert left.sum() == len(said['rejected']) + len(said['suspect'])
    return Map(drive, said, poses, ~left, suspect)


def laps(n, count, loops, odometry, seed=1, lies=0):
    """
    Return a drive of n keyframes, `count` laps of one square; loops see the lap before.

    odometry : its sigmas [m, rad]; lies : false loops, which join any two keyframes
    """
    rng, side = np.random.default_rng(seed), n // count // 4
    quarter = np.arange(n) // side % 4
    heading = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[quarter]
    position = np.concatenate((np.zeros((1, 2)), np.cumsum(heading[:-1], axis=0)))
    drive = drive_of(np.column_stack((position, wrapped(quarter * np.pi / 2))))
    i = np.sort(rng.choice(n - 4 * side - 1, loops, replace=False))
    pairs = np.stack((i, i + 4 * side + rng.integers(-1, 2, size=loops)), axis=1)
    for ends, (metres, radians) in (chain_of(n), odometry), (pairs, (0.05, 0.01)):
        sigmas = np.array([metres, metres, radians])
        drive = drive.seen(ends, sigmas * rng.standard_normal((len(ends), 3)),
                           np.diag(sigmas**-2))
    return with_lies(drive, lies, rng)


def with_lies(drive, count, rng):
    """Return the drive with false loops, from anywhere to anywhere in its map."""
    n, extent = len(drive.truth), np.ptp(drive.truth[:, :2])
    pairs = np.sort(rng.permuted(np.tile(np.arange(n), (count, 1)), axis=1)[:, :2], axis=1)
    pairs[:, 1] += pairs[:, 1] == pairs[:, 0] + 1
    pairs = pairs[pairs[:, 1] < n]
    claimed = rng.uniform(-1, 1, (len(pairs), 3)) * [extent / 2, extent / 2, np.pi]
    sure = drive.information[~drive.is_odometry]
    return drive.told(pairs, claimed, sure[0] if len(sure) else SURE, True)
