# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Worlds that the tests of the command share, each made once."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from worlds import made


@pytest.fixture(scope='session')
def clean(tmp_path_factory):
    """Return a world of 150 poses and 101 loops; not to be written to."""
    return made(tmp_path_factory.mktemp('clean') / 'world.g2o', 150, 250, '--seed', 7)


@pytest.fixture
def world(clean, tmp_path):
    """Return a copy of it."""
    shutil.copytree(clean.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / clean.name


def renumbered(path):
    """Return the lines of a graph with the ids 10, 13, 16, ..."""
    lines = [line.split() for line in path.read_text().splitlines()[:-1]]
    for fields in lines:
        for k in (1,) if fields[0] == 'VERTEX_SE2' else (1, 2):
            fields[k] = str(10 + 3 * int(fields[k]))
    return [' '.join(fields) for fields in lines]


@pytest.fixture
def odd(world, tmp_path):
    """Return the world with stamps and with ids 10, 13, 16, ..."""
    path = tmp_path / 'odd.g2o'
    path.write_text('\n'.join(renumbered(world)) + '\n')
    Path(f'{path}.stamps.txt').write_text(
        ''.join(f'{10 + 3 * k} {5 + k}.25\n' for k in range(150)))
    return path


@pytest.fixture(scope='session')
def spoiled(tmp_path_factory):
    """Return, by its kind, a world with 100 false loops, in no order; not to be written to."""
    folder, worlds = tmp_path_factory.mktemp('spoiled'), {}
    for kind in ('random', 'identity', 'grouped'):
        path = made(folder / f'{kind}.g2o', 300, 600, '--seed', 4, '--false-loops', 100,
                    '--kind', kind)
        lines = renumbered(path)
        np.random.default_rng(0).shuffle(lines)
        path.write_text('\n'.join(lines) + '\n')
        false = Path(f'{path}.false.txt')
        pairs = 10 + 3 * np.loadtxt(false, dtype=int)
        false.write_text('\n'.join(f'{i} {j}' for i, j in pairs))
        worlds[kind] = path
    return worlds


@pytest.fixture(params=['random', 'identity', 'grouped'])
def lies(spoiled, tmp_path, request):
    """Return a copy of one of them; its ids are 10, 13, 16, ..."""
    made, path = spoiled[request.param], tmp_path / 'lies.g2o'
    for beside in ('', '.truth.txt', '.false.txt'):
        shutil.copy(f'{made}{beside}', f'{path}{beside}')
    return path


@pytest.fixture
def soon(monkeypatch):
    """Let all be done soon: on a machine that is busy a log would have lines on what is not."""
    clock = time.monotonic
    monkeypatch.setattr(time, 'monotonic', lambda: clock() / 100)


@pytest.fixture
def machine(monkeypatch):
    """Return what sets the files, path -> text, that say which memory is free."""
    read_text = Path.read_text

    def tell(files):
        def told(path, *more, **options):
            if not str(path).startswith(('/proc/', '/sys/fs/cgroup/')):
                return read_text(path, *more, **options)
            if str(path) not in files:
                raise FileNotFoundError
            return files[str(path)]

        monkeypatch.setattr(Path, 'read_text', told)
    return tell
