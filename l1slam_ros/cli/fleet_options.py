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
        help='folder that is searched, with its subfolders, for recordings: files and rosbag2 '
        'directories that `solve` reads; hidden ones are left out')
    add('--output', type=Path, required=True, metavar='FOLDER',
        help='folder for the results, new or empty: maps/RECORDING.g2o, log.jsonl with a line '
        'for each recording, table.csv, and table.parquet if pyarrow is installed')
    add('--resume', nargs='?', choices=('missing', 'failed'), const='missing',
        help='go on with a batch that was ended or killed. missing: solve the recordings that '
        'have no result yet or were changed since; failed: also those that failed (default: '
        'missing)')
    where = parser.add_mutually_exclusive_group().add_argument
    where('--workers', type=int, metavar='N',
          help='number of recordings solved at once on this machine (default: one for each core)')
    where('--scheduler', metavar='ADDRESS',
          help='address of a dask scheduler, as tls://host:8786; its workers must see the same '
          'files under the same paths. Needs distributed; doc/fleet.md says how to start one so '
          'that nobody else can run code on it')
    add('--retries', type=int, default=2, metavar='N',
        help='how often a recording is tried again after its process or worker was killed or '
        'stalled (default: %(default)s)')
    add('--seconds', type=int, default=600, metavar='S',
        help='processor time that one recording may take; by the clock it may take ten times as '
        'long (default: %(default)s)')
    add('--memory', type=float, default=4.0, metavar='GB',
        help='address space that one recording may take (default: %(default)s)')


def add_merge(parser: argparse.ArgumentParser) -> None:
    """Add the options of `merge`, without those on how an input is read."""
    add = parser.add_argument
    add('input', type=Path, nargs='+', metavar='INPUT',
        help='two or more inputs, each of a kind that `solve` reads; an edge in one graph file '
        'may lead to a vertex of another; bags of one drive are read as one')
    add('--output', type=Path, required=True, metavar='OUT',
        help='write the map, as `solve` does: .g2o')
    add('--loops', type=Path, metavar='FILE',
        help='file of loops between the inputs: g2o edges whose vertices are NUMBER:ID, with the '
        'number of the input, from 1, and the vertex id in it, as in `EDGE_SE2 1:17 2:305 dx dy '
        'dtheta ...`')
    add('--scans', nargs='?', const='/scan', metavar='TOPIC',
        help='also find loops between the inputs by their laser scans; all inputs must be CARMEN '
        'logs, or bags with scans on this topic (default topic: %(const)s)')
    add('--norm', choices=names.NORMS, help='as in `solve`')
    add('--robust', action=argparse.BooleanOptionalAction, help='as in `solve`')
    add('--reference', metavar='TRUTH', help='as in `solve`, with the ids of the merged map')
    add('--force', action='store_true', help='replace OUT even if l1slam did not write it')
    add('--json', action='store_true',
        help='print one JSON object on standard output, as `solve` does')
    add('--quiet', action='store_true', help='print no progress, no summary and no warnings')
    # The other options of `solve`, at their defaults.
    parser.set_defaults(start=names.STARTS[0], loop_norm=None, solver=names.SOLVERS[0],
                        outer=None, inner=None, plot=None, grid=None, report=None)
