# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What the scan front end makes of a laser log, by truth: error, loops, places, grid, cost, memory.

    python benchmarks/scans.py --datasets DIR [--logs fr079,intel] [--variants all]

DIR/lidar holds the logs and their corrected poses. Each of these is of one scan, and does not bear
its stamp but the time at which the logger wrote it down, in six digits: by that the scan is found.
Where it does not tell two scans apart, as some came in heaps, or where the scan's own stamp is out
of order, the pose is left out. Where a keyframe was in truth is the nearest
corrected pose, and scan-matched odometry from there. A loop is false where it is off by more than
FAR or TURNED. A place is a square of SIDE; it is seen again each time that the robot comes into
it, if it had been within NEAR of where it is then, and has gone APART since. It is closed where a
true loop leads back from there, or from within NEAR of way. The grid is compared with the one of
the same keyframes' scans where the corrected log has them, laid on the map as a whole: of the
cells that both know, so many are free in both or occupied in both. Seconds are the processor's, on
one thread, and of the front end alone: what a scan costs `scan_loops`.

With --variants a row for each log made of a recorded one, see `log_variants`: the error where a
scan is near a corrected pose, false loops and all, parts, the doubts of the map, and what else is
said.
"""

import argparse
import bz2
import resource
import time
from pathlib import Path

import numpy as np
from log_variants import VARIANTS, TrueLog

from l1slam_ros.cli.reference import position_error, read_truth
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error, align
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.scans.front_end import ScanFrontEnd
from l1slam_ros.core.scans.occupancy.grid import draw
from l1slam_ros.core.scans.points import Points
from l1slam_ros.io.scans.carmen import read_carmen
from l1slam_ros.io.scans.to_graph import ScanMap, map_scans
from l1slam_ros.io.trajectory import read_reference

# [m], [rad]
FAR, TURNED = 0.5, 0.1
# [m]
SIDE = 2.0
NEAR = 2.0
APART = 10.0
# [ns] So near to a corrected pose a scan tells the error of a variant, which may have few.
NEAR_SCAN = 10**8


class Timed:
    """A front end's calls, and what each scan took of the processor [s]."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def __enter__(self) -> 'Timed':
        """Measure every front end."""
        self._add, self._loops = ScanFrontEnd.add, ScanFrontEnd.loops
        add = self._add
        loops = self._loops
        seconds = self.seconds

        def timed_add(front_end: ScanFrontEnd, *arguments: object) -> object:
            began = time.thread_time()
            step = add(front_end, *arguments)
            seconds.append(time.thread_time() - began)
            return step

        def timed_loops(front_end: ScanFrontEnd) -> object:
            began = time.thread_time()
            found = loops(front_end)
            seconds[-1] += time.thread_time() - began
            return found

        ScanFrontEnd.add, ScanFrontEnd.loops = timed_add, timed_loops
        return self

    def __exit__(self, *_: object) -> None:
        """Measure no more."""
        ScanFrontEnd.add, ScanFrontEnd.loops = self._add, self._loops


def scans_of(log: Path, times: Indices) -> tuple[Indices, Indices]:
    """Return which times [ns] of corrected poses are of one scan, and the stamps of the scans."""
    with bz2.open(log) as lines:
        scans = [words for words in map(bytes.split, lines) if words[0] == b'FLASER']
    stamps = np.array([round(float(words[-3]) * 1e9) for words in scans])
    written = np.array([float(f'{float(words[-1]):.6g}') for words in scans])
    # The logger's clock begins with the log: by so much later is what agrees most often.
    off, often = np.unique(
        np.round(times[:200, None] * 1e-9 - written, 4), return_counts=True)
    near = abs(times[:, None] * 1e-9 - written - off[often.argmax()]) < 2e-4
    rows = np.flatnonzero(near.sum(axis=1) == 1)
    return rows, stamps[near[rows].argmax(axis=1)]


