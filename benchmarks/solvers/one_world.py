# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One world in a process of its own, so that its memory is its own.

    python one_world.py POSES EDGES

Prints one JSON object: seconds of seed and solve, the L1 costs of the solution and of the true
poses, the part of the cost that the dual leaves open, the steps, the seconds and memory [MiB] that
were predicted, and the peak memory of the process before and after [MiB].
"""

import json
import resource
import sys

import numpy as np
from measuring import clock
from solvers.cases import WORLD_SEED

from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.simulate import World, WorldOptions, simulate_world


def solve(world: World) -> dict[str, float]:
    """Return the seconds of each phase and the costs; the ordering counts with the seed."""
    graph = world.graph
    began = clock()
    method = choose(AUTO, graph)
    seed = seed_poses(graph, method.cholesky)
    seeded = clock()
    solution, _ = minimise_by(method, graph, seed, OptimiserOptions())
    solved = clock()
    needs = method.needs
    return {'seed': seeded - began, 'solve': solved - seeded, 'cost': solution.cost,
            'gap': solution.gap / solution.cost, 'steps': float(solution.outer_iterations),
            'predicted_seconds': needs.seconds if needs else float('nan'),
            'predicted_memory': needs.memory / 2**20 if needs else float('nan'),
            'true_cost': l1_cost(whitened_residual(graph, world.truth))}


def peak() -> float:
    """Return the most memory this process has held [MiB]."""
    kibibytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kibibytes / 1024


def main() -> None:
    """Warm up, then solve a world of the size asked for."""
    size = [int(word) for word in sys.argv[1:3]]
    world = simulate_world(size[0], size[1], WorldOptions(), np.random.default_rng(WORLD_SEED))
    before = peak()
    print(json.dumps(solve(world) | {'peak_before': before, 'peak': peak()}))


if __name__ == '__main__':
    main()
