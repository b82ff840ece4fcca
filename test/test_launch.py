# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The launch files: their arguments, and what they start where `launch` is installed."""

import ast
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
# In place of what is started: writes down its arguments, one a line, and ends.
RECORDER = '#!/bin/sh\nprintf "%s\\n" "$@" > "$0.started"\n'


@pytest.mark.parametrize('file', FILES, ids=lambda file: file.name)
def test_each_argument_has_a_default_and_is_documented(file):
    """Also where `launch_ros` is not installed, and what is below is skipped."""
    page = (ROOT / 'doc' / 'topics_and_parameters.md').read_text()
    calls = [node for node in ast.walk(ast.parse(file.read_text()))
             if getattr(node, 'func', None) and ast.unparse(node.func) == 'DeclareLaunchArgument']
    assert calls
    for call in calls:
        assert {word.arg for word in call.keywords} >= {'default_value', 'description'}
        assert f'| `{call.args[0].value}` |' in page


@pytest.fixture
def launched(tmp_path, monkeypatch):
    """Return what launches a file and returns what it has started: executable -> arguments."""
    pytest.importorskip('launch_ros', reason='no launch_ros: it comes with ROS, not from PyPI')
    from launch import LaunchService
    from launch.actions import IncludeLaunchDescription
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    for package, names in ('l1slam_ros', ('backend', 'scan_loops')), ('rviz2', ('rviz2',)):
        (index / package).touch()
        (tmp_path / 'share' / package).mkdir()
        (tmp_path / 'lib' / package).mkdir(parents=True)
        for name in names:
            (tmp_path / 'lib' / package / name).write_text(RECORDER)
            (tmp_path / 'lib' / package / name).chmod(0o755)
    for folder in 'config', 'launch':
        (tmp_path / 'share' / 'l1slam_ros' / folder).symlink_to(ROOT / folder)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))

    def launch(name, **arguments):
        service = LaunchService()
        service.include_launch_description(IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(ROOT / 'launch' / name)),
            launch_arguments=list(arguments.items())))
        assert service.run() == 0
        return {path.stem: path.read_text().splitlines()
                for path in tmp_path.glob('lib/*/*.started')}

    return launch


def remaps(arguments):
    return {value for option, value in zip(arguments, arguments[1:], strict=False)
            if option == '-r'}


def parameters(arguments):
    """Return the first file of parameters, and what is set by those behind it."""
    first, *others = (value for option, value in zip(arguments, arguments[1:], strict=False)
                      if option == '--params-file')
    values = {}
    for other in others:
        for of_node in yaml.safe_load(Path(other).read_text()).values():
            values |= of_node['ros__parameters']
    return Path(first), values


def test_the_backend_is_started_by_its_defaults(launched):
    started = launched('backend.launch.py')
    assert started.keys() == {'backend'}
    file, values = parameters(started['backend'])
    assert file.samefile(ROOT / 'config' / 'backend.yaml') and values == {'use_sim_time': False}
    assert remaps(started['backend']) == {'__node:=backend', '__ns:=/'}


def test_the_backend_is_started_as_its_arguments_say(launched, tmp_path):
    started = launched('backend.launch.py', params_file='my.yaml', use_sim_time='True',
                       namespace='r1', map='7', rviz='true')
    assert started.keys() == {'backend', 'rviz2'}
    file, values = parameters(started['backend'])
    assert file == Path('my.yaml')
    assert values == {'use_sim_time': True, 'save_path': '7', 'load_on_start': True}
    assert '__ns:=/r1' in remaps(started['backend']) & remaps(started['rviz2'])
    assert 'use_sim_time: true' in Path(started['rviz2'][-1]).read_text()
    assert Path(started['rviz2'][1]).samefile(ROOT / 'config' / 'l1slam.rviz')


def test_behind_a_lidar_the_backend_takes_the_odometry_of_the_scans(launched):
    started = launched('lidar.launch.py', namespace='r1', use_sim_time='true', map='m.g2o')
    assert started.keys() == {'backend', 'scan_loops'}
    for arguments in started.values():
        file, values = parameters(arguments)
        assert file.samefile(ROOT / 'config' / 'scan_loops.yaml') and values['use_sim_time']
        assert '__ns:=/r1' in remaps(arguments)
    assert 'backend:odom:=scan_odom' in remaps(started['backend'])
    assert not any(rule.startswith('odom:=') for rule in remaps(started['scan_loops']))
    assert parameters(started['backend'])[1]['save_path'] == 'm.g2o'
