# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Work that calls nearly all compiled loops, as the code of a process."""

# Prints what a process compiles.
WORK = """
import importlib
import itertools
import pkgutil
import sys
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
from l1slam_ros.core.graph.parts import connected_parts
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.reweighting import weighted_least_squares
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.compilation import STEPS, fill_cache, with_space

MODULES = [importlib.import_module(f'{kernels.__name__}.{module.name}')
           for module in pkgutil.iter_modules(kernels.__path__)]


def compiled_here():
    return sorted((kernel.py_func.__module__, kernel.py_func.__name__, str(signature))
                  for module in MODULES for kernel in vars(module).values()
                  if hasattr(kernel, 'takes') and kernel.by_numba
                  for signature in kernel.dispatcher.stats.cache_misses)


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
        if getattr(kernel, 'linked', ())]
assert len(used) > 25, 'are the kernels not where this test looks for them?'
print(*{'numba'} & set(sys.modules))
"""
