# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Where the measurements run: an environment with the peers, one core, one thread.

The environment is made on first use and then kept, in `.venv/benchmark-envs`, which `make clean`
removes; it is named by what is in it. It has this checkout as an editable install, so every run
measures the code as it is.
"""

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PEERS = Path(__file__).resolve().with_name('peers.txt')
FOLDER = ROOT / '.venv' / 'benchmark-envs'
_MARK = 'L1SLAM_BENCHMARK_ENVIRONMENT'
# What would lend the libraries of this process, those of a ROS above all, to another Python.
_LENT = ('PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH',
         'CMAKE_PREFIX_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'VIRTUAL_ENV')
ONE_THREAD = {f'{library}_NUM_THREADS': '1' for library in
               ('OMP', 'OPENBLAS', 'MKL', 'NUMBA')}


def enter(one_core: bool = True) -> None:
    """Go on in the environment, on the first core this process may use; return once there."""
    if os.environ.get(_MARK) == '1':
        return
    python = _environment()
    if one_core and hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    variables = {name: value for name, value in os.environ.items() if name not in _LENT}
    sys.stdout.flush()
    os.execve(python, [str(python), *sys.argv], variables | ONE_THREAD | {_MARK: '1'})


def requirements() -> list[str]:
    """Return the lines of `peers.txt` that name a package."""
    lines = [line.split('#')[0].strip() for line in PEERS.read_text(encoding='utf-8').splitlines()]
    return [line for line in lines if line]


def _environment() -> Path:
    """Return the Python of the environment, which is made if there is none yet."""
    base = os.path.realpath(sys.executable)
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    named = '\n'.join((str(ROOT), base, *requirements(), setup))
    prefix = FOLDER / hashlib.sha256(named.encode()).hexdigest()[:12]
    with _locked(prefix):
        complete = prefix / 'complete'
        if not complete.exists():
            shutil.rmtree(prefix, ignore_errors=True)
            _make(base, prefix)
            complete.touch()
    return prefix / 'bin' / 'python'


def _make(base: str, prefix: Path) -> None:
    print(f'making {prefix.relative_to(ROOT)} with the peers (once)', file=sys.stderr)
    variables = {name: value for name, value in os.environ.items() if name not in _LENT}
    pip = [prefix / 'bin' / 'python', '-m', 'pip', 'install', '--quiet',
           '--disable-pip-version-check', '--requirement', PEERS, '--editable', ROOT]
    for command in ([base, '-m', 'venv', prefix], pip):
        subprocess.run([str(part) for part in command], check=True, env=variables)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep another run from making the same environment at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix('.lock').open('w') as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
