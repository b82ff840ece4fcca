# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: the paper's algorithms as printed, what the report says, what it leaves."""

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from command import run
from PIL import Image
from problems import linprog_l1
from scipy.optimize import linprog

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.geometry.se2 import wrap
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions, minimise_l2
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import rotation_system, seed_poses, translation_system
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.ours import REPORT_MARK
from l1slam_ros.paper import experiments as reproduction
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper import reproduce
from l1slam_ros.paper.experiments import (
    Effort,
    measure_convergence,
    measure_costs,
    measure_largest,
    printed_costs,
    printed_iterates,
)

LITTLE = Effort(outer=4, inner=60, iterations=400, timed=3, keyframes=0)
TINY_10K = replace(paper.MANHATTAN_10K, poses=80, edges=160)
TINY_50K = replace(paper.MANHATTAN_50K, poses=60, edges=150)


def silent(iteration, cost):
    """A report that nobody reads."""


@pytest.fixture(scope='module')
def world():
    return simulate_world(80, 160, WorldOptions(), np.random.default_rng(3))


@pytest.fixture(scope='module')
def seed(world):
    return seed_poses(world.graph, cholesky_of(world.graph))


def cost(graph, poses):
    return l1_cost(whitened_residual(graph, poses))


def algorithm_2(system):
    """The paper's Algorithm 2 for theta = 1, from zero, written out in dense matrices."""
    A, b = system.A.toarray(), system.b
    tau, sigma = 1 / np.abs(A).sum(axis=0), 1 / np.abs(A).sum(axis=1)
    x = x_bar = np.zeros(A.shape[1])
    y = np.zeros(len(b))
    while True:
        y = y + sigma * (A @ x_bar - b)
        y = y / np.maximum(1, np.abs(y))
        x_new = x - tau * (A.T @ y)
        x, x_bar = x_new, 2 * x_new - x
        yield x, y


def test_the_printed_iterates_are_those_of_algorithm_2(world, seed):
    system = linearise(world.graph, seed)
    ours = printed_iterates(system, np.zeros(system.A.shape[1]))
    for (x, y), (x_ours, y_ours) in islice(zip(algorithm_2(system), ours, strict=True), 25):
        np.testing.assert_allclose(x_ours, x, atol=1e-12)
        np.testing.assert_allclose(y_ours, y, atol=1e-12)


def test_algorithm_4_as_printed_takes_full_steps_from_a_cold_dual(world):
    told = []
    poses = world.odometry
    expected = [cost(world.graph, world.odometry)]
    for _ in range(3):
        *_, (x, _) = islice(algorithm_2(linearise(world.graph, poses)), LITTLE.inner)
        poses = step_poses(world.graph, poses, x)
        expected.append(cost(world.graph, poses))
    costs = printed_costs(world.graph, world.odometry, replace(LITTLE, outer=3),
                          lambda *step: told.append(step))
    np.testing.assert_allclose(costs, expected, rtol=1e-9)
    assert told == list(enumerate(costs))[1:]


def test_algorithm_4_as_printed_ends_once_it_has_settled(world, seed):
    costs = printed_costs(world.graph, seed, Effort(outer=200, inner=40), silent)
    changes = np.abs(np.diff(costs)) / costs[1:]
    windows = np.lib.stride_tricks.sliding_window_view(changes, 5)
    assert len(costs) < 201 and (windows < 1e-4).all(axis=1).tolist() == [
        k == len(windows) - 1 for k in range(len(windows))]


def test_costs_are_those_of_the_poses_and_ours_is_the_lowest(world, seed):
    costs = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert costs.initial == cost(world.graph, world.odometry)
    assert costs.seed == costs.printed[0] == cost(world.graph, seed)
    assert costs.solution.cost == cost(world.graph, costs.solution.poses)
    assert costs.solution.cost < min(costs.seed, costs.l2, *costs.printed, costs.initial)


