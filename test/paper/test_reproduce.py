# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: the paper's algorithms as printed, what the report says, what it leaves."""

import re
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from problems import linprog_l1

from l1slam_ros.cli.main import main
from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.geometry.noise import whiten
from l1slam_ros.core.geometry.se2 import wrap
from l1slam_ros.core.graph.linear_system import linearise, step_poses, whitened_residual
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.nonlinear import Solution
from l1slam_ros.core.solvers.optimality import Status, l1_cost
from l1slam_ros.core.solvers.seed import rotation_system, seed_poses, translation_system
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io.graphs.graph_file import GraphRecord, write_graph_file
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.paper import experiments as reproduction
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper import report, reproduce
from l1slam_ros.paper.experiments import (
    PROBLEMS,
    TIMED,
    Costs,
    Effort,
    Seconds,
    measure_convergence,
    measure_costs,
    measure_seconds,
    printed_costs,
    printed_iterates,
)

LITTLE = Effort(outer=4, inner=60, iterations=400, timed=3, draws=2)
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
    told, poses, expected = [], world.odometry, [cost(world.graph, world.odometry)]
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


def test_seconds_are_of_every_method_and_problem(world, seed):
    seconds = measure_seconds(world.graph, seed, LITTLE)
    assert list(seconds.methods) == list(TIMED)
    assert all(len(times) == len(PROBLEMS) and min(times) > 0
               for times in seconds.methods.values())
    assert seconds.l2 > 0


def test_a_report_is_whole_and_its_pictures_are_there(tmp_path):
    output = tmp_path / 'out'
    reproduce.reproduce(None, [TINY_10K, TINY_50K], output, LITTLE)
    text = (output / 'report.md').read_text()
    linked = re.findall(r'!\[.*?\]\((.*?)\)', text)
    assert sorted([*linked, 'report.md']) == sorted(p.name for p in output.iterdir())
    for name in linked:
        with Image.open(output / name) as image:
            assert image.format == 'PNG' and min(image.size) > 300
    assert re.findall('^## (.*)', text, re.MULTILINE) == list(reproduce.SECTIONS)
    assert 'Not run: Manhattan3500, Intel and City10k' in text
    assert all(name in text for name in (*paper.FILES, '--datasets'))
    assert '--worlds' not in text
    assert 'Not run: it is of Intel.' in text
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
    assert '10 in Intel (81 true loops' in text and '2 in Manhattan3500 (81 true loops' in text
    assert '20 false loops in all draws' in text and '4 false loops in all draws' in text
    assert all(f'| {method} |' in text
               for method in ('seed alone', 'seed, then L1', 'loops doubted, then L1'))
    assert 'it is of Intel' not in text


def cells(lines):
    """The rows of the first Markdown table among some lines, without the line under its head."""
    rows = [[cell.strip() for cell in line.strip('|').split('|')]
            for line in lines if line.startswith('|')]
    assert len({len(row) for row in rows}) == 1
    return [rows[0], *rows[2:]]


def test_the_papers_own_graph_is_known_by_its_cost(datasets, tmp_path):
    shutil.copy(datasets / 'intel.g2o', tmp_path)
    results = reproduce.run(reproduce.read_datasets(tmp_path), [], replace(LITTLE, draws=1))
    header, row = cells(report.table_1(results))
    at = dict(zip(header, row, strict=True))
    assert at['poses, edges'] == '943, 1,837'
    assert at['start: paper'] == at['start: ours'] == '1513.17'
    assert at['final: paper'] == '982.051'
    assert float(at['final: ours'].strip('*')) == pytest.approx(961.774, rel=1e-3)
    assert float(at['of the L2 map']) == pytest.approx(1160.722, rel=1e-3)
    said = '\n'.join(report.table_1(results))
    assert "Intel: our final is 2.1% below the paper's;" in said
    assert "these are the paper's own graphs" in said and 'simulate' not in said
    assert [graph.name for graph in results.missing] == [
        'Manhattan3500', 'Manhattan10k', 'City10k', 'Manhattan50k']
    assert results.convergence == {}


def result(graph, initial, seed, printed, final, l2, truth=None, plain=2e-3):
    """What a graph of three poses would have given, had these been its numbers."""
    solution = Solution(np.zeros((3, 3)), final, Status.CONVERGED, 1, 0,
                        np.array([seed, final]), np.zeros(0))
    costs = Costs(initial, seed, l2, np.array([seed, printed]), False, solution,
                  'interior-point')
    seconds = Seconds({'plain': [plain] * 3, 'fused': [plain / 8] * 3}, 10 * plain)
    return report.GraphResult(graph, 3, 2, costs, seconds,
                              MapDrawing('map', np.zeros((3, 2))), truth)


def said_of(*graphs):
    return '\n'.join(report.table_1(report.Results(graphs)))


def test_sentences_follow_the_numbers():
    good = said_of(result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0))
    assert 'L2 map has a lower L1 cost' in good and 'seed alone' in good
    assert 'ends above the seed that it began from: Intel' in good
    bad = said_of(result(paper.INTEL, 1513.17, 1200.0, 950.0, 990.0, 1100.0))
    assert 'L2 map has a lower L1 cost' not in bad and 'seed alone' not in bad
    assert 'ends above the seed' not in bad
    assert "our final is 0.81% above the paper's" in bad
    assert 'as printed ends below ours: Intel' in bad


def test_another_graph_of_the_same_name_is_not_compared():
    said = said_of(result(paper.INTEL, 3026.34, 970.0, 1000.0, 960.0, 980.0))
    assert "the cost at the start is 2 times the paper's" in said
    assert '`intel.g2o` is not the file of the paper' in said
    assert 'our final is' not in said and 'seed alone' not in said


