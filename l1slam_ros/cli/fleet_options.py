# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The options of the commands that are about many recordings: batch."""

import argparse
from pathlib import Path


def add_batch(parser: argparse.ArgumentParser) -> None:
    """Add what `batch` takes, but for how a recording is read."""
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
