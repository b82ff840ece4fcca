# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What the build of the compiled core says where something is missing, and what it asks for."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from environments import own_variables

ROOT = Path(__file__).parents[1]
BUILD = ['setup.py', '--quiet', 'build_ext', '--inplace']
# Runs setup.py where something is not there.
WITHOUT = """
import importlib.util, runpy, sys, sysconfig
{}
sys.argv = {!r}
runpy.run_path('setup.py', run_name='__main__')
"""
NO_HEADERS = 'sysconfig.get_path = lambda *_, **__: "/nowhere"'
ABSENT = ('find_spec = importlib.util.find_spec; importlib.util.find_spec = '
          'lambda name, *rest: None if name == {!r} else find_spec(name, *rest)')


@pytest.fixture
def checkout(tmp_path):
    """Return what the build reads, with a core of one line."""
    folder = tmp_path / 'checkout'
    shutil.copytree(ROOT / 'l1slam_ros' / 'core' / 'native', folder / 'l1slam_ros/core/native',
                    ignore=shutil.ignore_patterns('*.so', '__pycache__', '*.?pp'))
    for level in ('portable', 'avx2'):
        (folder / 'l1slam_ros' / 'core' / 'native' / f'{level}.cpp').write_text(
            '#include "one.hpp"\nextern "C" int one() { return ONE; }\n')
    (folder / 'l1slam_ros' / 'core' / 'native' / 'one.hpp').write_text('#define ONE 1\n')
    for name in ('setup.py', 'build_backend.py', 'package.xml', 'README.md'):
        shutil.copy(ROOT / name, folder)
    return folder


def built(checkout, *command, **variables):
    """Run Python in the checkout; return its exit code and standard error."""
    ran = subprocess.run([sys.executable, *command], cwd=checkout, capture_output=True, text=True,
                         env=own_variables(**variables), timeout=120)
    return ran.returncode, ran.stderr


@pytest.mark.parametrize(('missing', 'variables', 'said'), [
    (NO_HEADERS, {}, '/nowhere has no Python.h; expected the headers of Python (apt install '
                     'python3-dev)'),
    (ABSENT.format('numpy'), {}, 'NumPy is not installed for this Python; expected it and its '
                                 'headers (apt install python3-numpy)'),
    (ABSENT.format('ziglang'), {'PATH': '/nowhere', 'CXX': ''},
     'there is no C++ compiler; expected g++ or clang++ with C++17 (apt install g++ '
     "python3-dev), or PyPI's ziglang"),
    ('', {'CXX': 'false'}, 'false does not compile C++17; expected g++ 7 or clang 5, or newer '
                           '(apt install g++ python3-dev)')],
    ids=['headers', 'numpy', 'compiler', 'old compiler'])
def test_what_is_missing_is_one_sentence(checkout, missing, variables, said):
    assert built(checkout, '-c', WITHOUT.format(missing, BUILD), **variables) == (
        1, f'error: {said}\n')


def test_what_does_not_compile_is_shown(checkout):
    (checkout / 'l1slam_ros' / 'core' / 'native' / 'one.hpp').write_text('#define ONE "one"\n')
    code, said = built(checkout, *BUILD)
    assert code == 1 and 'invalid conversion' in said
    assert said.endswith('could not compile l1slam_ros/core/native/portable.cpp\n')


def test_what_is_built_is_built_anew_once_a_header_has_changed(checkout):
    level = checkout / 'l1slam_ros' / 'core' / 'native' / '_portable.abi3.so'

    def made():
        assert built(checkout, *BUILD) == (0, '')
        return level.stat().st_mtime_ns

    first = made()
    assert made() == first
    os.utime(checkout / 'l1slam_ros' / 'core' / 'native' / 'one.hpp')
    assert made() > first


@pytest.mark.parametrize('hook', ['wheel', 'editable'])
def test_a_compiler_is_asked_for_where_there_is_none(checkout, hook):
    code = ('import build_backend, os, sys; '
            f'sys.exit(repr("ziglang" in build_backend.get_requires_for_build_{hook}()))')
    asked = [built(checkout, '-c', code, **variables)[1].splitlines()[-1] for variables in (
        {'PATH': '/nowhere', 'CXX': ''}, {'PATH': '/nowhere', 'CXX': 'clang++-18'})]
    assert asked == ['True', 'False']
