# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Options: types, ranges, choices, nested names; and every option there is has a meaning."""

import importlib
import math
import pkgutil
from dataclasses import dataclass, fields, replace
from pathlib import Path

import pytest
import yaml

import l1slam_ros.core
from l1slam_ros.core.errors import L1SlamError, OptionError
from l1slam_ros.core.online.keyframes import KeyframeOptions
from l1slam_ros.core.options import Options, dotted, flatten, option, with_values
from l1slam_ros.core.running.backend import BackendOptions
from l1slam_ros.io.node_options import NodeOptions, read_params_file

SHIPPED = Path(__file__).parents[2] / 'config' / 'backend.yaml'


@dataclass(frozen=True)
class Wheel(Options):
    radius: float = option(0.3, 'size', 'm', 0, 2)
    spokes: int = option(8, 'how many', '', 1, 99)


@dataclass(frozen=True)
class Cart(Options):
    name: str = option('cart', 'what it is called')
    drive: str = option('front', 'which axle', choices=('front', 'rear'))
    lights: bool = option(True, 'whether it has any', fixed=True)
    front: Wheel = Wheel()
    rear: Wheel = Wheel(radius=0.5)


@pytest.mark.parametrize('values', [
    {'radius': 0.0}, {'radius': 2.0}, {'spokes': 1}, {'spokes': 99}, {'radius': 5e-324}])
def test_the_ends_of_a_range_are_in_it(values):
    assert all(getattr(Wheel(**values), name) == value for name, value in values.items())


@pytest.mark.parametrize('radius', [0, 1, 2])
def test_an_int_will_do_for_a_float(radius):
    wheel = Wheel(radius=radius)
    assert wheel.radius == radius and type(wheel.radius) is float


@pytest.mark.parametrize('kind, values, said', [
    (Wheel, {'radius': -0.1}, 'radius is -0.1, expected 0 to 2'),
    (Wheel, {'radius': 2.1}, 'radius is 2.1, expected 0 to 2'),
    (Wheel, {'radius': 3}, 'radius is 3.0, expected 0 to 2'),
    (Wheel, {'radius': math.nan}, 'radius is nan, expected 0 to 2'),
    (Wheel, {'radius': math.inf}, 'radius is inf, expected 0 to 2'),
    (Wheel, {'radius': '1'}, "radius is '1', expected a value of type float"),
    (Wheel, {'radius': True}, 'radius is True, expected a value of type float'),
    (Wheel, {'radius': None}, 'radius is None, expected a value of type float'),
    (Wheel, {'spokes': 0}, 'spokes is 0, expected 1 to 99'),
    (Wheel, {'spokes': 8.0}, 'spokes is 8.0, expected a value of type int'),
    (Wheel, {'spokes': False}, 'spokes is False, expected a value of type int'),
    (Cart, {'lights': 1}, 'lights is 1, expected a value of type bool'),
    (Cart, {'name': 5}, 'name is 5, expected a value of type str'),
    (Cart, {'drive': 'both'}, "drive is 'both', expected one of front, rear"),
    (Cart, {'drive': ''}, "drive is '', expected one of front, rear"),
])
def test_a_value_of_the_wrong_type_or_size_is_refused(kind, values, said):
    with pytest.raises(OptionError) as caught:
        kind(**values)
    assert str(caught.value) == said
    assert isinstance(caught.value, L1SlamError)


def test_options_flatten_to_dotted_names():
    flat = flatten(Cart())
    assert {name: value for name, (value, _) in flat.items()} == {
        'name': 'cart', 'drive': 'front', 'lights': True, 'front.radius': 0.3, 'front.spokes': 8,
        'rear.radius': 0.5, 'rear.spokes': 8}
    assert flat['rear.radius'][1].unit == 'm' and flat['rear.radius'][1].doc == 'size'
    assert flat['lights'][1].fixed and not flat['name'][1].fixed


def test_values_are_set_by_dotted_names():
    cart = Cart()
    changed = with_values(cart, {'rear.spokes': 12, 'lights': False, 'rear.radius': 1})
    assert changed == Cart(lights=False, rear=Wheel(1.0, 12))
    assert cart == Cart() and with_values(cart, {}) == cart


@pytest.mark.parametrize('values, said', [
    ({'wings': 2}, 'no option is called wings'),
    ({'front': 2}, 'no option is called front'),
    ({'front.wings': 2}, 'no option is called front.wings'),
    ({'name.first': 'a'}, 'no option is called name.first'),
    ({'radius': 1.0}, 'no option is called radius'),
    ({'front.spokes': 0}, 'front.spokes is 0, expected 1 to 99'),
    ({'rear.radius': 'x'}, "rear.radius is 'x', expected a value of type float"),
])
def test_a_bad_name_or_value_is_named_in_full(values, said):
    with pytest.raises(OptionError) as caught:
        with_values(Cart(), values)
    assert str(caught.value) == said


@pytest.mark.parametrize('values', [
    {'name': 'other', 'rear': {'spokes': 12, 'radius': 1}},
    {'name': 'other', 'rear.spokes': 12, 'rear': {'radius': 1}},
    {'name': 'other', 'rear.spokes': 12, 'rear.radius': 1, 'front': {}}])
def test_a_mapping_sets_values_by_nested_or_dotted_names(values):
    assert Cart.from_mapping(values) == Cart('other', rear=Wheel(1.0, 12))
    assert type(NodeOptions.from_mapping({})) is NodeOptions


