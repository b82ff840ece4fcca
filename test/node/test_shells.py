# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Shells that say other things than most: the executables, the demo and the tests work in them."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_introspection import INPUTS, OUTPUTS, PARAMETERS, SERVICES

rclpy = pytest.importorskip('rclpy')

from node_bench import executable

ROOT = Path(__file__).parents[2]
DEADLINE = 300.0  # [s] the solver can have to be compiled first
NOBODYS = 'rmw_of_nobody_cpp'
# What each of these says would stop a demo, or tests, that take it as it is.
ODD = {
    'RMW_IMPLEMENTATION': NOBODYS, 'ROS_LOCALHOST_ONLY': '1', 'ROS_STATIC_PEERS': '192.0.2.1',
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', 'ROS_DISCOVERY_SERVER': '127.0.0.1:11811',
    'ROS_NAMESPACE': '/robot', 'FASTRTPS_DEFAULT_PROFILES_FILE': '/no/such.xml',
    'RCUTILS_LOGGING_USE_STDOUT': '1', 'RCUTILS_CONSOLE_OUTPUT_FORMAT': '{message}',
}
STAND_IN = ('import os, rclpy; rclpy.init(); node = rclpy.create_node("other"); '
            'print("here", flush=True); input()')


def run(*command, cwd=ROOT, **variables):
    return subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True,
                          text=True, timeout=DEADLINE, env={**os.environ, **variables})


@pytest.fixture
def python():
    """Return what starts some lines of Python and returns the first line they print."""
    processes = []

    def begin(code, **variables):
        processes.append(subprocess.Popen(
            [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True, env={**os.environ, **variables}))
        return processes[-1], processes[-1].stdout.readline().strip()

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def test_a_middleware_that_is_not_there_is_said_and_another_used(start, tmp_path):
    process = start(RMW_IMPLEMENTATION=NOBODYS)
    sentence = rf'RMW_IMPLEMENTATION is {NOBODYS}, which cannot be loaded here; rmw_\w+ is used '
    assert re.match(f'backend: {sentence}', process.stderr.readline())
    assert 'ready' in process.stderr.readline()
    played = run(executable('replay'), tmp_path / 'no', RMW_IMPLEMENTATION=NOBODYS)
    assert played.returncode == 2 and 'no such file' in played.stderr.splitlines()[1]
    assert re.match(f'replay: {sentence}', played.stderr)


def test_a_middleware_that_is_there_is_used_without_a_word(start):
    named = rclpy.get_rmw_implementation_identifier()
    assert 'ready' in start(RMW_IMPLEMENTATION=named).stderr.readline()


def test_the_demo_works_in_an_odd_shell_beside_another_node(python, tmp_path):
    """That of another domain would be heard, and counted."""
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    other = {'ROS_DOMAIN_ID': os.environ['ROS_DOMAIN_ID']}
    python(STAND_IN.replace('other', 'backend'), **other)
    # With nothing compiled, as on a new machine, it ends as `.ci/run` wants it, however busy the
    # machine is: all scans have come before there is a map, on which the loops from scans depend.
    shown = run(sys.executable, '-m', 'l1slam_ros.ros.executables', cwd=tmp_path,
                **{**ODD, 'NUMBA_CACHE_DIR': str(tmp_path / 'compiled')})
    assert shown.returncode == 0, shown.stderr
    (line,) = (line for line in shown.stderr.splitlines() if NOBODYS in line)
    assert line.startswith('demo: ') and line.endswith('is used instead')
    (number,) = re.findall(r'^demo: in ROS domain (\d+), ', shown.stdout, re.MULTILINE)
    assert number != other['ROS_DOMAIN_ID'] and '10 false loops, 0 true ones' in shown.stdout
    assert (tmp_path / 'demo' / 'map.png').exists()


def test_the_tests_work_in_an_odd_shell():
    """Two that read what processes say, and talk to them."""
    tests = ROOT / 'test' / 'node' / 'test_processes.py'
    ran = run(sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', tests, '-k',
              'a_map_comes_out or loses_neither', **ODD, ROS_DOMAIN_ID='7')
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert '2 passed' in ran.stdout and f'{NOBODYS}, which cannot be loaded here' in ran.stdout


@pytest.mark.parametrize('ask', ['--help', '-h'])
def test_the_help_of_backend_lists_all_and_starts_nothing(ask):
    began = time.monotonic()
    helped = run(executable('backend'), ask, '--ros-args', '-p', 'dimension:=7')
    assert helped.returncode == 0 and not helped.stderr and time.monotonic() - began < 30
    text = helped.stdout
    of_type = dict(re.findall(r'^  ([~/\w]+) \((.+)\)$', text, re.MULTILINE))
    of_type = {name.replace('~', '/backend') if name[0] in '~/' else f'/{name}': kind
               for name, kind in of_type.items()}
    before = ''
    for name, kind in of_type.items():
        of_type[name] = before = before if kind == 'the same' else kind
    for name, kind in {**INPUTS, **OUTPUTS, **SERVICES}.items():
        assert of_type.pop(name) == kind.replace('/msg/', '/').replace('/srv/', '/')
    assert of_type.keys() == {
        '/map_graph', '/pose_graph', '/slam_toolbox/pose_graph', '/slam_toolbox/new_node_event',
        '/cslam/keyframe_odom', '/cslam/intra_robot_loop_closure',
        '/cslam/inter_robot_loop_closure', '/tf'}
    for name, (default, unit, _) in PARAMETERS.items():
        shown = str(default).lower() if isinstance(default, bool) else repr(default)
        assert f'\n  {name}: {shown}\n' in text and (f'[{unit}]' in text or not unit)
    assert "\n  robots: ['']\n" in text  # a list as it is written
    assert max(map(len, text.splitlines())) <= 99


def test_half_of_the_help_is_enough_for_who_wants_no_more():
    shown = subprocess.run(['sh', '-c', '"$0" --help | head -n 1', executable('backend')],
                           capture_output=True, text=True, timeout=DEADLINE)
    assert shown.stdout.startswith('usage: backend') and not shown.stderr


@pytest.mark.parametrize('arguments, named', [
    (['--frobnicate'], '--frobnicate'), (['map.g2o'], 'map.g2o'), (['__node:=x'], '__node:=x'),
    (['--ros-args', '-r', 'odom:=o', '--', '--verbose'], '--verbose'),
    (['--ros-args', '--frobnicate'], '--frobnicate')])
def test_an_argument_that_backend_does_not_know_ends_it(arguments, named):
    run_once = run(executable('backend'), *arguments)
    assert run_once.returncode == 2 and not run_once.stdout
    (line,) = run_once.stderr.splitlines()
    assert line.startswith('backend: ') and named in line


def test_replay_helps_and_refuses_what_it_does_not_know():
    helped = run(executable('replay'), '--help')
    assert helped.returncode == 0 and '--ros-args' in helped.stdout and '--rate' in helped.stdout
    assert run(executable('replay'), 'bag', '--frobnicate').returncode == 2
