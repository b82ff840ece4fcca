# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Compiled loops: kept between processes, also where the package's folder cannot be written."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from l1slam_ros.io import compilation

ROOT = Path(__file__).parents[3]
# Calls one loop; prints how often it was found in the cache, and how often it had to be compiled.
CALL = """
import numpy as np
from l1slam_ros.core.kernels import compiled, symbolic
assert compiled.__file__.startswith({folder!r}), compiled.__file__
parent, below = np.array([1, 2, 3], np.int32), np.array([1, 1, 0], np.int32)
assert symbolic.supernodes(parent, below).tolist() == [0, 1, 3]
stats = symbolic.supernodes.dispatcher.stats
print(sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""


@pytest.fixture
def installed(tmp_path):
    """A folder with a copy of the package."""
    shutil.copytree(ROOT / 'l1slam_ros', tmp_path / 'place' / 'l1slam_ros',
                    ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path / 'place'


def write_protect(installed):
    """Make it impossible, for root too, to create files in the kernels' cache folder."""
    (installed / 'l1slam_ros' / 'core' / 'kernels' / '__pycache__').write_text('')


def run(installed, home, code):
    """Return what one process says that runs some code with the package there."""
    environment = {**os.environ, 'HOME': str(home), 'XDG_CACHE_HOME': str(home / '.cache'),
                   'PYTHONPATH': str(installed)}
    environment.pop('NUMBA_CACHE_DIR', None)
    done = subprocess.run([sys.executable, '-c', code], env=environment, capture_output=True,
                          text=True, timeout=240, cwd=installed)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize('place', ['package', 'home', 'nowhere'])
def test_a_loop_is_compiled_once_where_it_can_be_kept(installed, tmp_path, place):
    """Beside the package, or where that is read-only in the user's cache; without, it runs."""
    home = tmp_path / 'home'
    if place != 'package':
        write_protect(installed)
    if place == 'nowhere':
        home.write_text('')
    said = [run(installed, home, CALL.format(folder=str(installed))) for _ in range(2)]
    assert said == ['0 1', '0 1' if place == 'nowhere' else '1 0']
    kept = [folder for folder in (installed / 'l1slam_ros/core/kernels/__pycache__', home)
            if list(folder.rglob('symbolic.supernodes*.nbc'))]
    assert kept == {'package': [installed / 'l1slam_ros/core/kernels/__pycache__'],
                    'home': [home], 'nowhere': []}[place]


# Filling the cache ahead


# Two steps that are quick to compile; prints the answer, what was reported, and if numba came.
FILL = """
import sys
from l1slam_ros.io import compilation
assert compilation.__file__.startswith({folder!r}), compilation.__file__
{before}
reports = []
answer = compilation.fill_cache(lambda *done: reports.append(done), lambda: False,
                                ('interior_point', 'se2'))
print(answer, reports, 'numba' in sys.modules)
"""
# Nobody can start a process with this.
NO_PROCESS = "sys.executable = '/nowhere/python'"
DONE, NOTHING_TO_DO = 'True [(0, 2), (1, 2), (2, 2)] False', 'True [] False'


def fill(installed, home, before=''):
    """Return what one process says that fills the cache."""
    return run(installed, home, FILL.format(folder=str(installed), before=before))


@pytest.mark.parametrize('protect', [False, True])
def test_a_full_cache_is_known_without_a_process(installed, tmp_path, protect):
    if protect:
        write_protect(installed)
    assert fill(installed, tmp_path / 'home') == DONE
    assert fill(installed, tmp_path / 'home', NO_PROCESS) == NOTHING_TO_DO


def test_a_cache_that_is_no_more_what_it_was_is_filled_again(installed, tmp_path):
    kernels = installed / 'l1slam_ros' / 'core' / 'kernels'
    assert fill(installed, tmp_path / 'home') == DONE
    with (kernels / 'se2.py').open('a') as file:
        file.write('# A change.\n')
    assert fill(installed, tmp_path / 'home') == DONE
    for index in (kernels / '__pycache__').glob('se2.residual-*.nbi'):
        index.unlink()
    assert fill(installed, tmp_path / 'home') == 'True [(0, 1), (1, 1)] False'
    assert fill(installed, tmp_path / 'home', NO_PROCESS) == NOTHING_TO_DO


def test_where_nothing_can_be_kept_no_process_is_started(installed, tmp_path):
    write_protect(installed)
    nobody = tmp_path / 'no_home'
    nobody.write_text('')
    assert fill(installed, nobody, NO_PROCESS) == 'False [] False'


def test_a_process_that_breaks_does_not_hold_up_the_others(installed, tmp_path):
    (installed / 'l1slam_ros' / 'core' / 'kernels' / 'se2.py').write_text('raise SystemExit\n')
    assert fill(installed, tmp_path / 'home') == 'False [(0, 2), (1, 2)] False'


def test_it_ends_its_processes_when_it_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    started, start = [], compilation._start

    def noted(steps):
        started.append(start(steps))
        return started[-1]

    monkeypatch.setattr(compilation, '_start', noted)
    assert not compilation.fill_cache(lambda done, total: None, lambda: bool(started))
    assert started and all(process.returncode is not None for process in started)


@pytest.mark.skipif(not Path('/proc/self/task').exists(), reason='asks Linux who is whose child')
def test_its_processes_end_with_it(tmp_path):
    code = ('from l1slam_ros.io.compilation import fill_cache\n'
            'fill_cache(lambda done, total: None, lambda: False)')
    parent = subprocess.Popen([sys.executable, '-c', code],
                              env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)})
    children = Path(f'/proc/{parent.pid}/task/{parent.pid}/children')
    wait_until(lambda: children.read_text().split())
    pids = children.read_text().split()
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until(lambda: not any(is_running(pid) for pid in pids))


def wait_until(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, 'it did not come true in time'


def is_running(pid):
    """Tell whether a process is there, and not only its entry in the table."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] != 'Z'
    except FileNotFoundError:
        return False
