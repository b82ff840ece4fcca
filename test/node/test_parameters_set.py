# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node: nonsense, those set while it runs, and lists that are empty."""

import re
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from node_bench import Bench, call, parameters_of
from node_bench import set_parameter as put
from rcl_interfaces.srv import DescribeParameters, ListParameters

import l1slam_ros as l1


def test_a_shorter_period_of_updates_holds_at_once_and_of_transforms_from_then_on(bench):
    b = bench(**{'update.period': 3600.0, 'transform_period': 3600.0})
    b.drive(0, 3)
    b.until(lambda: b.received['pose'] and b.received['map_to_odom'], 'odometry is used')
    assert not put(b, 'update.period', 0.05) and not put(b, 'transform_period', 0.05)
    b.map_of(3)
    b.drive(3, 6)
    b.map_of(6)
    count = len(b.received['map_to_odom'])
    b.until(lambda: len(b.received['map_to_odom']) > count + 4, 'it is published again and again')


def test_nonsense_is_refused_at_start_and_on_set(ros, bench):
    with pytest.raises(l1.L1SlamError, match=r'keyframe\.translation'):
        Bench(ros, {'keyframe.translation': -1.0})
    b = bench(**{'keyframe.rotation': 1})
    assert parameters_of(b, 'keyframe.rotation') == [1.0]
    for name, value in (('update.period', 0.0), ('update.period', float('nan')),
                        ('transform_period', -1.0), ('keyframe.translation', float('nan'))):
        reason = put(b, name, value)
        assert name in reason and str(value) in reason
    assert put(b, 'map_frame', 'world')
    assert not put(b, 'update.budget', 0.05)
    assert parameters_of(b, 'update.budget', 'map_frame') == [0.05, 'map']


def test_what_is_read_at_start_only_is_refused_by_its_name(bench):
    b = bench()
    names = call(b, 'list_parameters', kind=ListParameters).result.names
    told = call(b, 'describe_parameters', DescribeParameters.Request(names=names),
                DescribeParameters).descriptors
    # What ROS declares is no matter of the page.
    fixed = [one.name for one in told if one.read_only and not one.name.startswith('qos_overrides')
             and one.name != 'start_type_description_service']
    page = (Path(__file__).parents[2] / 'doc' / 'topics_and_parameters.md').read_text()
    (named,) = re.findall('Read at start only are (.*?):', page, re.DOTALL)
    assert re.findall('`(.*?)`', named) == sorted(fixed)
    for name, value in zip(fixed, parameters_of(b, *fixed), strict=True):
        assert put(b, name, value) == f'Trying to set a read-only parameter: {name}.'


def test_an_empty_list_of_robots_is_the_default(bench):
    """To ROS it has no type: it comes as no value at all."""
    b = bench(robots=[])
    b.drive(0, 2)
    b.map_of(2)
