# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The parameters of `scan_loops`, and those of `backend` beside it."""

import re
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy')

from node_bench import BackendNode, ScanLoopsNode
from rclpy.parameter import Parameter

import l1slam_ros as l1

SHIPPED = Path(__file__).parents[2] / 'config' / 'scan_loops.yaml'


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


@pytest.mark.parametrize('values, said', [
    ({'laser_pose': '1, 2'}, 'expected x, y, yaw'), ({'laser_pose': 'ahead'}, 'expected x, y'),
    ({'laser_pose': '0 0 0 1.57'}, 'roll of 1.57'), ({'map_path': '/maps/a.png'}, 'a .pgm file'),
    ({'odom_frame': ''}, 'odom_frame is empty')])
def test_nonsense_is_refused(ros, values, said):
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    with pytest.raises(l1.L1SlamError, match=said):
        ScanLoopsNode(parameter_overrides=overrides)


def test_the_shipped_file_equals_the_defaults_and_suits_the_back_end(started):
    content = yaml.safe_load(SHIPPED.read_text())
    shipped = dotted(content['/**/scan_loops']['ros__parameters'])
    front_end, plain = started(ScanLoopsNode), started(BackendNode)
    backend = started(BackendNode, '--ros-args', '--params-file', str(SHIPPED))
    assert shipped == {name: front_end.get_parameter(name).value for name in shipped}
    of_ros = 'qos_overrides.', 'use_sim_time', 'start_type_description'
    assert shipped.keys() == {name for name in front_end.get_parameters_by_prefix('')
                              if not name.startswith(of_ros)}
    same = 'keyframe.translation', 'keyframe.rotation', 'keyframe.period', 'odom_frame'

    def values(node):
        return [node.get_parameter(name).value for name in same]

    assert backend.get_parameter('odometry.covariance_source').value == 'increment'
    assert values(backend) == values(front_end) and values(plain)[-1] != values(backend)[-1]
    comments = ' '.join(line.strip(' #') for line in SHIPPED.read_text().splitlines()
                        if line.lstrip().startswith('#'))
    for name in shipped:
        meaning = re.sub(r' \[[^\]]*\]$', '', front_end.describe_parameter(name).description)
        assert meaning and ' '.join(meaning.split()) in comments, name
