# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
A log of scans cut in the middle, and merged again, beside the whole.

    python benchmarks/fleet/halves.py LOG TRUTH [--without 0.05]

The second half lies rotated and moved elsewhere by its wheels, and lacks its begin, so much of the
log. Errors are those of `--reference`, of maps read from their files: truth is looked up at the
stamps of their keyframes. Of a log alone it may be looked up at other times, where it is sparse.
"""

import argparse
import bz2
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from l1slam_ros.core.geometry import se2

_COMMAND = 'import sys; from l1slam_ros.cli.main import main; sys.exit(main())'
_ELSEWHERE = np.array((30.0, -12.0, 2.0))


def lines_of(path: Path) -> list[bytes]:
    """Return the lines of a log that are scans."""
    pack = bz2.open if path.suffix == '.bz2' else open
    with pack(path, 'rb') as file:
        return [line for line in file if line.startswith(b'FLASER ')]


def moved(line: bytes) -> bytes:
    """Return a scan with the poses of laser and robot elsewhere."""
    words = line.split()
    first = 2 + int(words[1])
    poses = np.array(words[first:first + 6], float).reshape(2, 3)
    there = se2.compose(np.tile(_ELSEWHERE, (2, 1)), poses)
    words[first:first + 6] = [b'%.6f' % value for value in there.ravel()]
    return b' '.join(words) + b'\n'


def said(*words: object) -> dict[str, object]:
    """Return what a command says with --json."""
    ran = subprocess.run([sys.executable, '-c', _COMMAND, *map(str, words), '--json', '--quiet'],
                         stdout=subprocess.PIPE, text=True, check=False)
    return {'code': ran.returncode, **json.loads(ran.stdout)}


def main() -> None:
    """Cut, merge, compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('log', type=Path)
    parser.add_argument('truth', type=Path)
    parser.add_argument('--without', type=float, default=0.05, help='of all scans (%(default)s)')
    arguments = parser.parse_args()
    lines = lines_of(arguments.log)
    half = len(lines) // 2
    begin = half + int(arguments.without * len(lines))
    with tempfile.TemporaryDirectory() as folder:
        first, second = Path(folder, 'first.clf'), Path(folder, 'second.clf')
        first.write_bytes(b''.join(lines[:half]))
        second.write_bytes(b''.join(map(moved, lines[begin:])))
        whole = Path(folder, 'whole.g2o')
        said('solve', arguments.log, '--output', whole)
        runs = {'whole': said('solve', whole, '--reference', arguments.truth),
                'halves': said('merge', first, second, '--scans', '--output',
                               Path(folder, 'out.g2o'), '--reference', arguments.truth)}
    for name, found in runs.items():
        print(f'{name}: {found["ate"]:.4f} m over {found["ate_poses"]} poses, '
              f'{found["loops"]} loops, {found["parts"]} part(s), code {found["code"]}')
    print(f'error of the halves over that of the whole: '
          f'{runs["halves"]["ate"] / runs["whole"]["ate"]:.2f}')


if __name__ == '__main__':
    main()
