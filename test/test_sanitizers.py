# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The tests of the compiled core, with it built so that a wrong access ends the process."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from environments import DEADLINE, own_variables, run

ROOT = Path(__file__).parents[1]
SANITIZED = '-fsanitize=address,undefined -fno-sanitize-recover=all'
# Names that a test of the core uses.
OF_THE_CORE = re.compile(r'\bnative\b')


@pytest.fixture(scope='module')
def libraries(tmp_path_factory):
    """Return what has to be loaded before Python, which is built without sanitizers."""
    folder, compiler = tmp_path_factory.mktemp('probe'), shutil.which('g++')
    if not compiler:
        pytest.skip('no g++, whose sanitizers are used')
    (folder / 'probe.cpp').write_text('int main() {}\n')
    probed = subprocess.run([compiler, *SANITIZED.split(), 'probe.cpp', '-o', 'probe'], cwd=folder,
                            capture_output=True, text=True, check=False)
    if probed.returncode:
        pytest.skip(f'{compiler} has no sanitizers: {probed.stderr.splitlines()[-1]}')
    # The other: where exceptions come from, which the first one follows.
    return [run(compiler, f'-print-file-name={name}', cwd=folder, env=os.environ).strip()
            for name in ('libasan.so', 'libstdc++.so')]


@pytest.fixture(scope='module')
def sanitized(libraries, tmp_path_factory):
    """Return a folder with the package, its core built with the sanitizers."""
    folder = tmp_path_factory.mktemp('sanitized')
    shutil.copytree(ROOT / 'l1slam_ros', folder / 'l1slam_ros',
                    ignore=shutil.ignore_patterns('*.so', '__pycache__'))
    for name in ('setup.py', 'build_backend.py', 'package.xml', 'README.md'):
        shutil.copy(ROOT / name, folder)
    run(sys.executable, 'setup.py', '--quiet', 'build_ext', '--inplace', cwd=folder,
        env=own_variables(CXX='g++', CXXFLAGS=f'-O1 -g1 -fno-omit-frame-pointer {SANITIZED}'))
    return folder


def sanitizing(libraries, **more):
    return {**os.environ, 'LD_PRELOAD': ' '.join(libraries),
            # Each object is an allocation of its own, and Python frees little at its end.
            'PYTHONMALLOC': 'malloc', 'ASAN_OPTIONS': 'detect_leaks=0', **more}


# Reads behind the end of an array, or adds up more than there is; each must be noticed.
BROKEN = {'address': 'int main(int n, char**) { int* a = new int[n]; return a[n]; }',
          'undefined': 'int main(int n, char**) { int most = 2147483647; return most + n > 0; }'}


@pytest.mark.parametrize('kind', BROKEN)
def test_what_is_wrong_is_noticed(libraries, kind, tmp_path):
    (tmp_path / 'broken.cpp').write_text(BROKEN[kind])
    run('g++', *SANITIZED.split(), 'broken.cpp', '-o', 'broken', cwd=tmp_path, env=os.environ)
    done = subprocess.run([tmp_path / 'broken'], capture_output=True, text=True, check=False)
    assert done.returncode and 'overflow' in done.stderr


def test_the_tests_of_the_core_touch_nothing_else(sanitized, libraries):
    """The tests of each kernel go through both levels; all else runs on the best one."""
    math = ROOT / 'test' / 'math'
    tests = [path for path in sorted(math.glob('test_*.py'))
             if OF_THE_CORE.search(path.read_text())]
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-x', '-p', 'no:cacheprovider', '-p', 'no:xdist',
         *map(str, tests)], cwd=sanitized, capture_output=True, text=True, timeout=3 * DEADLINE,
        env=sanitizing(libraries, PYTHONPATH=str(sanitized)), check=False)
    assert done.returncode == 0, done.stdout + done.stderr
