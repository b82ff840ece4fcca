# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
`l1slam batch` over many small recordings, some of them hostile: results, kills, and what it costs.

    python benchmarks/fleet/batch.py [--recordings 1000] [--hostile 20] [--poses 300] [--kills 4]
        [--folder DIR] [--pairs 0]

Every third recording is a bag, the others are g2o files. They are solved by two workers, by one,
and by two while the command and its workers are killed; the tables must be the same bytes, else it
ends with 1. All stays in the folder, and recordings that are there already are not made again; the
code must not change meanwhile, as a batch is resumed by the version that began it alone.

With `--pairs` nothing is killed: so many times all recordings are solved by two workers and by
one, in turn. Printed are the times by the clock, their ratios and the median of these, and what
they took of the processor.
"""

import argparse
import csv
import json
import os
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from hostile import HOSTILE

from l1slam_ros.core.worlds.false_loops import FALSE_LOOPS
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops
from l1slam_ros.io import formats
from l1slam_ros.io.graphs.graph_file import GraphRecord

_COMMAND = ('import sys; from l1slam_ros.cli.main import main; sys.exit(main())')


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--recordings', type=int, default=1000, help='the hostile ones included')
    parser.add_argument('--hostile', type=int, default=20)
    parser.add_argument('--poses', type=int, default=300, help='of the largest recording')
    parser.add_argument('--kills', type=int, default=4, help='of the command, and of a worker')
    parser.add_argument('--pairs', type=int, default=0, help='only time so many pairs of runs')
    parser.add_argument('--folder', type=Path, help='where to work (default: a temporary one)')
    return parser.parse_args()


def make(folder: Path, count: int, hostile: int, poses: int) -> None:
    """Make the recordings, of `poses` / 4 to `poses` poses, twenty to a folder."""
    every = count // hostile
    for number in range(count):
        path = folder / f'day{number // 20:03d}' / f'run{number:05d}'
        path.parent.mkdir(parents=True, exist_ok=True)
        if number % every == every // 2:
            HOSTILE[number // every % len(HOSTILE)](path)
            continue
        rng = np.random.default_rng(number)
        n = int(rng.integers(poses // 4, poses + 1))
        world = simulate_world(n, int(1.6 * n), WorldOptions(), rng)
        lies = FALSE_LOOPS['random'](world.graph, world.truth, n // 50, rng)
        world = with_false_loops(world, lies)
        formats.write_output(path if number % 3 == 0 else path.with_suffix('.g2o'),
                             GraphRecord(world.graph, world.odometry, np.arange(n)))


def start(folder: Path, output: Path, *options: str) -> 'subprocess.Popen[str]':
    """Start the command."""
    return subprocess.Popen(
        [sys.executable, '-c', _COMMAND, 'batch', str(folder), '--output', str(output), *options],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def whole(folder: Path, output: Path, workers: int) -> float:
    """Run it to its end; return how long it took [s]."""
    began, cpu = time.perf_counter(), _cpu_of_children()
    process = start(folder, output, '--workers', str(workers))
    said = process.communicate()[1]
    seconds, cpu = time.perf_counter() - began, _cpu_of_children() - cpu
    solving = sum(line['cpu_seconds'] for line in lines(output))
    print(f'{workers} worker(s): code {process.returncode}, {seconds:.1f} s; of the processor '
          f'{solving:.1f} s for recordings, {cpu - solving:.1f} s besides; load of the machine '
          f'{os.getloadavg()[0]:.2f}; {said.strip().splitlines()[-1]}', flush=True)
    return seconds


def _cpu_of_children() -> float:
    """Return the processor time of what this process started [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def pairs(folder: Path, place: Path, count: int) -> None:
    """Solve all with two workers and with one, in turn, so many times."""
    ratios = []
    for number in range(count):
        seconds = {}
        for workers in ((2, 1), (1, 2))[number % 2]:
            output = place / f'pair{number}of{workers}'
            seconds[workers] = whole(folder, output, workers)
            shutil.rmtree(output)
        ratios.append(seconds[2] / seconds[1])
        print(f'pair {number}: two workers take {ratios[-1]:.2f} of the time of one', flush=True)
    print(f'two workers take {statistics.median(ratios):.2f} of the time of one, in the median of '
          f'{count} pairs, {min(ratios):.2f} to {max(ratios):.2f}')


def killed(folder: Path, output: Path, kills: int, seconds: float) -> None:
    """Kill the command so many times while it runs, and each time a worker before; resume."""
    for number in range(kills + 1):
        process = start(folder, output, '--workers', '2', *(['--resume'] if number else []))
        if number < kills:
            time.sleep(seconds / (kills + 1) / 2)
            begun = Path(f'/proc/{process.pid}/task/{process.pid}/children')
            for worker in begun.read_text().split()[:1]:
                with suppress(ProcessLookupError):
                    os.kill(int(worker), signal.SIGKILL)
            time.sleep(seconds / (kills + 1) / 2)
            process.kill()
        said = process.communicate()[1].strip().splitlines()[-1:] if number == kills else []
        process.wait()
        print(f'killed: code {process.returncode}, {len(lines(output)):,} done', *said, flush=True)


def lines(output: Path) -> list[dict[str, object]]:
    """Return what the log says of recordings."""
    path = output / 'log.jsonl'
    text = path.read_text().split('\n')[1:-1] if path.exists() else []
    return [line for line in map(json.loads, text) if 'recording' in line]


def report(folder: Path, results: list[Path], seconds: list[float]) -> bool:
    """Print what came out, and what a recording costs; return whether all runs are the same."""
    with open(results[0] / 'table.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    failed = [row for row in rows if row['status'] == 'failed']
    print(f'{len(rows):,} recordings, {len(rows) - len(failed):,} maps, {len(failed)} sentences:')
    for row in failed:
        print(f'  {row["sentence"]}')
    alike = []
    for name in ('table.csv', 'maps'):
        alike.append(all(
            content(output / name) == content(results[0] / name) for output in results))
        print(f'{name}: {"the same bytes" if alike[-1] else "NOT THE SAME"} in all '
              f'{len(results)} runs')
    twice = len(lines(results[-1])) - len({line['recording'] for line in lines(results[-1])})
    print(f'recordings done twice over the kills: {twice}')
    found = [line for line in lines(results[1]) if line['row']['status'] != 'failed']
    cpu = np.array([line['cpu_seconds'] for line in found])
    peak = max(line['peak_bytes'] for line in lines(results[1]))
    print(f'two workers take {seconds[0] / seconds[1]:.2f} of the time of one')
    print(f'processor: {cpu.mean():.3f} s a recording, {cpu.max():.3f} s at most; with one worker '
          f'{seconds[1] / len(rows):.3f} s by the clock, all included; most memory '
          f'{peak / 1e6:.0f} MB')
    for name, path in (('read', folder), ('maps', results[0] / 'maps'),
                       ('log', results[0] / 'log.jsonl'), ('CSV', results[0] / 'table.csv'),
                       ('parquet', results[0] / 'table.parquet')):
        print(f'{name}: {size(path) / len(rows):,.0f} bytes a recording')
    return all(alike) and not twice


def content(path: Path) -> dict[str, bytes]:
    """Return all bytes of a file, or of the files of a folder, by their names."""
    files = [path] if path.is_file() else sorted(path.rglob('*'))
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.is_file()}


def size(path: Path) -> int:
    """Return how many bytes a file or a folder has."""
    files = [path] if path.is_file() else path.rglob('*')
    return sum(file.stat().st_size for file in files if file.is_file())


def main() -> int:
    """Run all of it."""
    arguments = parse()
    place = arguments.folder or Path(tempfile.mkdtemp(prefix='l1slam_fleet_'))
    folder = place / 'recordings'
    if not folder.exists():
        make(folder, arguments.recordings, arguments.hostile, arguments.poses)
    if arguments.pairs:
        pairs(folder, place, arguments.pairs)
        return 0
    results = [place / f'results{k}' for k in range(3)]
    seconds = [whole(folder, results[k], 2 - k) for k in (0, 1)]
    killed(folder, results[2], arguments.kills, seconds[0])
    return int(not report(folder, results, seconds))


if __name__ == '__main__':
    sys.exit(main())
