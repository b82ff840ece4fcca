# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The executables: their help, arguments, parameters and middleware, and the tests' own shell."""

import importlib.util
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from test_demo import NOBODYS, ODD
from test_introspection import ELSEWHERE, INPUTS, OUTPUTS, SERVICES

pytest.importorskip('rclpy')

from node_bench import DEADLINE, executable


def run(*command, **variables):
    return subprocess.run([str(part) for part in command], capture_output=True, text=True,
                          timeout=DEADLINE, env={**os.environ, **variables})


def test_a_middleware_that_is_not_there_is_said_and_another_used(start, tmp_path):
    process = start(RMW_IMPLEMENTATION=NOBODYS)
    sentence = rf'RMW_IMPLEMENTATION is {NOBODYS}, which cannot be loaded here; rmw_\w+ is used '
    assert re.match(f'backend: {sentence}', process.stderr.readline())
    assert 'ready' in process.stderr.readline()
    played = run(executable('replay'), tmp_path / 'no', RMW_IMPLEMENTATION=NOBODYS)
    assert played.returncode == 2 and 'no such file' in played.stderr.splitlines()[1]
    assert re.match(f'replay: {sentence}', played.stderr)


def test_the_tests_work_in_an_odd_shell():
    """Two that talk to a node, and read what it says."""
    tests = Path(__file__).with_name('test_node_inputs.py')
    ran = run(sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', tests, '-k',
              'two_publishers or is_not_odom_frame', **ODD, ROS_DOMAIN_ID='7')
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert '2 passed' in ran.stdout


def test_the_help_of_backend_lists_all_and_starts_nothing():
    helped = run(executable('backend'), '--help', '--ros-args', '-p', 'dimension:=7')
    assert helped.returncode == 0 and not helped.stderr
    text = helped.stdout
    of_type = dict(re.findall(r'^  ([~/\w]+) \((.+)\)$', text, re.MULTILINE))
    of_type = {name.replace('~', '/backend') if name[0] in '~/' else f'/{name}': kind
               for name, kind in of_type.items()}
    before = ''
    for name, kind in of_type.items():
        of_type[name] = before = before if kind == 'the same' else kind
    for name, kind in {**INPUTS, **OUTPUTS, **SERVICES}.items():
        assert of_type.pop(name) == kind.replace('/msg/', '/').replace('/srv/', '/')
    assert of_type.keys() == ELSEWHERE
    # Words, numbers, truth and lists as they are written.
    for shown in ("map_frame: 'map'", 'keyframe.translation: 0.5', 'dimension: 2',
                  'publish_tf: true', "robots: ['']"):
        assert f'\n  {shown}\n' in text
    assert '[rad/rad]' in text


def test_the_help_of_the_others_lists_what_they_take():
    helped = run(executable('replay'), '--help')
    assert helped.returncode == 0 and '--ros-args' in helped.stdout and '--rate' in helped.stdout
    helped = run(executable('scan_loops'), '--help')
    assert helped.returncode == 0 and not helped.stderr
    for word in ('scan (sensor_msgs/LaserScan)', 'scan_odom', '~/save_map', 'laser_pose',
                 'map (nav_msgs/OccupancyGrid)', 'map_resolution: 0.05', 'covariance'):
        assert word in helped.stdout


@pytest.mark.parametrize('name, arguments, named', [
    ('backend', ['map.g2o'], 'map.g2o'),
    ('backend', ['--ros-args', '-r', 'odom:=o', '--', '--verbose'], '--verbose'),
    ('backend', ['--ros-args', '--frobnicate'], '--frobnicate'),
    ('scan_loops', ['--loops'], "'--loops' is not an argument of scan_loops")])
def test_an_argument_that_a_node_does_not_know_ends_it(name, arguments, named):
    ran = run(executable(name), *arguments)
    assert ran.returncode == 2 and not ran.stdout
    (line,) = ran.stderr.splitlines()
    assert line.startswith(f'{name}: ') and named in line


@pytest.mark.parametrize('arguments, words', [
    (('-p', 'keyframe.translation:=-1.0'), 'keyframe.translation'),
    (('--params-file', '/no/such.yaml'), '/no/such.yaml'),
    (('-p', 'qos_overrides./odom.subscription.reliability:=best'), 'odom cannot be subscribed')])
def test_what_is_refused_at_start_is_one_line_and_exit_code_1(arguments, words):
    ran = run(executable('backend'), '--ros-args', *arguments)
    assert ran.returncode == 1 and 'Traceback' not in ran.stderr
    last = ran.stderr.splitlines()[-1]
    assert last.startswith('backend: ') and words in last


@pytest.mark.parametrize('name, publishes', [('backend', False), ('scan_loops', True)])
def test_a_node_that_cannot_publish_on_tf_warns_once_at_start(name, publishes):
    process = subprocess.Popen([executable(name), '--ros-args', '-p', f'publish_tf:={publishes}'],
                               stderr=subprocess.PIPE, text=True)
    patience = threading.Timer(DEADLINE, process.kill)
    patience.start()
    try:
        assert any('ready' in line for line in process.stderr)
        if publishes and importlib.util.find_spec('tf2_msgs') is None:
            said = process.stderr.readline()
            assert 'WARN' in said and 'tf2_msgs is not installed' in said
        process.terminate()
        assert 'tf2_msgs' not in process.communicate()[1] and process.returncode == 0
    finally:
        patience.cancel()
        process.kill()