def test_a_world_is_compared_with_its_truth_and_not_with_the_paper():
    said = said_of(result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, truth=125.0))
    assert 'Manhattan50k (*)' in said and 'the times compare, the costs do not' in said
    assert 'our final is 20% below the cost of the true poses, 125' in said
    assert "the paper's final" not in said.replace('final: paper', '')


def test_times_are_set_beside_those_of_the_paper():
    lines = report.table_2(report.Results([
        result(paper.INTEL, 1513.17, 970.0, 1000.0, 960.0, 980.0),
        result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0, plain=0.28)]))
    header, intel, large = cells(lines)
    assert dict(zip(header, intel, strict=True)) == {
        'ms per iteration': 'Intel', 'angle: paper': '0.3', 'angle: plain': '2',
        'angle: fused': '0.25', 'translation: paper': '0.6', 'translation: plain': '2',
        'translation: fused': '0.25', 'global: paper': '1', 'global: plain': '2',
        'global: fused': '0.25', 'L2: paper (g2o)': '6.7', 'L2: ours': '20'}
    assert large[-2:] == ['did not finish', '2800']
    said = '\n'.join(lines)
    assert 'One plain iteration takes 2 (Intel, global) to 19 (Manhattan50k, angle) times' in said
    assert 'as so many fused ones: Intel 8, Manhattan50k 8.' in said
    assert 'Intel 10 (6.7), Manhattan50k 10 (did not finish)' in said


def test_a_curve_has_arrived_where_it_stays():
    out_again = np.array([[0, 100.0], [40, 100.1], [80, 150.0], [120, 100.05]])
    never = np.array([[0, 300.0], [40, 250.0], [80, 200.0]])
    rows = cells(report.figure_2(report.Results([], convergence={
        'angle': {'one': out_again, 'other': never}})))
    assert rows[1][-2:] == ['0.05% above', '120'] and rows[2][-2:] == ['2 times', 'not reached']


@pytest.mark.parametrize(('value', 'words'), [
    (90.0, '10% below'), (112.0, '12% above'), (100.0, 'level with'), (345.0, '3.45 times')])
def test_compared(value, words):
    assert report.compared(value, 100.0) == words


def test_a_graph_without_room_for_false_loops_is_named(tmp_path):
    write_world(tmp_path / 'intel.g2o', 4, 4)
    with pytest.raises(FileError, match=r'intel\.g2o: 10 false loops asked for, found'):
        reproduce.run(reproduce.read_datasets(tmp_path), [], LITTLE)


def test_algorithm_4_as_printed_is_cut_short_on_the_largest_graphs(world, seed, monkeypatch):
    whole = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert not whole.cut_short and len(whole.printed) == 1 + LITTLE.outer
    monkeypatch.setattr(reproduction, '_MOST_PASSES', 2.5 * LITTLE.inner * 160)
    cut = measure_costs(world.graph, world.odometry, seed, LITTLE, silent)
    assert cut.cut_short and cut.printed.tolist() == whole.printed[:3].tolist()
    few = measure_costs(world.graph, world.odometry, seed, replace(LITTLE, outer=2), silent)
    assert not few.cut_short


def test_a_cut_is_reported():
    large = result(paper.MANHATTAN_50K, 9e8, 110.0, 120.0, 100.0, 105.0)
    assert 'was ended after' not in said_of(large)
    cut = replace(large, costs=replace(large.costs, cut_short=True))
    assert 'Manhattan50k: Algorithm 4 as printed was ended after 1 linearisation' in said_of(cut)


def fails(results, folder):
    raise FileError(folder / 'figure_5.png', 'cannot be drawn')


def test_nothing_is_left_of_a_report_that_fails(tmp_path, monkeypatch):
    monkeypatch.setitem(reproduce.SECTIONS, 'Figure 5: what another issue will add', fails)
    with pytest.raises(FileError, match=r'figure_5\.png: cannot be drawn'):
        reproduce.reproduce(None, [TINY_50K], tmp_path / 'out', LITTLE)
    assert list(tmp_path.iterdir()) == []


def test_a_report_replaces_its_former_self_and_nothing_else(tmp_path):
    (tmp_path / 'report.md').write_text('former')
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
            for word in (f'--{name}', str(value))]


@pytest.mark.parametrize(('changes', 'says'), [
    ({'datasets': None}, 'expected --datasets DIR, or --worlds other than none'),
    ({}, "none of the paper's graphs is there; expected manhattan3500.g2o, intel.g2o"),
    ({'datasets': Path('/no/such/folder')}, "none of the paper's graphs is there"),
    ({'worlds': '10k', 'datasets': None, 'output': Path('/no/such/folder')}, 'is no folder'),
    ({'worlds': '10k', 'datasets': None, 'output': Path(__file__)}, 'is no folder; expected one'),
])
def test_what_cannot_be_is_refused_at_once_in_one_line(capsys, tmp_path, changes, says):
    assert main(['reproduce', *arguments(tmp_path, **changes)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and says in err and err.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('text', 'says'), [
    ('EDGE_SE2 0 1 1 0 nonsense 1 0 0 1 0 1\n', 'intel.g2o:1: '),
    ('VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 1 0 0\n'
     'EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', 'intel.g2o: the graph is not connected: vertex 2'),
])
def test_a_graph_that_cannot_be_used_is_named(capsys, tmp_path, text, says):
    (tmp_path / 'intel.g2o').write_text(text)
    assert main(['reproduce', *arguments(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and says in err and err.count('\n') == 1
    assert [p.name for p in tmp_path.iterdir()] == ['intel.g2o']


def test_nothing_to_run_is_an_error_of_options(tmp_path):
    with pytest.raises(OptionError, match='nothing to run'):
        reproduce.reproduce(None, [], tmp_path / 'out', LITTLE)
