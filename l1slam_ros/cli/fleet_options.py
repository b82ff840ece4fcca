# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The options of the commands that are about many recordings: batch and merge."""

import argparse
from pathlib import Path

from l1slam_ros.core import names


def add_batch(parser: argparse.ArgumentParser) -> None:
    """Add the options of `batch`, without those on how a recording is read."""
    add = parser.add_argument
    add('folder', type=Path, metavar='FOLDER',
        help='each file and rosbag2 directory in it that `solve` takes, however deep, is one '
        'recording; hidden ones are none')
    add('--output', type=Path, required=True, metavar='FOLDER',
        help='new or empty: maps/RECORDING.g2o, log.jsonl with a line for each recording, '
        'table.csv, and table.parquet where pyarrow is installed')
    add('--resume', nargs='?', choices=('missing', 'failed'), const='missing',
        help='take up a batch that was ended or killed: do what is missing or was changed since; '
        'failed: and once more what failed')
    where = parser.add_mutually_exclusive_group().add_argument
    where('--workers', type=int, metavar='N',
          help='so many recordings at once on this machine (default: one for each core)')
    where('--scheduler', metavar='ADDRESS',
          help='of a dask scheduler, as tcp://host:8786, whose workers see the same files')
    add('--retries', type=int, default=2, metavar='N',
        help='how often a recording is tried again whose process or worker was killed '
        '(default: %(default)s)')
    add('--seconds', type=int, default=600, metavar='S',
        help='of the processor that one recording may take, and ten times as long by the clock '
        '(default: %(default)s)')
    add('--memory', type=float, default=4.0, metavar='GB',
        help='that one recording may take, of address space (default: %(default)s)')


def add_merge(parser: argparse.ArgumentParser) -> None:
    """Add the options of `merge`, without those on how an input is read."""
    add = parser.add_argument
    add('input', type=Path, nargs='+', metavar='INPUT',
        help='two or more of what `solve` takes; an edge of a graph file may lead to a vertex of '
        'another one')
    add('--output', type=Path, required=True, metavar='OUT', help='.g2o, as `solve` writes it')
    add('--loops', type=Path, metavar='FILE',
        help='loops between inputs: edges as of g2o, their vertices written NUMBER:ID, the number '
        'of the input, from 1, and its vertex: `EDGE_SE2 1:17 2:305 dx dy dtheta ...`')
    add('--scans', nargs='?', const='/scan', metavar='TOPIC',
        help='all inputs are CARMEN logs, or bags with scans on this topic (%(const)s): find the '
        'loops between them by their scans, too')
    add('--norm', choices=names.NORMS, help='as of `solve`')
    add('--robust', action=argparse.BooleanOptionalAction, help='as of `solve`')
    add('--reference', metavar='TRUTH', help='as of `solve`, with the ids of the merged map')
    add('--force', action='store_true', help='replace OUT, though l1slam did not write it')
    add('--json', action='store_true', help='one object on standard output, as of `solve`')
    add('--quiet', action='store_true', help='no progress, no summary, no warning')
    # What else `solve` can be told.
    parser.set_defaults(start=names.STARTS[0], loop_norm=None, solver=names.SOLVERS[0],
                        outer=None, inner=None, plot=None, grid=None, report=None)