def true_poses(made: ScanMap, stamps: Indices, truth: Array) -> Array:
    """Return where the keyframes were, (n, 3), by true poses (m, 3) at stamps [ns]."""
    rows, keyframes, steps = made.path.steps_at(stamps, 10**10, 10**6)
    own = made.record.times
    found = np.full((len(own), 3), np.nan)
    nearest = np.full(len(own), np.inf)
    for row, keyframe, step in zip(rows, keyframes, steps, strict=True):
        if (off := abs(stamps[row] - own[keyframe])) < nearest[keyframe]:
            nearest[keyframe] = off
            found[keyframe] = se2.compose(truth[row][None], se2.inverse(step[None]))[0]
    # Keyframes without a corrected pose of their own: by odometry from those beside.
    graph = made.record.graph.between
    steps = list(zip(graph.pairs[graph.is_odometry].tolist(),
                     graph.measurement[graph.is_odometry][:, None], strict=True))
    for (i, j), step in steps:
        if np.isnan(found[j, 0]):
            found[j] = se2.compose(found[i][None], step)[0]
    for (i, j), step in reversed(steps):
        if np.isnan(found[i, 0]):
            found[i] = se2.compose(found[j][None], se2.inverse(step))[0]
    return found


def false_loops(made: ScanMap, truth: Array) -> tuple[Indices, np.ndarray]:
    """Return the pairs of all loops (l, 2), and which are false."""
    factors = made.record.graph.between
    pairs = factors.pairs[~factors.is_odometry]
    true = se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    off = se2.between(true, factors.measurement[~factors.is_odometry])
    return pairs, (np.hypot(off[:, 0], off[:, 1]) > FAR) | (abs(off[:, 2]) > TURNED)


def places(pairs: Indices, truth: Array) -> tuple[int, int]:
    """Return how many times a place was seen again, and how many of these are closed."""
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))))
    square = np.floor(truth[:, :2] / SIDE).astype(int)
    comes = np.concatenate(([0], np.cumsum((np.diff(square, axis=0) != 0).any(axis=1))))
    again = np.array([
        (np.hypot(*(truth[:k, :2] - truth[k, :2]).T)[way[:k] < way[k] - APART] < NEAR).any()
        for k in range(len(truth))])
    from_loop = abs(way - way[pairs.max(axis=1)][:, None]).min(axis=0, initial=np.inf)
    return len(set(comes[again])), len(set(comes[again & (from_loop < NEAR)]))


def laid_on(poses: Array, truth: Array) -> Array:
    """Return true poses (n, 3), moved as a whole to where they are nearest to others."""
    R, t = align(truth[:, :2], poses[:, :2])
    return np.column_stack((truth[:, :2] @ R.T + t, truth[:, 2] + np.arctan2(R[1, 0], R[0, 0])))


def grid_agreement(points: list[Points], poses: Array, truth: Array) -> tuple[float, float]:
    """Return how long the grid took to draw [s], and which part of its cells is as in truth's."""
    draw(points[:1], poses[:1])  # compiled, or read
    began = time.thread_time()
    own = draw(points, poses)
    took = time.thread_time() - began
    true = draw(points, laid_on(poses, truth))
    first = np.round((true.origin - own.origin) / own.resolution).astype(int)
    low = np.minimum(first, 0)
    end = np.maximum(own.log_odds.shape, first + true.log_odds.shape)
    cells = np.full((2, *(end - low)), -1, np.int8)
    for both, grid, at in ((cells[0], own, -low), (cells[1], true, first - low)):
        a, b = grid.log_odds.shape
        both[at[0] : at[0] + a, at[1] : at[1] + b] = grid.occupancy
    known = (cells >= 0).all(axis=0)
    return took, float((cells[0] == cells[1])[known].mean())