def test_both_problems_begin_at_the_odometry_and_come_near_their_optimum(world, seed):
    graph, factors = world.graph, world.graph.between
    curves = measure_convergence(graph, world.odometry, seed, 2000)
    theta = world.odometry[:, 2]
    error = wrap(theta[factors.j] - theta[factors.i] - factors.measurement[:, 2])
    mixed = np.concatenate((world.odometry[:, :2], seed[:, 2:]), axis=1)
    rows = whiten(factors.sqrt_information, graph.manifold.residual(
        factors.measurement, mixed[factors.i], mixed[factors.j]))
    begin = {'angle': np.abs(factors.sqrt_information[:, 2, 2] * error).sum(),
             'translation': np.abs(rows[:, :2]).sum()}
    systems = {'angle': rotation_system(graph, world.odometry),
               'translation': translation_system(graph, seed)}
    for problem, system in systems.items():
        optimum, _ = linprog_l1(system.A, system.b)
        for name, history in curves[problem].items():
            assert history[0, 0] == 0 and history[-1, 0] == 2000
            assert optimum - 1e-6 < history[-1, 1] < 1.02 * optimum
            if 'least squares' not in name:
                assert history[0, 1] == pytest.approx(begin[problem])


def test_a_report_is_whole_and_its_pictures_are_there(tmp_path):
    output = tmp_path / 'out'
    reproduce.reproduce(None, [TINY_10K, TINY_50K], output,
                        replace(LITTLE, keyframes=120, rate=1000.0))
    text = (output / 'report.md').read_text()
    linked = re.findall(r'!\[.*?\]\((.*?)\)', text)
    assert sorted([*linked, 'report.md']) == sorted(p.name for p in output.iterdir())
    for name in linked:
        with Image.open(output / name) as image:
            assert image.format == 'PNG' and min(image.size) > 300
    assert re.findall('^## (.*)', text, re.MULTILINE) == list(reproduce.SECTIONS)
    assert 'It is of Intel, which was not run.' in text
    assert 'Not run: Manhattan3500, Intel, City10k' in text
    assert all(name in text for name in (*paper.FILES, '--datasets'))
    assert 'Not run: it is of Intel.' in text
    assert re.search(r'proportions of City10k \(seed 0\), 120 keyframes, .* at [0-9]+ keyframes '
                     'per second', text)
    assert 'Not run: it is of Intel and Manhattan3500.' in text
    assert list(tmp_path.iterdir()) == [output]


def write_world(path, poses, edges, seed=3):
    """Write a little world under the name of one of the paper's graphs."""
    world = simulate_world(poses, edges, WorldOptions(), np.random.default_rng(seed))
    write_graph_file(path, GraphRecord(world.graph, world.odometry, np.arange(poses)))


def test_figures_4_and_6_are_of_the_files_that_are_there(tmp_path):
    write_world(tmp_path / 'intel.g2o', 80, 160)
    write_world(tmp_path / 'manhattan3500.g2o', 70, 150)
    output = tmp_path / 'out'
    reproduce.reproduce(tmp_path, [], output, LITTLE)
    assert sorted(path.name for path in output.iterdir()) == [
        'figure_3.png', 'figure_4.png', 'figure_6_intel.png', 'figure_6_manhattan3500.png',
        'report.md']
    for name in ('figure_4.png', 'figure_6_intel.png', 'figure_6_manhattan3500.png'):
        with Image.open(output / name) as image:
            assert image.format == 'PNG' and min(image.size) > 600
    text = (output / 'report.md').read_text()
    assert re.search(r'The seed, then Algorithm 4 as printed: L1 cost [0-9.]+\.\n', text)
    assert 'it is of Intel' not in text


def test_a_graph_without_room_for_false_loops_is_named(tmp_path):
    write_world(tmp_path / 'intel.g2o', 4, 4)
    with pytest.raises(FileError, match=r'intel\.g2o: 10 false loops asked for, found'):
        reproduce.reproduce(tmp_path, [], tmp_path / 'out', LITTLE)
    assert [path.name for path in tmp_path.iterdir()] == ['intel.g2o']


