# SPDX-License-Identifier: Apache-2.0
"""Compiled loops: kept between processes, also where the package's folder cannot be written."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Calls one loop; prints how often it was found in the cache, and how often it had to be compiled.
CALL = """
import numpy as np
from l1slam_ros.core.kernels import compiled, symbolic
assert compiled.__file__.startswith({folder!r}), compiled.__file__
parent, below = np.array([1, 2, 3], np.int32), np.array([1, 1, 0], np.int32)
assert symbolic.supernodes(parent, below).tolist() == [0, 3]
stats = getattr(symbolic.supernodes, 'stats', None)
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


def call(installed, home):
    """Return cache hits and misses of one process."""
    environment = {**os.environ, 'HOME': str(home), 'XDG_CACHE_HOME': str(home / '.cache'),
                   'PYTHONPATH': str(installed)}
    environment.pop('NUMBA_CACHE_DIR', None)
    done = subprocess.run([sys.executable, '-c', CALL.format(folder=str(installed))],
                          env=environment, capture_output=True, text=True, timeout=120,
                          cwd=installed)
    assert done.returncode == 0, done.stderr
    return [int(count) for count in done.stdout.split()]


def test_a_loop_is_compiled_once_and_kept_beside_the_package(installed, tmp_path):
    assert call(installed, tmp_path / 'home') == [0, 1]
    assert call(installed, tmp_path / 'home') == [1, 0]
    assert list((installed / 'l1slam_ros/core/kernels/__pycache__').glob('symbolic.supernodes*'))


def test_where_the_package_is_read_only_the_users_cache_keeps_it(installed, tmp_path):
    write_protect(installed)
    assert call(installed, tmp_path / 'home') == [0, 1]
    assert call(installed, tmp_path / 'home') == [1, 0]
    assert list((tmp_path / 'home').rglob('symbolic.supernodes*.nbc'))


def test_where_nothing_can_be_written_it_still_runs(installed, tmp_path):
    write_protect(installed)
    nobody = tmp_path / 'no_home'
    nobody.write_text('')
    call(installed, nobody)
    assert not list(tmp_path.rglob('symbolic.supernodes*.nbc'))
