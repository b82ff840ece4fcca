# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The parameter file that is shipped: the defaults of the node, and what each of them means."""

from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy')

from node_bench import call, parameters_of
from rcl_interfaces.srv import DescribeParameters, ListParameters

SHIPPED = Path(__file__).parents[2] / 'config' / 'backend.yaml'


def dotted(values, prefix=''):
    """Yield dotted name and value of everything in nested mappings."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from dotted(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def test_the_shipped_file_equals_the_defaults_and_says_what_each_means(bench):
    text = SHIPPED.read_text()
    shipped = dict(dotted(yaml.safe_load(text)['/**']['ros__parameters']))
    b, of_ros = bench(), ('qos_overrides.', 'use_sim_time', 'start_type_description')
    names = [name for name in call(b, 'list_parameters', kind=ListParameters).result.names
             if not name.startswith(of_ros)]
    values = dict(zip(names, parameters_of(b, *names), strict=True))
    assert shipped == values
    assert {name: type(value) for name, value in shipped.items()} == {
        name: type(value) for name, value in values.items()}
    comments = ' '.join(line.strip(' #') for line in text.splitlines()
                        if line.lstrip().startswith('#'))
    told = call(b, 'describe_parameters', DescribeParameters.Request(names=names),
                DescribeParameters).descriptors
    for one in told:
        meaning = ' '.join(one.description.split())
        assert len(meaning) > 5 and meaning in comments, one.name
