# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Python environments for tests that install things, as users do: made on first use, then kept.

They lie in `.venv/test-envs`, which `make clean` removes, named by what is in them; nothing is
installed into one afterwards. What a test itself installs goes into a new environment above one.
"""

import fcntl
import functools
import hashlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / '.venv' / 'test-envs'
DEADLINE = 300.0  # [s] longest installation, over a slow line
# What would lend the libraries of this process, those of its ROS above all, to another Python.
_LENT = ('PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH',
         'CMAKE_PREFIX_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'VIRTUAL_ENV')
# Wheels are not compiled when they are installed: most of their modules are never imported.
_INSTALL = ('install', '-qq', '--no-compile', '--disable-pip-version-check')


@dataclass(frozen=True)
class Environment:
    """A virtual environment."""

    prefix: Path

    @property
    def python(self) -> Path:
        return self.prefix / 'bin' / 'python'

    @property
    def site_packages(self) -> Path:
        (folder,) = (self.prefix / 'lib').glob('python3.*/site-packages')
        return folder

    def run(self, *command: object, cwd: Path, **variables: str) -> str:
        """Run one of its executables, which must succeed; return its standard output."""
        name, *arguments = map(str, command)
        return run(self.prefix / 'bin' / name, *arguments, cwd=cwd, env=own_variables(**variables))

    def install(self, *wanted: object) -> None:
        """Install by the pip of the running Python, so that the environment needs none."""
        run(sys.executable, '-m', 'pip', '--python', self.python, *_INSTALL, *wanted,
            cwd=self.prefix, env=own_variables())


def run(*command: object, cwd: Path, env: Mapping[str, str]) -> str:
    """Run a command, which must succeed; return its standard output."""
    ran = subprocess.run([str(part) for part in command], cwd=cwd, env=env, capture_output=True,
                         text=True, timeout=DEADLINE)
    assert ran.returncode == 0, (
        f'{" ".join(map(str, command))}: {ran.returncode}\n{ran.stdout}\n{ran.stderr}')
    return ran.stdout


@contextmanager
def running_backend(*command: object, cwd: Path, env: Mapping[str, str],
                    end: int = signal.SIGTERM) -> Iterator[None]:
    """Start a node that must become ready; end it by a signal, upon which it must exit with 0."""
    process = subprocess.Popen([*map(str, command)], cwd=cwd, env=env, stderr=subprocess.PIPE,
                               text=True, start_new_session=True)
    try:
        line = process.stderr.readline()
        assert 'ready' in line, line
        yield
        process.send_signal(end)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.communicate()


def own_variables(**more: str) -> dict[str, str]:
    """Return the variables of this process, without those that would lend its libraries."""
    return {name: value for name, value in os.environ.items() if name not in _LENT} | more


def lent_variables(**more: str) -> dict[str, str]:
    """
    Return the variables of this process and its libraries, for a Python of the same version.

    To that Python this one's ROS, NumPy and so on are what a sourced ROS is: packages from below.
    """
    packages = [path for path in sys.path if path.endswith(('site-packages', 'dist-packages'))]
    inherited = [path for path in [os.environ.get('PYTHONPATH')] if path]
    return dict(os.environ) | {'PYTHONPATH': os.pathsep.join(inherited + packages)} | more


def environment(*wanted: str, python: str = sys.executable) -> Environment:
    """
    Return an environment with the wheels `wanted` and what they need, and nothing else.

    Parameters
    ----------
    wanted : requirements and options of `pip install`
    python : of which interpreter

    """
    python = os.path.realpath(python)
    named = '\n'.join((str(FOLDER), python, *sorted(wanted)))
    prefix = FOLDER / hashlib.sha256(named.encode()).hexdigest()[:12]
    with _locked(prefix):
        complete = prefix / 'complete'
        if not complete.exists():
            require_registry()
            shutil.rmtree(prefix, ignore_errors=True)
            made = new_environment(prefix, python)
            if wanted:
                made.install('--only-binary=:all:', *wanted)
            complete.write_text(f'{named}\n')
    return Environment(prefix)


def new_environment(prefix: Path, python: str, below: Environment | None = None) -> Environment:
    """Make an environment, empty or above another one: it sees the packages of that one."""
    run(os.path.realpath(python), '-m', 'venv', '--without-pip', prefix, cwd=prefix.parent,
        env=own_variables())
    made = Environment(prefix)
    if below:
        (made.site_packages / 'below.pth').write_text(f'{below.site_packages}\n')
    return made


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep another run of the tests, in the same checkout, from making the same environment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix('.lock').open('w') as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def require_registry() -> None:
    """Skip the test where nothing can be installed; in CI go on, and fail."""
    complaint = _registry_complaint()
    if complaint and 'CI' not in os.environ:
        pytest.skip(f'nothing can be installed here: {complaint}')


@functools.cache
def _registry_complaint() -> str:
    if importlib.util.find_spec('pip') is None:
        return 'there is no pip'
    asked = subprocess.run(
        [sys.executable, '-m', 'pip', *_INSTALL, '--dry-run', '--ignore-installed', '--no-deps',
         '--retries=1', 'iniconfig'],
        env=own_variables(), capture_output=True, text=True, timeout=DEADLINE)
    said = asked.stderr.strip().split('\n')[-1]
    return f'no registry answers pip ({said})' if asked.returncode else ''


@functools.cache
def interpreter(version: str) -> str | None:
    """Return a Python of a version such as 3.12: the running one, on PATH, or of pyenv."""
    name = f'python{version}'
    pyenv = Path(os.environ.get('PYENV_ROOT', Path.home() / '.pyenv')) / 'versions'
    on_path = [Path(folder) / name for folder in os.environ.get('PATH', '').split(os.pathsep)]
    candidates = [Path(sys.executable), *on_path, *sorted(pyenv.glob(f'{version}.*/bin/{name}'))]
    return next((str(path) for path in candidates if _is_version(path, version)), None)


def _is_version(path: Path, version: str) -> bool:
    if not os.access(path, os.X_OK):
        return False
    # A shim of pyenv lies on PATH, but fails unless that version was chosen for this folder.
    code = 'import sys, venv; print("%d.%d" % sys.version_info[:2])'
    asked = subprocess.run([path, '-c', code], env=own_variables(), capture_output=True,
                           text=True, timeout=DEADLINE)
    return asked.stdout.strip() == version
