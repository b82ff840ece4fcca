# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What others make of our files: evo of trajectories and bags, g2o and gtsam of graphs."""

import json
import zipfile

import numpy as np
import pytest
from command import run, solve_json
from environments import environment
from worlds import made

# Before Python 3.11 there are only wheels of gtsam that were built for NumPy 1.
GTSAM = ('gtsam>=4.2,<4.4', 'numpy<2; python_version < "3.11"')
# gtsam's residual is Log(e), ours and g2o's is t2v(e): at these angles they differ by so much.
OTHER_RESIDUAL = 1e-4

WITH_G2O = """
import json, sys
import g2opy as g2o

optimiser = g2o.SparseOptimizer()
optimiser.set_verbose(False)
optimiser.set_algorithm(g2o.OptimizationAlgorithmGaussNewton(
    g2o.BlockSolverSE2(g2o.LinearSolverEigenSE2())))
assert optimiser.load(sys.argv[1])
optimiser.vertex(0).set_fixed(True)
optimiser.initialize_optimization()
costs = []
for iterations in (0, 10):
    optimiser.optimize(iterations)
    optimiser.compute_active_errors()
    costs.append(optimiser.chi2())
print(json.dumps([len(optimiser.vertices()), len(optimiser.edges()), costs]))
"""

WITH_GTSAM = """
import json, sys
import gtsam

graph, poses = gtsam.load2D(sys.argv[1], noiseFormat=gtsam.NoiseFormat.NoiseFormatG2O)
counts = [poses.size(), graph.size()]
graph.add(gtsam.NonlinearEqualityPose2(0, poses.atPose2(0)))
optimised = gtsam.GaussNewtonOptimizer(graph, poses, gtsam.GaussNewtonParams()).optimize()
print(json.dumps([*counts, [2 * graph.error(poses), 2 * graph.error(optimised)]]))
"""


def test_evo_reads_our_bags_and_finds_the_error_that_we_find(capsys, tmp_path):
    tool, bag = environment('evo'), made(tmp_path / 'world', 300, 500, '--seed', 3)
    # It writes settings to a home.
    variables = {'HOME': str(tmp_path), 'MPLBACKEND': 'Agg'}
    run(capsys, 'solve', bag, '--output', tmp_path / 'solved.tum')
    run(capsys, 'convert', bag, tmp_path / 'ours.tum')
    tool.run('evo_traj', 'bag2', bag, '/ground_truth', '/odom', '--save_as_tum', cwd=tmp_path,
             **variables)
    theirs, ours = np.loadtxt(tmp_path / 'odom.tum'), np.loadtxt(tmp_path / 'ours.tum')
    assert theirs.shape == (300, 8)
    assert np.abs(theirs - ours).max() < 1e-9
    truth, positions = np.loadtxt(f'{bag}.truth.txt'), np.loadtxt(tmp_path / 'ground_truth.tum')
    assert np.abs(truth[:, 1:3] - positions[:, 1:3]).max() < 1e-9
    tool.run('evo_ape', 'tum', 'ground_truth.tum', 'solved.tum', '--align', '--save_results',
             'ape.zip', cwd=tmp_path, **variables)
    with zipfile.ZipFile(tmp_path / 'ape.zip') as archive:
        rmse = json.loads(archive.read('stats.json'))['rmse']
    found = solve_json(capsys, bag, '--reference', tmp_path / 'ground_truth.tum')
    assert found['ate'] == pytest.approx(rmse, rel=1e-6)
    assert 0 < found['ate'] < 0.2


@pytest.fixture
def solved(capsys, tmp_path):
    """Write a least squares solution; return the folder and what we say of it."""
    world = made(tmp_path / 'world.g2o', 300, 500, '--seed', 3)
    vertices, edges = (
        [line.split() for line in world.read_text().splitlines() if line.startswith(tag)]
        for tag in ('VERTEX', 'EDGE'))
    # The order of six numbers shows only where all of them differ.
    other = ['400', '30', '-200', '300', '100', '9000']
    world.write_text('\n'.join(' '.join(line) for line in
                               [*vertices, *(edge[:-6] + other for edge in edges)]))
    run(capsys, 'solve', world, '--norm', 'l2', '--output', tmp_path / 'map.g2o')
    return tmp_path, solve_json(capsys, tmp_path / 'map.g2o', '--norm', 'l2', '--start', 'file',
                           '--outer', 0)


def read_by(made, code, path):
    return json.loads(made.run('python', '-c', code, path, cwd=path.parent))


def test_g2o_reads_back_the_graph_and_its_solution(solved):
    folder, ours = solved
    poses, factors, (cost, lowest) = read_by(environment('g2opy'), WITH_G2O, folder / 'map.g2o')
    assert (poses, factors) == (ours['poses'], ours['factors']) == (300, 500)
    assert cost == pytest.approx(ours['final_cost'], rel=1e-9)
    assert (1 - 1e-6) * cost < lowest <= (1 + 1e-12) * cost


def test_gtsam_reads_back_the_graph_and_its_solution(solved):
    folder, ours = solved
    poses, factors, (cost, lowest) = read_by(environment(*GTSAM), WITH_GTSAM, folder / 'map.g2o')
    assert (poses, factors) == (ours['poses'], ours['factors'])
    assert cost == pytest.approx(ours['final_cost'], rel=OTHER_RESIDUAL)
    # Before 4.3 its derivatives are approximations, and it ends slightly higher than it began.
    assert lowest > (1 - 1e-6) * cost
