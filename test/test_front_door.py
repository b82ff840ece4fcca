# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`import l1slam_ros`: light, and the README's example of it runs."""

import ast
import copy
import inspect
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command import solve_json
from worlds import false_of, made

import l1slam_ros as l1

ROOT = Path(__file__).parents[1]
README = (ROOT / 'README.md').read_text()
EXAMPLE = re.search(r'## In Python.*?```python\n(.*?)```', README, re.S)[1]


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    return made(tmp_path_factory.mktemp('world') / 'world.g2o', 200, 320, '--false-loops', 10)


def test_the_import_is_light():
    code = ('import sys, l1slam_ros; print(sorted({"rclpy", "scipy", "matplotlib", '
            '"numpy"} & sys.modules.keys()), *dir(l1slam_ros))')
    said = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                          check=True).stdout
    assert said.startswith('[] ')
    assert set(l1.__all__) <= set(said.split())


def test_the_example_of_the_readme_runs_and_says_what_it_found(world):
    ran = subprocess.run([sys.executable, '-c', EXAMPLE], cwd=world.parent, capture_output=True,
                         text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, '')
    assert re.match(r'converged: L1 cost [0-9.]+, 10 loops refused\n', ran.stdout)
    assert len(l1.read_graph(world.parent / 'solved.g2o')[1]) == 200


def test_type_checkers_know_every_name():
    found = {alias.name: node.module for node in ast.walk(ast.parse(inspect.getsource(l1)))
             if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert {name: found[name] for name in l1.__all__} == {
        name: getattr(l1, name).__module__ for name in l1.__all__}


def test_the_refused_are_the_false_and_a_start_is_begun_from(world):
    graph, poses = l1.read_graph(world)
    solution = l1.solve(graph)
    assert sorted(graph.between.pairs[~solution.inliers].tolist()) == sorted(false_of(world))
    moved = poses + [5.0, 0.0, 0.0]
    from_there = l1.solve(graph, norm='l2', robust=False, start=moved)
    np.testing.assert_allclose(from_there.poses[0], moved[0])
    assert from_there.inliers.all()


@pytest.mark.parametrize('robust', [True, False])
def test_what_a_person_struck_out_is_there_for_nobody(world, robust):
    graph, _ = l1.read_graph(world)
    loops = np.flatnonzero(~graph.between.is_odometry)[:50]
    left = np.delete(np.arange(len(graph.between)), loops)
    without = l1.solve(graph.subset(left), robust=robust)
    graph.say(loops, trusted=False)
    solution = l1.solve(graph, robust=robust)
    np.testing.assert_array_equal(solution.poses, without.poses)
    assert not solution.inliers[loops].any()
    np.testing.assert_array_equal(solution.inliers[left], without.inliers)


def test_every_door_takes_a_norm_of_loops_alone(world, tmp_path, capsys):
    graph, _ = l1.read_graph(world)
    solution = l1.solve(graph, norm='l2', loop_norm='group-l1', robust=False)
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {solver: {norm: l2, loop_norm: group-l1}}}')
    costs = []
    for asked in (('--norm', 'l2', '--loop-norm', 'group-l1'), ('--params-file', str(params)),
                  ('--norm', 'group-l1', '--params-file', str(params))):
        report = solve_json(capsys, world, '--no-robust', '--quiet', *asked)
        assert report['status'] == 'converged'
        costs.append(report['final_cost'])
    # The last is group L1 of all: a norm of the odometry that is that of the loops.
    assert costs[0] == costs[1] == solution.cost < costs[2]
    assert solution.status == 'converged'


def test_poses_that_are_none_are_refused(world):
    graph, poses = l1.read_graph(world)
    poses[7] = np.nan
    with pytest.raises(l1.L1SlamError, match='start of keyframe 7 is no pose; expected finite'):
        l1.solve(graph, start=poses)
    with pytest.raises(l1.L1SlamError, match='pose 7 is .*, expected finite numbers'):
        l1.write_graph(world.parent / 'x.tum', graph, poses)


@pytest.mark.parametrize('clone', [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_graph_goes_to_other_processes(world, clone):
    graph, _ = l1.read_graph(world)
    other = clone(graph)
    assert other.manifold is graph.manifold
    assert clone(l1.solve(other)).cost == l1.solve(graph).cost


def test_a_start_of_long_quaternions_is_the_same_start(tmp_path):
    graph, poses = l1.read_graph(made(tmp_path / 'world.g2o', 30, 50, '--world', 'sphere'))
    once, twice = (l1.solve(graph, robust=False, start=start).poses
                   for start in (poses, poses * [1, 1, 1, 2, 2, 2, 2]))
    np.testing.assert_allclose(twice, once, atol=1e-9)


@pytest.mark.parametrize('call, said', [
    (lambda graph, _: l1.solve('world.g2o'),
     "graph is 'world.g2o', expected a FactorGraph, as read_graph returns first"),
    (lambda graph, _: l1.solve(graph, robust='no'), "robust is 'no', expected True or False"),
    (lambda graph, _: l1.solve(graph, norm=['l1']), "norm is ['l1'], expected one of l1, "),
    (lambda graph, _: l1.solve(graph, loop_norm='l3'), "loop_norm is 'l3', expected one of same"),
    (lambda graph, _: l1.solve(graph, start=np.zeros((3, 3))),
     'start has the shape (3, 3), expected (200, 3)'),
    (lambda graph, _: l1.solve(graph, start='seed'), 'start has entries that are no numb'),
    (lambda graph, _: l1.write_graph('x.g2o', graph, None), 'poses have the shape (), expected'),
    (lambda *_: l1.read_graph(None), 'path is None, expected the name of a file'),
    (lambda *_: l1.read_graph('bag', odom_topic=3), 'odom_topic is 3, expected the name of a top'),
    (lambda *_: l1.Backend({'keyframe': {'translation': 1.0}}),
     "options is {'keyframe': {'translation': 1.0}}, expected BackendOptions; BackendOptions.from_"
     'mapping makes them of a mapping'),
    (lambda *_: l1.Backend(dimension='2'), "dimension is '2', expected 2 or 3"),
    (lambda *_: l1.Backend(background='yes'), "background is 'yes', expected True or False"),
    (lambda *_: l1.BackendOptions(keyframe={'translation': 1.0}),
     "keyframe is {'translation': 1.0}, expected KeyframeOptions; KeyframeOptions.from_mapping"),
    (lambda *_: l1.BackendOptions.from_mapping({'keyfram': {'translation': 1.0}}),
     'no option is called keyfram.translation'),
    (lambda *_: l1.BackendOptions.from_mapping('keyframe'), "options are 'keyframe', expected a"),
    (lambda *_: l1.Backend().add_loop(3), 'the measurement is 3, expected LoopClosure'),
])
def test_what_is_of_another_kind_is_refused_by_its_name(world, call, said):
    graph, poses = l1.read_graph(world)
    with pytest.raises(l1.L1SlamError) as caught:
        call(graph, poses)
    assert str(caught.value).startswith(said)
