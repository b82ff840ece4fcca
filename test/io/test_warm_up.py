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

from l1slam_ros.core import kernels
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io import compilation
from l1slam_ros.io.compilation import IN_SPACE, STEPS, fill_cache
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file

# Prints what a process compiles.
WORK = """
import importlib
import itertools
import pkgutil
from dataclasses import replace

import numpy as np
from lies import careful_world, drive_roundabout, roundabout, seen, slipped, spoilt
from problems import EVERY, add_absolute, play

from l1slam_ros.core import kernels
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.graph.linear_system import linearise
from l1slam_ros.core.names import NORMS
from l1slam_ros.core.running.backend import Backend, RobustOptions
from l1slam_ros.core.robust import batch_map
from l1slam_ros.core.robust.inspection import connected_parts
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.reweighting import weighted_least_squares
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.compilation import STEPS, fill_cache, with_space

MODULES = [importlib.import_module(module.name)
           for module in pkgutil.walk_packages(kernels.__path__, f'{kernels.__name__}.')]


def compiled_here():
    return sorted((kernel.py_func.__module__, kernel.py_func.__name__, str(signature))
                  for module in MODULES for kernel in vars(module).values()
                  if hasattr(kernel, 'signatures') for signature in kernel.stats.cache_misses)


def solved(graph, poses=None, **asked):
    batch_map.solve(graph, poses, batch_map.SolveOptions(**asked))


assert fill_cache(lambda done, total: None, lambda: False)
assert not compiled_here()
world = spoilt(careful_world(150, 300), 'grouped', 60)
graph, odometry = world.graph, world.odometry
for enabled in (True, False):
    options = replace(EVERY, robust=RobustOptions(enabled))
    backend, after = Backend(options), Backend(options)
    for k in range(0, 150, 15):
        play(backend, world, k, k + 15)
        backend.update(0.001 if k % 2 else 60.0)
    backend.loop_states()
    backend.settle()
    after.restore(backend.saved())
    after.update(60.0)
backend, truth = Backend(EVERY), roundabout(220)
drive_roundabout(backend, truth)
for i, j in ((3, 203), (30, 140)):
    backend.add_loop(seen(truth, i, j))
    backend.update(60.0)
solved(slipped(graph, 80, (5.0, 0.0, 0.0)), robust=True)
starts = ('seed', None), ('file', np.asfortranarray(odometry)), ('odometry', odometry)
for (start, poses), norm, robust in itertools.product(starts, NORMS, (False, True)):
    solved(graph, poses, start=start, norm=norm, robust=robust)
for solver in ('primal-dual', 'interior-point'):
    solved(graph, odometry, solver=solver)
cholesky, system = cholesky_of(graph), linearise(graph, odometry)
weighted_least_squares(system, cholesky, np.ones_like(system.b), 0.1)
scattered = 20 * np.random.default_rng(0).standard_normal((150, 3))
minimise_l2(graph, scattered, LeastSquaresOptions(), cholesky)
connected_parts(graph)
add_absolute(graph, np.array([7]), world.truth[7:8], np.eye(3)[None])
for norm in NORMS:
    solved(graph, odometry, norm=norm)
assert fill_cache(lambda done, total: None, lambda: False, with_space(STEPS, se3))
building = simulate_world(120, 300, WorldOptions(), np.random.default_rng(0), 'building')
for norm in NORMS:
    solved(building.graph, building.odometry, norm=norm)
solved(building.graph, building.odometry, solver='primal-dual', robust=False)
for missing in compiled_here():
    print(*missing)
used = [kernel for module in MODULES for kernel in vars(module).values()
        if hasattr(kernel, 'takes') and kernel.stats.cache_hits]
assert len(used) > 25, 'are the kernels not where this test looks for them?'
"""

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
kernels = [kernel for name in list(sys.modules) if name.startswith('l1slam_ros.core.kernels.')
           for kernel in vars(sys.modules[name]).values() if hasattr(kernel, 'takes')]
print(sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels))
print(*sys.modules)
"""


def test_nothing_is_compiled_once_the_cache_is_full():
    done = subprocess.run([sys.executable, '-c', WORK], capture_output=True, text=True,
                          timeout=240, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    assert done.stdout == ''


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


@pytest.mark.parametrize('what, most_loops, missing', [
    ('info', 0, {'numba', 'llvmlite', 'scipy.special', 'scipy.sparse.csgraph._shortest_path'}),
    ('plain', 20, {'l1slam_ros.core.kernels.prediction', 'l1slam_ros.core.kernels.halpern',
                   'scipy.sparse', 'scipy.special', 'scipy.linalg'}),
    ('robust', 27, {'l1slam_ros.core.kernels.halpern', 'scipy.sparse', 'scipy.special',
                    'scipy.linalg'}),
])
def test_only_what_is_needed_is_read(world, what, most_loops, missing):
    done = subprocess.run([sys.executable, '-c', LOOK, str(world), what], capture_output=True,
                          text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    loops, modules = done.stdout.splitlines()
    assert int(loops) <= most_loops
    assert not missing & set(modules.split())


def test_every_module_of_loops_is_a_step():
    """But for those in a folder of their own, which only large graphs need."""
    modules = {module.name for module in pkgutil.iter_modules(kernels.__path__)
               if not module.ispkg}
    assert {step.split(':')[0] for step in (*STEPS, *IN_SPACE.values())} == modules - {'compiled'}
    assert set(STEPS) == {*compilation.SPARSE, *compilation.JUDGEMENT, *compilation.DENSE,
                          *compilation.ONLINE}
    assert not {'se3', *IN_SPACE.values()} & set(STEPS)


def test_every_version_for_space_is_in_a_step_for_space():
    for name in STEPS:
        module = importlib.import_module(f'{kernels.__name__}.{name}')
        wider = [kernel for kernel in vars(module).values()
                 if getattr(kernel, 'takes_in_space', ())]
        assert bool(wider) == (f'{name}:space' in IN_SPACE.values())