def test_algorithm_4_as_printed_is_cut_short_on_the_largest_graphs(world, seed, monkeypatch):
    whole = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert not whole.cut_short and len(whole.printed) == 1 + LITTLE.outer
    monkeypatch.setattr(reproduction, '_MOST_PASSES', 2.5 * LITTLE.inner * 160)
    cut = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert cut.cut_short and cut.printed.tolist() == whole.printed[:3].tolist()
    few = measure_costs(world.graph, world.odometry, seed, replace(LITTLE, outer=2), silent)
    assert not few.cut_short


def test_the_largest_residual_is_that_of_a_linear_program(world, seed):
    graph = world.graph
    found = measure_largest(graph, seed, replace(LITTLE, iterations=20_000))
    largest = {name: values[0] for name, values in found.items()}
    assert largest['L-infinity'] < largest['L2'] < largest['L1']
    assert found['L1'][1] == min(values[1] for values in found.values())
    assert found['L2'][2] == min(values[2] for values in found.values())
    # To first order, as near as the map is to the L2 map.
    l2 = minimise_l2(graph, seed, LeastSquaresOptions(), cholesky_of(graph)).poses
    system = linearise(graph, l2)
    A, b = system.A.toarray(), system.b
    rows, columns = A.shape
    level = np.ones((rows, 1))
    best = linprog(np.append(np.zeros(columns), 1.0),
                   A_ub=np.block([[A, -level], [-A, -level]]), b_ub=np.concatenate((b, -b)),
                   bounds=[(None, None)] * columns + [(0, None)], method='highs').fun
    assert largest['L-infinity'] == pytest.approx(best, rel=1e-2)


def test_a_report_replaces_its_former_self_and_nothing_else(tmp_path):
    (tmp_path / 'report.md').write_text(f'{REPORT_MARK}\nformer')
    (tmp_path / 'notes.txt').write_text('mine')
    reproduce.reproduce(None, [TINY_50K], tmp_path, LITTLE)
    assert (tmp_path / 'notes.txt').read_text() == 'mine'
    text = (tmp_path / 'report.md').read_text()
    assert 'Manhattan50k (*)' in text
    assert 'it is of Manhattan10k, which `--worlds 10k` makes' in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ['figure_3.png', 'notes.txt', 'report.md']
    # Readable by whom other files are: not by their owner alone.
    mode = (tmp_path / 'notes.txt').stat().st_mode
    assert (tmp_path / 'report.md').stat().st_mode == mode


def arguments(folder, **changes):
    options = {'datasets': folder, 'worlds': 'none', 'output': folder / 'out', **changes}
    return [word for name, value in options.items() if value is not None
            for word in (f'--{name}', value)]


@pytest.mark.parametrize(('changes', 'says'), [
    ({'datasets': None}, 'expected --datasets DIR, or --worlds other than none'),
    ({}, "none of the paper's graphs is there; expected manhattan3500.g2o, intel.g2o"),
    ({'datasets': Path('/no/such/folder')}, "none of the paper's graphs is there"),
    ({'worlds': '10k', 'datasets': None, 'output': Path('/no/such/folder')}, 'is no folder'),
    ({'worlds': '10k', 'datasets': None, 'output': Path(__file__)}, 'is no folder; expected one'),
    ({'output': Path('/proc')}, '/proc/report.md: cannot be written'),
    ({'output': Path('/proc/out')}, '/proc/out: cannot be written'),
])
def test_what_cannot_be_is_refused_at_once_in_one_line(capsys, tmp_path, changes, says):
    out, err = run(capsys, 'reproduce', *arguments(tmp_path, **changes), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('text', 'says'), [
    ('EDGE_SE2 0 1 1 0 nonsense 1 0 0 1 0 1\n', 'intel.g2o:1: '),
    ('VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 1 0 0\n'
     'EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', 'intel.g2o: the graph is not connected: vertex 2')])
def test_a_graph_that_cannot_be_used_is_named(capsys, tmp_path, text, says):
    (tmp_path / 'intel.g2o').write_text(text)
    out, err = run(capsys, 'reproduce', *arguments(tmp_path), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert [p.name for p in tmp_path.iterdir()] == ['intel.g2o']
