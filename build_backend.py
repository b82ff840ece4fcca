# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How the compiled core is built, by pip (as a PEP 517 backend) and by colcon (through setup.py).

The compiler is $CXX or the machine's own. Where there is none, the one that PyPI ships (ziglang:
clang and libc++) is a requirement of the build, which pip fetches for it. $CPPFLAGS, $CXXFLAGS and
$LDFLAGS are appended.
"""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from glob import glob
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from setuptools import Extension, build_meta
from setuptools.build_meta import *  # noqa: F403
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError, PlatformError

HERE = Path(__file__).resolve().parent
_NATIVE = 'l1slam_ros/core/native'
# One extension for each level of processors; `native/__init__.py` takes the best that runs.
_LEVELS = {'portable': []}
if sysconfig.get_platform().endswith(('x86_64', 'amd64')):
    _LEVELS['avx2'] = ['-mavx2', '-mfma']
_FLAGS = [
    '-std=c++17', '-O3', '-g0', '-fPIC', '-fvisibility=hidden',
    # Sums may be reordered and products fused into them, which is what lets them be vectorised;
    # NaN and infinity keep their meaning.
    '-ffp-contract=fast', '-fno-math-errno', '-fno-trapping-math', '-fno-signed-zeros',
    '-fassociative-math',
    # One file serves every Python from 3.10 on.
    '-DPy_LIMITED_API=0x030A0000', '-DNDEBUG',
]
_CXX17 = 'template <auto N> int f() { if constexpr (N > 0) return N; return 0; }\n'


def extensions() -> list[Extension]:
    """Return the compiled core, for setup.py."""
    return [Extension(f'{_NATIVE.replace("/", ".")}._{level}', [f'{_NATIVE}/{level}.cpp'],
                      depends=sorted(glob(f'{_NATIVE}/*.hpp')), extra_compile_args=flags,
                      py_limited_api=True)
            for level, flags in _LEVELS.items()]


def _own_compiler() -> list[str]:
    """Return the command of the machine's own C++ compiler; empty: there is none."""
    found = filter(None, map(shutil.which, ('g++', 'clang++', 'c++')))
    return shlex.split(os.environ.get('CXX', '')) or [*found][:1]


class BuildCore(build_ext):
    """Compile each level by one command; what is missing is one sentence."""

    def run(self) -> None:
        """Check what is needed, and compile."""
        headers = Path(sysconfig.get_path('include'))
        if not (headers / 'Python.h').exists():
            raise PlatformError(f'{headers} has no Python.h; expected the headers of Python '
                                '(apt install python3-dev)')
        if not find_spec('numpy'):
            raise PlatformError('NumPy is not installed for this Python; expected it and its '
                                'headers (apt install python3-numpy)')
        from numpy import get_include

        self._headers = [f'-I{headers}', f'-I{get_include()}']
        self._command = _own_compiler()
        with TemporaryDirectory() as scratch:
            if not self._command and find_spec('ziglang'):
                # It keeps 85 MB there, compiled anew at the next build.
                os.environ['ZIG_GLOBAL_CACHE_DIR'] = scratch
                self._command = [sys.executable, '-m', 'ziglang', 'c++', '-s']
            if not self._command:
                raise PlatformError('there is no C++ compiler; expected g++ or clang++ with C++17 '
                                    "(apt install g++ python3-dev), or PyPI's ziglang")
            super().run()

    def build_extension(self, ext: Extension) -> None:
        """Compile one level, unless it is newer than its sources."""
        path = Path(self.get_ext_fullpath(ext.name))
        path.parent.mkdir(parents=True, exist_ok=True)
        newest = max(os.path.getmtime(source) for source in (*ext.sources, *ext.depends, __file__))
        if not self.force and path.exists() and path.stat().st_mtime > newest:
            return
        flags = {name: shlex.split(os.environ.get(name, ''))
                 for name in ('CPPFLAGS', 'CXXFLAGS', 'LDFLAGS')}
        done = subprocess.run(
            [*self._command, *_FLAGS, *ext.extra_compile_args, *self._headers, *flags['CPPFLAGS'],
             *flags['CXXFLAGS'], *ext.sources, '-shared', *flags['LDFLAGS'], '-o', str(path)],
            capture_output=True, text=True, check=False)
        if done.returncode and not self._knows_cxx17():
            raise CompileError(f'{" ".join(self._command)} does not compile C++17; expected g++ 7 '
                               'or clang 5, or newer (apt install g++ python3-dev)')
        sys.stderr.write(done.stderr)
        if done.returncode:
            raise CompileError(f'{self._command[0]} could not compile {ext.sources[0]}')

    def _knows_cxx17(self) -> bool:
        return not subprocess.run(
            [*self._command, '-std=c++17', '-fsyntax-only', '-x', 'c++', '-'], input=_CXX17,
            capture_output=True, text=True, check=False).returncode


def _with_compiler(hook):
    """Add the compiler of PyPI to the requirements of the build where the machine has none."""
    return lambda config_settings=None: (
        hook(config_settings) + ([] if _own_compiler() else ['ziglang']))


get_requires_for_build_wheel = _with_compiler(build_meta.get_requires_for_build_wheel)
get_requires_for_build_editable = _with_compiler(build_meta.get_requires_for_build_editable)
