# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How long a command takes before it works, beside the imports of the libraries it stands on.

    python benchmarks/cli/startup.py [GRAPH] [--rounds N] [--cold]

Whole processes, run by turns, medians of the processor's time [s], and its ratio to the import of
numpy, of scipy.sparse and of numba alone. "one loop" links and calls the smallest of our compiled
loops and nothing else; "by numba": as where no machine code is kept, from numba's cache. `--cold`:
the first solve with an empty cache, too, the processes that compile included. Without a graph a
simulated one is solved.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.compilation import fill_cache
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file

_YARDSTICKS = ('numpy', 'scipy.sparse', 'numba')
_ONE_LOOP = ('import numpy as np; from l1slam_ros.core import native; '
             'native.blocks.whiten(np.ones((1, 3, 3)), np.ones((1, 3)))')
_BY_NUMBA = 'from l1slam_ros.core.kernels.kept import objects; objects.read = lambda step: {}; '
_COMMAND = 'import sys; from l1slam_ros.cli.main import main; sys.exit(main())'


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0].strip())
    parser.add_argument('graph', type=Path, nargs='?')
    parser.add_argument('--rounds', type=int, default=7)
    parser.add_argument('--cold', action='store_true')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        graph = str(options.graph or _simulated(Path(folder) / 'world.g2o'))
        fill_cache(lambda done, total: None, lambda: False)
        commands = {
            **{name: ['-c', f'import {name}'] for name in _YARDSTICKS},
            'one loop': ['-c', _ONE_LOOP],
            'l1slam --help': ['-c', _COMMAND, '--help'],
            'l1slam info': ['-c', _COMMAND, 'info', graph],
            'l1slam solve --no-robust': ['-c', _COMMAND, 'solve', graph, '--quiet', '--no-robust'],
            'l1slam solve': ['-c', _COMMAND, 'solve', graph, '--quiet'],
            'l1slam solve by numba': ['-c', _BY_NUMBA + _COMMAND, 'solve', graph, '--quiet'],
        }
        seconds: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(options.rounds):
            for name, arguments in commands.items():
                seconds[name].append(_seconds(arguments))
        _print({name: statistics.median(times) for name, times in seconds.items()})
        if options.cold:
            cold = {'NUMBA_CACHE_DIR': str(Path(folder) / 'cache')}
            spent = _seconds(commands['l1slam solve'], cold)
            print(f'first `l1slam solve` with an empty cache: {spent:.1f} s')


def _simulated(path: Path) -> Path:
    world = simulate_world(1000, 1800, WorldOptions(), np.random.default_rng(0))
    write_graph_file(path, GraphRecord(world.graph, world.odometry, np.arange(1000)))
    return path


def _seconds(arguments: list[str], settings: dict[str, str] | None = None) -> float:
    """Return the processor's time of a Python process and of all that it waited for [s]."""
    before = _spent()
    # Else each process would parse all modules anew, which no installed one does.
    kept = {name: value for name, value in os.environ.items()
            if name != 'PYTHONDONTWRITEBYTECODE'}
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL,
                   env={**kept, **(settings or {})})
    return _spent() - before


def _spent() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _print(medians: dict[str, float]) -> None:
    print(f'{"":24}{"seconds":>9}' + ''.join(f'{"/ " + name:>15}' for name in _YARDSTICKS))
    for name, value in medians.items():
        ratios = ''.join(f'{value / medians[other]:15.2f}' for other in _YARDSTICKS)
        print(f'{name:24}{value:9.3f}{ratios}')


if __name__ == '__main__':
    main()
