# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What bloom asks of a released package, and that it is whole without what no package brings."""

import json
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path
from xml.etree import ElementTree

import pytest
from environments import own_variables
from hidden import without
from rosdep_keys import OF_JAZZY, OF_ROSDEP
from worlds import made

ROOT = Path(__file__).parents[1]
DEMO = ROOT / 'bags' / 'demo'
BESIDE = Path(sysconfig.get_path('scripts'))
PATIENCE = 300  # [s]
# What no package of Ubuntu brings, or what not every command needs.
OPTIONAL = ('rosbags', 'mcap', 'lz4', 'zstandard', 'matplotlib', 'tqdm', 'argcomplete')


def ran(command, cwd, hidden):
    """Run an executable without some libraries."""
    name, *arguments = command
    return subprocess.run([BESIDE / name, *map(str, arguments)], cwd=cwd, capture_output=True,
                          text=True, timeout=PATIENCE, env=without(cwd, *hidden))


def test_every_key_is_one_that_a_released_package_may_use():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    keys = [element.text for element in manifest if element.tag.endswith('depend')]
    assert len(keys) == len(set(keys)) > 10
    assert set(keys) <= OF_ROSDEP.keys() | OF_JAZZY.keys()
    # The other way round: nothing is used of ROS that a released package would not bring.
    used = {name for path in (ROOT / 'l1slam_ros').rglob('*.py')
            for name in re.findall(r'^\s*(?:from|import) (\w+)', path.read_text(), re.M)}
    assert used & OF_JAZZY.keys() <= set(keys)
    assert not {'python3-rosbags-pip', 'mcap-ros2-support'} & set(keys)


# The linters of ROS, and what they are run with. A docstring may begin with a sentence that is
# no command (D401), and says of those arguments alone something that need it (D417).
OURS = ('l1slam_ros', 'config', 'launch', 'setup.py', 'build_backend.py')
LINTERS = {
    'ament_copyright': ('l1slam_ros', 'test', 'config', 'benchmarks', 'doc', 'launch',
                        'setup.py', 'build_backend.py'),
    'ament_xmllint': ('package.xml',),
    'ament_flake8': ('--config', 'test/ament_flake8.ini', *OURS),
    'ament_pep257': ('--add-ignore', 'D401', 'D417', '--', *OURS),
}


@pytest.mark.parametrize('linter', LINTERS)
def test_a_linter_of_ros_finds_nothing(linter):
    """That of the system, of which Debian and Ubuntu have all four; ruff has the same rules."""
    if shutil.which(linter) is None:
        pytest.skip(f'not installed: apt install python3-{linter.replace("_", "-")}')
    done = subprocess.run([linter, *LINTERS[linter]], cwd=ROOT, capture_output=True, text=True,
                          env=own_variables(), timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_graph_is_solved_where_nothing_optional_is(tmp_path):
    world = made(tmp_path / 'world.g2o', 60, 100)
    done = ran(('l1slam', 'solve', world, '--output', 'solved.g2o', '--json'), tmp_path, OPTIONAL)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['status'] == 'converged'
    assert (tmp_path / 'solved.g2o').exists()


@pytest.mark.parametrize('hidden, told, command', [
    ('rosbags', 'pip install rosbags mcap', ('l1slam', 'info', DEMO)),
    ('mcap', 'pip install rosbags mcap', ('l1slam', 'convert', 'world.g2o', 'bag')),
    ('zstandard', 'pip install rosbags mcap', ('l1slam', 'solve', DEMO)),
    ('rosbags', 'pip install rosbags mcap',
     ('l1slam', 'solve', 'world.g2o', '--reference', f'{DEMO}:/ground_truth')),
    ('matplotlib', 'python3-matplotlib', ('l1slam', 'solve', 'world.g2o', '--plot', 'map.png')),
    ('rosbags', 'pip install rosbags mcap', ('replay', DEMO))],
    ids=lambda value: value[1] if isinstance(value, tuple) else value)
def test_a_command_that_needs_what_is_not_there_names_it_in_one_line(
        tmp_path, hidden, told, command):
    if command[0] == 'replay':
        pytest.importorskip('rclpy')
    made(tmp_path / 'world.g2o', 60, 100)
    before = {path.name for path in tmp_path.iterdir()}
    done = ran(command, tmp_path, [hidden])
    assert (done.returncode, done.stdout) == (2, ''), done.stderr
    assert re.fullmatch(rf'{command[0]}: {hidden} is not installed: .*\n', done.stderr)
    assert told in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == before | {f'without_{hidden}'}


def test_the_node_starts_where_nothing_optional_is(start, tmp_path):
    pytest.importorskip('rclpy')
    assert 'ready' in start(**without(tmp_path, *OPTIONAL)).stderr.readline()