@pytest.mark.parametrize('values, said', [
    ({'front': {'wings': 2}}, 'no option is called front.wings'),
    ({'front': {'spokes': {'left': 4}}}, 'no option is called front.spokes.left'),
    ({'front': 2}, 'no option is called front'),
    ({7: 2}, 'no option is called 7'),
    ({'rear': {'radius': [1]}}, 'rear.radius is [1], expected a value of type float'),
    ({'rear': {'spokes': 3}, 'rear.spokes': 4}, 'rear.spokes is set twice, to 3 and to 4'),
    (['lights'], "options are ['lights'], expected a mapping of names to values"),
    (None, 'options are None, expected a mapping of names to values')])
def test_a_mapping_of_nonsense_is_refused(values, said):
    with pytest.raises(OptionError) as caught:
        Cart.from_mapping(values)
    assert str(caught.value) == said


# Every option of the package


def option_classes():
    for module in pkgutil.walk_packages(l1slam_ros.core.__path__, 'l1slam_ros.core.'):
        importlib.import_module(module.name)
    found, queue = [], [Options]
    while queue:
        children = queue.pop().__subclasses__()
        found += [child for child in children if child.__module__.startswith('l1slam_ros.')]
        queue += children
    return sorted(found, key=lambda kind: kind.__qualname__)


@pytest.mark.parametrize('kind', option_classes(), ids=lambda kind: kind.__name__)
def test_every_option_has_a_meaning(kind):
    assert kind.__doc__
    for name, (value, meaning) in flatten(kind()).items():
        assert len(meaning.doc) > 5, name
        if isinstance(value, float) and meaning.high is not None:
            assert meaning.unit, f'{name} has no unit; a ratio has the unit 1'
        ranged = meaning.low is not None and meaning.high is not None
        assert ranged or meaning.choices or isinstance(value, bool | str | tuple), name
        assert meaning.allows(value)
        assert not (ranged and meaning.choices)


@pytest.mark.parametrize('values, said', [
    ({'map_frame': ''}, "map_frame is '' and odom_frame 'odom', expected two different names"),
    ({'odom_frame': ''}, "map_frame is 'map' and odom_frame '', expected two different names"),
    ({'odom_frame': 'map'}, "map_frame is 'map' and odom_frame 'map', expected two different"),
    ({'robots': ('r1', 'r1')}, r"robots is \['r1', 'r1'\], expected different names"),
    ({'robots': ('a/b',)}, r"robots is \['a/b'\], expected different names"),
    ({'save_path': '/maps'}, "save_path is '/maps', expected the name of a .g2o file")])
def test_names_that_cannot_be_used_are_refused(values, said):
    with pytest.raises(OptionError, match=said):
        NodeOptions(**values)


@pytest.mark.parametrize('kind', option_classes(), ids=lambda kind: kind.__name__)
def test_every_option_refuses_nonsense(kind):
    for f in fields(kind):
        if isinstance(f.default, float):
            nonsense = [math.nan, math.inf, -math.inf, 'x', None]
        elif isinstance(f.default, bool | Options):
            continue
        elif isinstance(f.default, int):
            nonsense = [-1, 2**63, 0.5, True, 'x']
        else:
            nonsense = [3, None, *['?'] * bool(f.metadata['meaning'].choices)]
        for value in nonsense:
            with pytest.raises(OptionError, match=f.name):
                kind(**{f.name: value})


def test_the_shipped_file_equals_the_defaults():
    content = yaml.safe_load(SHIPPED.read_text())
    assert list(content) == ['/**'] and list(content['/**']) == ['ros__parameters']
    pairs = list(dotted(content['/**']['ros__parameters']))
    shipped, defaults = dict(pairs), {
        name: list(value) if isinstance(value, tuple) else value
        for name, (value, _) in flatten(NodeOptions()).items()}
    assert len(pairs) == len(shipped)
    assert shipped == defaults
    assert {name: type(value) for name, value in shipped.items()} == {
        name: type(value) for name, value in defaults.items()}


def test_a_mapping_for_the_back_end_is_what_a_parameter_file_says():
    content = yaml.safe_load(SHIPPED.read_text())['/**']['ros__parameters']
    content['keyframe']['translation'] = 2.0
    of_ros = {'use_sim_time': True, 'qos_overrides': {'/odom': {'subscription': {'depth': 5}}}}
    expected = replace(BackendOptions(), keyframe=KeyframeOptions(2.0))
    assert BackendOptions.from_mapping(content | of_ros) == expected
    with pytest.raises(OptionError, match='no option is called use_time'):
        BackendOptions.from_mapping(content | {'use_time': True})


OURS, OTHERS = '{ros__parameters: {update: {period: 1}}}', '{ros__parameters: {wheels: 4}}'
OF_ALL = '/**: {ros__parameters: {use_sim_time: true, qos_overrides./odom.subscription.depth: 5}}'


@pytest.mark.parametrize('text', [
    f'/**: {OURS}', f'renamed: {OURS}', f'/robot/backend: {OURS}', f'/robot: {{backend: {OURS}}}',
    f'{OF_ALL}\nbackend: {OURS}\nrobot: {{wheels: {OTHERS}}}', f'{OF_ALL}\nrenamed: {OURS}'])
def test_a_parameter_file_is_read_as_ros_reads_it(tmp_path, text):
    path = tmp_path / 'params.yaml'
    path.write_text(text)
    assert read_params_file(path) == NodeOptions.from_mapping({'update.period': 1})


def test_the_shipped_file_says_what_each_option_means():
    comments = ' '.join(line.strip(' #') for line in SHIPPED.read_text().splitlines()
                        if line.lstrip().startswith('#'))
    for name, (_, meaning) in flatten(NodeOptions()).items():
        text = meaning.doc + (f' [{meaning.unit}]' if meaning.unit else '')
        assert ' '.join(text.split()) in comments, name
