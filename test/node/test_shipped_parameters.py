# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The parameter files that are shipped: defaults of both nodes, what they mean, and nonsense."""

import re

import pytest
import yaml

pytest.importorskip('rclpy')

from node_bench import SHIPPED, BackendNode, ScanLoopsNode
from rclpy.parameter import Parameter

import l1slam_ros as l1


@pytest.fixture
def started(ros):
    """Return what starts a node, with arguments; it is closed after the test."""
    nodes = []

    def start(kind, *arguments):
        nodes.append(kind(cli_args=[*arguments]))
        return nodes[-1]

    yield start
    for node in nodes:
        node.close()


def dotted(values, prefix=''):
    """Return nested values by names with dots."""
    found = {}
    for name, value in values.items():
        inner = isinstance(value, dict)
        found |= dotted(value, f'{prefix}{name}.') if inner else {prefix + name: value}
    return found


@pytest.mark.parametrize('kind, file, key', [
    (BackendNode, 'backend.yaml', '/**'), (ScanLoopsNode, 'scan_loops.yaml', '/**/scan_loops')])
def test_a_shipped_file_has_the_defaults_and_says_what_each_means(started, kind, file, key):
    text, node = SHIPPED.with_name(file).read_text(), started(kind)
    shipped = dotted(yaml.safe_load(text)[key]['ros__parameters'])
    of_ros = 'qos_overrides.', 'use_sim_time', 'start_type_description'
    names = [name for name in node.get_parameters_by_prefix('') if not name.startswith(of_ros)]
    values = {name: node.get_parameter(name).value for name in names}
    assert shipped == values
    assert [*map(type, shipped.values())] == [type(values[name]) for name in shipped]
    comments = ' '.join(line.strip(' #') for line in text.splitlines()
                        if line.lstrip().startswith('#'))
    for name, value in values.items():
        described = node.describe_parameter(name)
        meaning = re.sub(r' \[[^\]]*\]$', '', described.description)
        assert len(meaning) > 5 and ' '.join(meaning.split()) in comments, name
        assert len(described.floating_point_range) == isinstance(value, float), name
        assert len(described.integer_range) == (type(value) is int), name


def test_the_file_of_the_scan_front_end_suits_the_back_end(started):
    front_end, plain = started(ScanLoopsNode), started(BackendNode)
    backend = started(BackendNode, '--ros-args', '--params-file', str(SHIPPED))
    same = 'keyframe.translation', 'keyframe.rotation', 'keyframe.period', 'odom_frame'

    def values(node):
        return [node.get_parameter(name).value for name in same]

    assert backend.get_parameter('odometry.covariance_source').value == 'increment'
    assert values(backend) == values(front_end) and values(plain)[-1] != values(backend)[-1]


@pytest.mark.parametrize('values, said', [
    ({'laser_pose': '1, 2'}, 'expected x, y, yaw'), ({'laser_pose': 'ahead'}, 'expected x, y'),
    ({'laser_pose': '0 0 0 1.57'}, 'roll of 1.57'), ({'map_path': '/maps/a.png'}, 'a .pgm file'),
    ({'odom_frame': ''}, 'odom_frame is empty')])
def test_nonsense_is_refused_by_the_scan_front_end(ros, values, said):
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    with pytest.raises(l1.L1SlamError, match=said):
        ScanLoopsNode(parameter_overrides=overrides)
