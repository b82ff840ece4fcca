# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Once the cache is full nothing is compiled any more: a robot would stand still meanwhile."""

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from work import WORK

from l1slam_ros.core import kernels
from l1slam_ros.core.kernels import growth
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io import compilation
from l1slam_ros.io.compilation import IN_SPACE, STEPS, fill_cache
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file

# Prints how many objects a collection of garbage looks at before and after loops are loaded.
LOAD = """
import gc
import numba
from l1slam_ros.io.compilation import load

print(len(gc.get_objects()))
load()
print(len(gc.get_objects()))
"""

# What somebody does with a file first; prints what it imports, and how many loops it reads.
LOOK = """
import sys
from pathlib import Path
import numpy as np
from l1slam_ros.io import formats
from l1slam_ros.core.robust import batch_map
from l1slam_ros.core.robust.inspection import noise_scales

record = formats.read_input(Path(sys.argv[1]))
if sys.argv[2] == 'info':
    noise_scales(record.graph, np.random.default_rng(0))
else:
    asked = batch_map.SolveOptions(robust=sys.argv[2] == 'robust')
    batch_map.solve(record.graph, record.poses, asked)
kernels = {kernel for name in list(sys.modules) if name.startswith('l1slam_ros.core.kernels.')
           for kernel in vars(sys.modules[name]).values() if hasattr(kernel, 'py_func')}
print(sum(len(kernel.linked) for kernel in kernels))
print(*sys.modules)
"""


def test_nothing_is_compiled_once_the_cache_is_full():
    done = subprocess.run([sys.executable, '-c', WORK], capture_output=True, text=True,
                          timeout=240, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ''


def test_loops_once_loaded_are_no_burden_on_collections_of_garbage():
    done = subprocess.run([sys.executable, '-c', LOAD], capture_output=True, text=True,
                          timeout=240)
    before, after = map(int, done.stdout.split())
    assert after < before / 10, done.stderr


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """A graph file; the cache is full."""
    fill_cache(lambda done, total: None, lambda: False)
    path = tmp_path_factory.mktemp('world') / 'world.g2o'
    made = simulate_world(150, 300, WorldOptions(), np.random.default_rng(0))
    write_graph_file(path, GraphRecord(made.graph, made.odometry, np.arange(150)))
    return path


def read_with(module):
    """Return what is imported with a module, and it."""
    done = subprocess.run([sys.executable, '-c', f'import {module}, sys; print(*sys.modules)'],
                          capture_output=True, text=True, timeout=120, check=True)
    return set(done.stdout.split())


@pytest.mark.parametrize('what, most_loops, missing', [
    ('info', 0, {'numba', 'llvmlite', 'scipy.special', 'scipy.sparse.csgraph._shortest_path'}),
    ('plain', 27, {'numba', 'l1slam_ros.core.kernels.prediction', 'scipy.sparse', 'scipy.special',
                   'l1slam_ros.core.kernels.halpern', 'scipy.linalg'}),
    ('robust', 33, {'numba', 'l1slam_ros.core.kernels.halpern', 'scipy.sparse', 'scipy.special',
                    'scipy.linalg'}),
])
def test_only_what_is_needed_is_read(world, what, most_loops, missing):
    done = subprocess.run([sys.executable, '-c', LOOK, str(world), what], capture_output=True,
                          text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    loops, modules = done.stdout.splitlines()
    assert int(loops) <= most_loops
    read = set(modules.split())
    if 'scipy.sparse' in read:  # before SciPy 1.16 that reads more by itself
        read -= read_with('scipy.sparse')
    assert not missing & read


def test_every_module_of_loops_is_a_step():
    """But for those that only large graphs need."""
    modules = {module.name for module in pkgutil.iter_modules(kernels.__path__)
               if not module.ispkg}
    modules |= {f'growth.{module.name}' for module in pkgutil.iter_modules(growth.__path__)}
    steps = {step.split(':')[0] for step in (*STEPS, *IN_SPACE.values())}
    assert steps == modules - {'compiled'}
    assert set(STEPS) == {*compilation.SPARSE, *compilation.JUDGEMENT, *compilation.DENSE,
                          *compilation.ONLINE}
    assert not {'se3', *IN_SPACE.values()} & set(STEPS)


def test_every_version_for_space_is_in_a_step_for_space():
    for name in STEPS:
        module = importlib.import_module(f'{kernels.__name__}.{name}')
        wider = [kernel for kernel in vars(module).values()
                 if getattr(kernel, 'takes_in_space', ())]
        assert bool(wider) == (f'{name}:space' in IN_SPACE.values())
