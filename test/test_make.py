# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `make` installs, when, and what it says where it cannot; Python and pip only note it."""

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# In the place of Python: notes what it is asked for, and fails, or is killed, where told to.
PYTHON = """#!/bin/sh
echo "$*" >> "{folder}/asked"
test -e "{folder}/$2-$3-killed" && kill -KILL $$
test -e "{folder}/$2-$3-fails" && exit 1
case "$*" in
    *version_info*) test ! -e "{folder}/old" ;;
    *ensurepip*) test ! -e "{folder}/without-venv" ;;
    *Python.h*) test ! -e "{folder}/without-headers" ;;
    '-m venv '*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
esac
"""
VENV = '-m venv .venv'
CORE = '-m pip install --quiet --no-deps --editable .'
DEMO = ['-m pip install --quiet l1slam_ros[ros]', '-m l1slam_ros.ros.executables']
TEST = ['-m pip install --quiet l1slam_ros[test]', 'setup.py --quiet install_data',
        '-m pytest -n 3 --dist worksteal']


@pytest.fixture
def checkout(tmp_path):
    """Return a checkout whose Python is the one above."""
    folder = tmp_path / 'checkout'
    folder.mkdir()
    native = folder / 'l1slam_ros' / 'core' / 'native'
    native.mkdir(parents=True)
    (native / 'se2.hpp').touch()
    for name in ('Makefile', 'setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml',
                 'build_backend.py'):
        shutil.copy(ROOT / name, folder)
    python = tmp_path / 'python'
    python.write_text(PYTHON.format(folder=tmp_path))
    python.chmod(0o755)
    return folder


def make(checkout, target, python='../python'):
    """Run make; return the exit code, what was asked of Python to do, and what make said."""
    asked = checkout.parent / 'asked'
    asked.write_text('')
    # These tests, too, may be run by a make, whose flags are none of this one's.
    own = {name: value for name, value in os.environ.items() if not name.startswith('MAKE')}
    made = subprocess.run(['make', '-C', checkout, target, f'PYTHON={python}'], timeout=60,
                          env=own, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    questions = ('-c', '-m pip --version')
    return made.returncode, [line for line in asked.read_text().splitlines()
                             if not line.startswith(questions)], made.stderr


def test_the_demo_installs_what_it_needs_once_and_the_tests_only_add_to_it(checkout):
    assert make(checkout, 'demo')[:2] == (0, [VENV, CORE, *DEMO])
    assert make(checkout, 'demo')[:2] == (0, DEMO[1:])
    assert make(checkout, 'test')[:2] == (0, TEST)
    assert make(checkout, 'test')[:2] == (0, TEST[2:])
    assert make(checkout, 'demo')[:2] == (0, DEMO[1:])


def test_what_is_compiled_is_compiled_anew_once_its_source_has_changed(checkout):
    make(checkout, 'test')
    later = time.time() + 1
    os.utime(checkout / 'l1slam_ros' / 'core' / 'native' / 'se2.hpp', (later, later))
    assert make(checkout, 'test')[:2] == (0, [CORE, TEST[-1]])


@pytest.mark.parametrize(('target', 'what'), [
    ('demo', 'pip-install'), ('test', 'pip-install'), ('demo', 'venv-.venv')])
def test_what_was_left_half_done_is_made_anew(checkout, target, what):
    if target == 'test':
        make(checkout, 'demo')
    killed = checkout.parent / f'{what}-killed'
    killed.touch()
    assert make(checkout, target)[0]
    killed.unlink()
    assert make(checkout, 'demo')[:2] == (0, [VENV, CORE, *DEMO])


def test_where_pip_itself_fails_the_environment_stays(checkout):
    fails = checkout.parent / 'pip-install-fails'
    fails.touch()
    assert make(checkout, 'demo')[0]
    fails.unlink()
    assert make(checkout, 'demo')[:2] == (0, [CORE, *DEMO])


@pytest.mark.parametrize(('trouble', 'python', 'said'), [
    ('old', '../python', 'is no Python 3.10 or newer; expected one: make PYTHON=python3.12'),
    ('none', 'no-such-python', 'is no Python 3.10 or newer; expected one: make PYTHON=python3.12'),
    ('without-venv', '../python', 'makes no environments; expected its venv: apt install python3'),
    ('without-headers', '../python', 'has no headers; expected its Python.h: apt install python3'),
])
def test_a_python_that_will_not_do_is_one_line(checkout, trouble, python, said):
    (checkout.parent / trouble).touch()
    code, asked, stderr = make(checkout, 'demo', python)
    assert code and not asked
    (line, own) = stderr.splitlines()
    assert said in line and own.startswith('make')
