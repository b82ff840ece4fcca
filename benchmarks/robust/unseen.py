# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How often the robust mode is right, or says that it does not know, on worlds written apart from it.

A map is right where its position error (RMSE, rigidly aligned) is at most 1.5 times that of the
true loops alone (the better of L1 and L2) + .1 m. Half b, by a hash of the number, is kept shut
during development. Peers run where gtsam is, and take the reference from --out if it is there.

    python benchmarks/robust/unseen.py --count 100 --half a --out a.jsonl [--peers]
    python benchmarks/robust/unseen.py --table a.jsonl [--by lies]
"""

import argparse
import hashlib
import io
import json
import multiprocessing
import tempfile
import time
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from unseen_worlds import Array, World, draw

Record = dict[str, Any]
FACTOR, MARGIN = 1.5, .1
BINS = (0, .5, .7, .8, .9, .95, 1.001)
PEERS = ('gtsam-gm', 'gtsam-dcs', 'gtsam-gnc')
CHI2 = {3: 11.345, 6: 16.812}  # at 99%: a loop further off than that counts as refused by a peer


def half(number: int) -> str:
    """Return the half, a or b, that a world's number belongs to."""
    return 'ab'[hashlib.sha256(str(number).encode()).digest()[0] % 2]


def position_error(found: Array, truth: Array) -> float:
    """Return the RMSE of positions (n, 3) after rigid alignment."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    U, _, V = np.linalg.svd(a.T @ b)
    U[:, 2] *= np.linalg.det(U @ V)
    return float(np.sqrt(np.mean(np.sum((a @ U @ V - b) ** 2, axis=1))))


def _solve(world: World, used: Array, *options: str) -> tuple[Record, float]:
    """Solve by the command: what it prints, and the position error."""
    from l1slam_ros.cli.main import main

    with (tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as printed,
          redirect_stderr(io.StringIO()) as told):
        graph, solved = Path(folder, 'graph.g2o'), Path(folder, 'solved.g2o')
        graph.write_text(world.text(used))
        code = main(['solve', str(graph), '--output', str(solved), '--json', '--quiet', *options])
        if not solved.exists():
            return {'status': f'exit {code}: {told.getvalue().strip()}'}, np.inf
        rows = [line.split() for line in solved.read_text().splitlines()
                if line.startswith('VERTEX_SE')]
    found = np.zeros((len(rows), 3))
    plane = world.information.shape[1] == 3
    for row in rows:
        found[int(row[1]), :2 if plane else 3] = [float(x) for x in row[2:4 if plane else 5]]
    return json.loads(printed.getvalue()), position_error(found, world.truth[:, :3, 3])


def _base(number: int, world: World, method: str, references: list[float]) -> Record:
    return {'number': number, 'method': method, 'family': world.family, **world.facts,
            'keyframes': len(world.truth), 'loops': len(world.pairs) - len(world.truth) + 1,
            'false': int(world.false.sum()), 'references': references}


def _end(record: Record, error: float, world: World, refused: Array) -> Record:
    loop = np.arange(len(world.pairs)) >= len(world.truth) - 1
    return record | {
        'error': error, 'right': error <= FACTOR * min(record['references']) + MARGIN,
        'true_refused': int((loop & ~world.false & refused).sum()),
        'false_accepted': int((world.false & ~refused).sum())}


def _references(world: World) -> list[float]:
    errors = [_solve(world, ~world.false, '--no-robust', '--norm', norm)[1]
              for norm in ('l1', 'l2')]
    if not np.isfinite(errors).any():
        raise RuntimeError('the true loops alone were not solved')
    return errors


def run(number: int, references: list[float] | None = None) -> list[Record]:
    """Solve a world by the command, and, unless the errors are known, without false loops."""
    world = draw(number)
    began = time.perf_counter()
    said, error = _solve(world, np.ones(len(world.pairs), bool))
    seconds = time.perf_counter() - began
    unused = {tuple(pair) for pair in said.get('rejected', []) + said.get('suspect', [])}
    doubts = sorted({doubt['kind'] for doubt in said.get('doubts', [])})
    refused = np.array([tuple(pair) in unused for pair in world.pairs.tolist()])
    record = _base(number, world, 'l1slam', references or _references(world)) | {
        'status': said['status'], 'doubts': doubts, 'confidence': said.get('confidence'),
        'doubtful': said['status'] == 'doubtful' or said['status'].startswith('exit'),
        'slips': len(said.get('slips', [])), 'seconds': round(seconds, 3)}
    return [_end(record, error, world, refused)]


def run_peers(number: int, known: dict[int, list[float]]) -> list[Record]:
    """Solve a world by gtsam from the odometry chain, by three robust methods."""
    world = draw(number)
    n, d = len(world.truth), world.information.shape[1]
    factors, start = _gtsam_graph(world)
    references, records = known.get(number) or _references(world), []
    for name in PEERS:
        began = time.perf_counter()
        found = _peer(name, factors, start, n, d)
        seconds = round(time.perf_counter() - began, 3)
        at, x = found.atPose2 if d == 3 else found.atPose3, np.zeros((n, 3))
        x[:, :2 if d == 3 else 3] = [at(k).translation() for k in range(n)]
        refused = np.array([2 * factor.error(found) > CHI2[d] for factor in factors])
        record = _base(number, world, name, references) | {'doubtful': False, 'seconds': seconds}
        records.append(_end(record, position_error(x, world.truth[:, :3, 3]), world, refused))
    return records


def _gtsam_graph(world: World) -> tuple[list[Any], Any]:
    """Give the edges as factors of gtsam, and its start."""
    import gtsam

    d = world.information.shape[1]
    between = gtsam.BetweenFactorPose2 if d == 3 else gtsam.BetweenFactorPose3
    weight = world.information / np.array([1, 1, 1, 4, 4, 4])[:d]  # of the angle, as gtsam's
    sigmas = (1 / np.sqrt(weight))[:, [0, 1, 2] if d == 3 else [3, 4, 5, 0, 1, 2]]

    def pose(T: Array) -> Any:
        return (gtsam.Pose2(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])) if d == 3
                else gtsam.Pose3(T))

    start = gtsam.Values()
    for k, T in enumerate(world.start):
        start.insert(k, pose(T))
    return [between(int(i), int(j), pose(T), gtsam.noiseModel.Diagonal.Sigmas(s))
            for (i, j), T, s in zip(world.pairs, world.measured, sigmas, strict=True)], start


def _peer(name: str, factors: list[Any], start: Any, n: int, d: int) -> Any:
    """Optimise by a method of gtsam; the odometry is trusted."""
    import gtsam

    loss = gtsam.noiseModel.mEstimator
    robust = {'gtsam-gm': loss.GemanMcClure, 'gtsam-dcs': loss.DCS}.get(name)
    prior, origin = ((gtsam.PriorFactorPose2, start.atPose2(0)) if d == 3 else
                     (gtsam.PriorFactorPose3, start.atPose3(0)))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(prior(0, origin, gtsam.noiseModel.Isotropic.Sigma(d, 1e-4)))
    for k, factor in enumerate(factors):
        model = factor.noiseModel()
        if robust is not None and k >= n - 1:
            model = gtsam.noiseModel.Robust.Create(robust.Create(1.), model)
        graph.add(type(factor)(*factor.keys(), factor.measured(), model))
    if robust is not None:
        return gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    options = gtsam.GncLMParams()
    options.setKnownInliers(list(range(n)))
    return gtsam.GncLMOptimizer(graph, start, options).optimize()


def table(rows: list[Record], by: str) -> None:
    """Print how often maps are right, and whether what was said of them is true."""
    for method in dict.fromkeys(row['method'] for row in rows):
        of = [row for row in rows if row['method'] == method]
        print(f'\n{method:14}{"runs":>5}{"right":>12}{"r. doubted":>12}{"wrong, said":>12}'
              f'{"w. silent":>12}{"silent: wrong":>14}{"right: doubted":>15}'
              f'{"true refused":>13}{"false accepted":>15}')
        for name in [*sorted({row[by] for row in of}), 'all']:
            some = [row for row in of if name in ('all', row[by])]
            n, count = len(some), {(right, doubtful): sum(
                row['right'] == right and row['doubtful'] == doubtful for row in some)
                for right in (True, False) for doubtful in (True, False)}
            right = count[True, True] + count[True, False]
            cells = ''.join(f'{k:5}{_percent(k, n):>7}' for k in (
                right, count[True, True], count[False, True], count[False, False]))
            shares = ((count[False, False], count[False, False] + count[True, False]),
                      (count[True, True], right),
                      (sum(row['true_refused'] for row in some),
                       sum(row['loops'] - row['false'] for row in some)),
                      (sum(row['false_accepted'] for row in some),
                       sum(row['false'] for row in some)))
            print(f'{name:14}{n:5}{cells}' + ''.join(
                f'{_percent(*share):>{width}}'
                for share, width in zip(shares, (14, 15, 13, 15), strict=True)))
        silent = [row for row in of if not row['right'] and not row['doubtful']]
        exact = sum(row['false_accepted'] == 0 for row in silent)
        alone = sum(row['error'] <= FACTOR * row['references'][0] + MARGIN for row in silent)
        print(f'of {len(silent)} wrong and silent, {exact} accepted no false loop, {alone} are '
              'right by the reference of L1 alone')
        sure = [row for row in of if row.get('confidence') is not None]
        for low, high in zip(BINS[:-1], BINS[1:], strict=True):
            some = [row for row in sure if low <= row['confidence'] < high]
            if some:
                mean, right = (np.mean([row[key] for row in some])
                               for key in ('confidence', 'right'))
                print(f'confidence {low:.2f} to {min(high, 1):.2f}: {len(some):5} runs, '
                      f'said {mean:.3f}, right {right:.3f}, gap {right - mean:+.3f}')


def _percent(part: int, of: int) -> str:
    return f'{100 * part / of:.1f}%' if of else '-'


def read(files: Iterable[Path]) -> list[Record]:
    """Return the records of some files."""
    return [json.loads(line) for file in files if file.exists()
            for line in file.read_text().splitlines()]


def main() -> None:
    """Run worlds, or print the table of runs."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--first', type=int, default=0, help='number of the first world')
    parser.add_argument('--count', type=int, default=100, help='how many numbers')
    parser.add_argument('--half', choices=['a', 'b'], help='only the worlds of this half')
    parser.add_argument('--jobs', type=int, default=1, help='processes')
    parser.add_argument('--peers', action='store_true', help='solve by gtsam')
    parser.add_argument('--out', type=Path, default=Path('unseen.jsonl'), help='appended to')
    parser.add_argument('--table', type=Path, nargs='+', metavar='FILE', help='print these runs')
    parser.add_argument('--by', default='family', help='family, lies, noise or information')
    options = parser.parse_args()
    if options.table:
        table(read(options.table), options.by)
        return
    rows = read([options.out])
    done = {row['number'] for row in rows if row['method'] == (
        PEERS[-1] if options.peers else 'l1slam')}
    numbers = [k for k in range(options.first, options.first + options.count)
               if k not in done and options.half in (None, half(k))]
    known = {row['number']: row['references'] for row in rows}
    work = partial(run_peers, known=known) if options.peers else run
    spread = (multiprocessing.get_context('spawn').Pool(options.jobs).imap_unordered
              if options.jobs > 1 else map)
    with options.out.open('a', encoding='utf-8') as out:
        for records in spread(work, numbers):
            out.writelines(json.dumps(record) + '\n' for record in records)
            out.flush()


if __name__ == '__main__':
    main()