def rms(off: Array) -> float:
    """Return the root of the mean square of vectors (n, k)."""
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def print_variants(given: argparse.Namespace) -> None:
    """Measure logs made of the recorded ones, and print a row for each."""
    names = VARIANTS if given.variants == 'all' else given.variants.split(',')
    for name in given.logs.split(','):
        folder = given.datasets / 'lidar'
        reference = read_reference(folder / f'{name}.truth.csv', se2, by_stamps=True)
        recorded = TrueLog(read_carmen(folder / f'{name}.clf.bz2'), reference.keys,
                           reference.poses)
        for variant in names:
            drawn = VARIANTS[variant](recorded, np.random.default_rng(0))
            log = drawn.log
            made = map_scans(zip(log.scans, log.wheels, strict=True), log.mount)
            outcome = solve(made.record.graph, None, SolveOptions())
            poses = outcome.solution.poses
            rows, keyframes, steps = made.path.steps_at(drawn.stamps, 10**10, 10**6)
            after = np.searchsorted(made.path.stamps, drawn.stamps[rows], side='right')
            nearest = np.stack([abs(drawn.stamps[rows] - made.path.stamps[np.clip(
                k, 0, len(made.path.stamps) - 1)]) for k in (after - 1, after)]).min(axis=0)
            near = nearest < NEAR_SCAN
            error = absolute_trajectory_error(
                se2.compose(poses[keyframes], steps)[near, :2], drawn.truth[rows][near, :2])
            doubts = outcome.judgement.doubts if outcome.judgement else ()
            # `solve` doubts a drive in parts, too.
            kinds = [doubt.kind for doubt in doubts] + ['parts'] * (outcome.parts > 1)
            said = ', '.join(dict.fromkeys(kinds)) or 'none'
            print(f'{name}, {variant}: error {error:.3f} m, {outcome.parts} parts; doubts: {said}',
                  *made.record.skipped, sep='; ', flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description='the scan front end on laser logs, by truth')
    parser.add_argument('--datasets', type=Path, required=True, metavar='DIR')
    parser.add_argument('--logs', default='fr079,intel')
    parser.add_argument('--variants', metavar='NAME,...',
                        help='logs made of the recorded ones instead; all, or some of '
                        + ', '.join(VARIANTS))
    given = parser.parse_args()
    if given.variants:
        print_variants(given)
        return
    for name in given.logs.split(','):
        folder = given.datasets / 'lidar'
        log = read_carmen(folder / f'{name}.clf.bz2')
        with Timed() as timed:
            made = map_scans(zip(log.scans, log.wheels, strict=True), log.mount)
        table = folder / f'{name}.truth.csv'
        reference = read_reference(table, se2, by_stamps=True)
        rows, stamps = scans_of(folder / f'{name}.clf.bz2', reference.keys)
        used = np.isin(stamps, made.path.stamps)
        truth = true_poses(made, stamps[used], reference.poses[rows[used]])
        pairs, false = false_loops(made, truth)
        again, closed = places(pairs[~false], truth)
        outcome = solve(made.record.graph, None, SolveOptions())
        error = position_error(made.record, outcome.solution.poses, read_truth(
            str(table), made.record, folder / f'{name}.clf.bz2', made.path))
        took, agree = grid_agreement(made.points, outcome.solution.poses, truth)
        off = se2.between(laid_on(outcome.solution.poses, truth), outcome.solution.poses)
        milliseconds = 1e3 * np.array(timed.seconds)
        print(f'{name}: {len(log.scans):,} scans, {len(truth):,} keyframes, error {error:.3f} m, '
              f'{outcome.solution.status}')
        print(f'  of {len(reference.keys):,} corrected poses {used.sum():,} are of a scan that is '
              f'known; by these keyframes are off by {rms(off[:, :2]):.3f} m and '
              f'{rms(off[:, 2:]):.3f} rad')
        print(f'  {len(pairs)} loops, {false.sum()} false; {closed} of {again} places closed '
              f'({closed / max(again, 1):.0%})')
        print(f'  the grid takes {took:.2f} s; {agree:.1%} of its cells are as the corrected log '
              'has them')
        print(f'  a scan takes {np.median(milliseconds):.2f} ms in the median, p99 '
              f'{np.quantile(milliseconds, 0.99):.1f} ms; '
              f'{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB so far',
              flush=True)


if __name__ == '__main__':
    main()
