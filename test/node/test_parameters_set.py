# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node that are set while it runs, and lists that are empty."""

import re
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from node_bench import call, parameters_of
from node_bench import set_parameter as put
from rcl_interfaces.srv import DescribeParameters, ListParameters


def test_a_shorter_period_of_the_updates_holds_at_once(bench):
    b = bench(**{'update.period': 3600.0})
    b.drive(0, 3)
    b.until(lambda: b.received['pose'], 'odometry is used')
    assert not put(b, 'update.period', 0.05)
    b.until(lambda: len(b.path().poses) == 3, 'the map is updated')
    b.drive(3, 6)
    b.until(lambda: len(b.path().poses) == 6, 'it is updated again')


def test_a_shorter_period_of_the_transform_holds_from_the_next_odometry_on(bench):
    b = bench(transform_period=3600.0)
    b.drive(0, 1)
    b.until(lambda: b.received['map_to_odom'], 'the transform is published')
    assert not put(b, 'transform_period', 0.05)
    b.drive(1, 2)
    count = len(b.received['map_to_odom'])
    b.until(lambda: len(b.received['map_to_odom']) > count + 4, 'it is published again and again')


@pytest.mark.parametrize('name, value', [
    ('update.period', 0.0), ('update.period', float('nan')), ('transform_period', -1.0)])
def test_a_period_that_is_none_is_refused(bench, name, value):
    reason = put(bench(), name, value)
    assert name in reason and str(value) in reason


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
    b.until(lambda: len(b.path().poses) == 2, 'a single robot has its map')
