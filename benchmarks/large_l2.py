# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The L2 map of a large graph beside gtsam's Gauss-Newton: processor time, chi2, memory.

    python benchmarks/large_l2.py GRAPH

From the same poses, near the map, each in a process of its own, on one thread. Elimination orders
count; gtsam's are METIS's and COLAMD's.
"""

import argparse
import multiprocessing
import resource
from pathlib import Path
from typing import TYPE_CHECKING

import peer_environment

if TYPE_CHECKING:
    from solvers.cases import Case
    from solvers.graph_solvers import GraphSolver

    from l1slam_ros.core.geometry.manifold import Array


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('graph', type=Path)
    file = parser.parse_args().graph
    peer_environment.enter()
    from solvers import ours
    from solvers.cases import Case
    from solvers.graph_peers import gauss_newton_by

    from l1slam_ros.core.solvers.block_cholesky import cholesky_of
    from l1slam_ros.core.solvers.seed import first_poses
    from l1slam_ros.io.graphs.graph_file import read_graph_file

    record = read_graph_file(file)
    case = Case('large', record.graph, record.poses)
    poses = first_poses(case.graph, cholesky_of(case.graph))
    for solver in ours.L2, gauss_newton_by('METIS'), gauss_newton_by('COLAMD'):
        # What it takes is its own, but for the graph and these poses.
        process = multiprocessing.get_context('fork').Process(
            target=_measure, args=(solver, case, poses))
        process.start()
        process.join()


def _measure(solver: 'GraphSolver', case: 'Case', poses: 'Array') -> None:
    from l1slam_ros.core.graph.linear_system import whitened_residual
    from l1slam_ros.core.solvers.optimality import l2_cost

    answer = solver.prepare(case, poses)()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    chi2 = l2_cost(whitened_residual(case.graph, answer.x))
    print(f'{solver.name}: {answer.seconds:.2f} s, chi2 {chi2:.10g}, at most {most:.2f} GB',
          flush=True)


if __name__ == '__main__':
    main()
