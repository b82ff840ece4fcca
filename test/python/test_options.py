# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Options: what a mapping or a parameter file may set, types, ranges and choices."""

import math

import pytest
from command import run, solve_json

import l1slam_ros as l1

# Name -> the least and the largest value.
RANGES = {
    'keyframe.translation': (0, 1e6), 'keyframe.rotation': (0, 1e6), 'keyframe.period': (0, 1e9),
    'odometry.sigma_translation': (0, 1e6), 'odometry.sigma_rotation': (0, 1e6),
    'odometry.floor_translation': (1e-9, 1e6), 'odometry.floor_rotation': (1e-9, 1e6),
    'odometry.reorder': (0, 60), 'loop.sigma_translation': (1e-9, 1e6),
    'loop.sigma_rotation': (1e-9, 1e6), 'loop.wait': (0, 1e9),
    'solver.outer_iterations': (0, 10**6), 'solver.outer_tolerance': (0, 1),
    'solver.inner.iterations': (1, 10**7), 'solver.inner.tolerance': (0, 1),
}
CHOICES = {
    'odometry.covariance_source': ('model', 'increment', 'twist'),
    'loop.covariance_source': ('message', 'model'),
    'on_time_jump': ('new_segment', 'reset', 'ignore'),
    'solver.norm': ('l1', 'group-l1', 'l2', 'huber'),
    'solver.loop_norm': ('same', 'l1', 'group-l1', 'l2', 'huber'),
}


def options(**values):
    return l1.BackendOptions.from_mapping(values)


def value_of(name, found):
    for part in name.split('.'):
        found = getattr(found, part)
    return found


def refused(values):
    """Return how a mapping is refused."""
    with pytest.raises(l1.L1SlamError) as caught:
        l1.BackendOptions.from_mapping(values)
    return str(caught.value)


@pytest.mark.parametrize('name', RANGES)
def test_a_range_holds_its_ends_and_nothing_beyond(name):
    low, high = RANGES[name]
    whole = 'iterations' in name
    kind, step = (int, 1) if whole else (float, 1e-12)
    for end in low, high:
        found = value_of(name, options(**{name: end if whole else float(end)}))
        assert found == end and type(found) is kind
    beyond = [low - step, 2 * high, *([] if whole else [math.nan, math.inf, -math.inf])]
    for value in beyond:
        assert refused({name: value}) == f'{name} is {kind(value)}, expected {low:g} to {high:g}'
    for value in (True, '1', None, [1], *([0.5] if whole else [])):
        said = f'{name} is {value!r}, expected a value of type {kind.__name__}'
        assert refused({name: value}) == said
    # An int will do for a float, as people write them.
    assert whole or type(value_of(name, options(**{name: 1}))) is float


@pytest.mark.parametrize('name', CHOICES)
def test_a_choice_is_one_of_a_few_words(name):
    for value in CHOICES[name]:
        assert value_of(name, options(**{name: value})) == value
    for value in '?', '':
        said = f'{name} is {value!r}, expected one of {", ".join(CHOICES[name])}'
        assert refused({name: value}) == said
    assert refused({name: 5}) == f'{name} is 5, expected a value of type str'


@pytest.mark.parametrize('values', [
    {'loop': {'wait': 3}, 'solver': {'inner': {'iterations': 7}}},
    {'loop.wait': 3, 'solver.inner.iterations': 7},
    {'loop': {'wait': 3}, 'solver.inner': {'iterations': 7}, 'keyframe': {}, 'robust': {}}])
def test_a_mapping_sets_values_by_nested_or_dotted_names(values):
    found, defaults = l1.BackendOptions.from_mapping(values), l1.BackendOptions()
    assert (found.loop.wait, found.solver.inner.iterations) == (3.0, 7)
    assert found.loop.sigma_rotation == defaults.loop.sigma_rotation
    assert (found.keyframe, found.odometry) == (defaults.keyframe, defaults.odometry)
    assert l1.BackendOptions.from_mapping({}) == defaults != found


@pytest.mark.parametrize('values, said', [
    ({'loop': {'wings': 2}}, 'no option is called loop.wings'),
    ({'loop': {'wait': {'long': 4}}}, 'no option is called loop.wait.long'),
    ({'loop': 2}, 'no option is called loop'),
    ({'wait': 1.0}, 'no option is called wait'),
    ({7: 2}, 'no option is called 7'),
    ({'loop': {'wait': 3}, 'loop.wait': 4}, 'loop.wait is set twice, to 3 and to 4'),
    ({'robust': {'enabled': 1}}, 'robust.enabled is 1, expected a value of type bool'),
    ({'base_frame': 5}, 'base_frame is 5, expected a value of type str'),
    (['loop'], "options are ['loop'], expected a mapping of names to values"),
    (None, 'options are None, expected a mapping of names to values')])
def test_a_mapping_of_nonsense_is_refused(values, said):
    assert refused(values) == said


# Parameter files


@pytest.fixture
def asked(tmp_path):
    """Return the arguments of a solve by a parameter file of this text."""
    graph = tmp_path / 'graph.g2o'
    graph.write_text('EDGE_SE2 0 1 3 0 0 1 0 0 1 0 1\nEDGE_SE2 0 1 0 4 0 1 0 0 1 0 1\n')

    def write(text):
        (tmp_path / 'params.yaml').write_text(text)
        return graph, '--no-robust', '--params-file', tmp_path / 'params.yaml'

    return write


OURS = '{ros__parameters: {solver: {norm: l2}}}'
OTHERS = '{ros__parameters: {wheels: 4}}'
OF_ALL = '/**: {ros__parameters: {use_sim_time: true, qos_overrides./odom.subscription.depth: 5}}'


@pytest.mark.parametrize('text', [
    f'/**: {OURS}', f'renamed: {OURS}', f'/robot/backend: {OURS}', f'/robot: {{backend: {OURS}}}',
    f'{OF_ALL}\nbackend: {OURS}\nrobot: {{wheels: {OTHERS}}}', f'{OF_ALL}\nrenamed: {OURS}'])
def test_a_parameter_file_is_read_as_ros_reads_it(asked, capsys, text):
    """Of two factors that differ by 3 and by 4 m, the L2 map is in the middle."""
    l1_cost = solve_json(capsys, *asked('/**: {ros__parameters: {update: {period: 1}}}'))
    assert l1_cost['final_cost'] == pytest.approx(7)
    assert solve_json(capsys, *asked(text))['final_cost'] == pytest.approx(12.5)


@pytest.mark.parametrize('values, said', [
    ("map_frame: ''", "map_frame is '' and odom_frame 'odom', expected two different names"),
    ("odom_frame: ''", "map_frame is 'map' and odom_frame '', expected two different names"),
    ('odom_frame: /map', "map_frame is 'map' and odom_frame 'map', expected two different"),
    ('robots: [r1, r1]', "robots is ['r1', 'r1'], expected different names"),
    ('robots: [a/b]', "robots is ['a/b'], expected different names"),
    ('robots: [1]', 'robots is [1], expected a value of type list of str'),
    ('save_path: /maps', "save_path is '/maps', expected the name of a .g2o file"),
    ('dimension: 4', 'dimension is 4, expected 2 to 3'),
    ('update: {budget: 0}', 'update.budget is 0.0, expected 0.001 to 3600')])
def test_what_the_node_cannot_use_is_refused(asked, capsys, values, said):
    err = run(capsys, 'solve', *asked(f'/**: {{ros__parameters: {{{values}}}}}'), code=2)[1]
    assert f'params.yaml: {said}' in err and err.count('\n') == 1
