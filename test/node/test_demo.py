# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The demo: what it says is true, it ends with a sentence, and nobody beside it is disturbed."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from worlds import false_of, made

MAKEFILE = Path(__file__).parents[2] / 'Makefile'
(DEMO,) = re.findall(r'^demo: .*\n\t.*/python -m (\S+)$', MAKEFILE.read_text(), re.MULTILINE)
DEADLINE = 300.0
NOBODYS = 'rmw_of_nobody_cpp'
ODD = {
    'RMW_IMPLEMENTATION': NOBODYS, 'ROS_LOCALHOST_ONLY': '1', 'ROS_STATIC_PEERS': '192.0.2.1',
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', 'ROS_DISCOVERY_SERVER': '127.0.0.1:11811',
    'ROS_NAMESPACE': '/robot', 'FASTRTPS_DEFAULT_PROFILES_FILE': '/no/such.xml',
    'RCUTILS_LOGGING_USE_STDOUT': '1', 'RCUTILS_CONSOLE_OUTPUT_FORMAT': '{message}',
}
STAND_IN = ('import rclpy; rclpy.init(); node = rclpy.create_node("backend"); '
            'print("here", flush=True); input()')


def begin(folder):
    return subprocess.Popen(
        [sys.executable, '-m', DEMO], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, **ODD})


def backend_of(demo):
    """Return the number of the process of a demo that is its back end, or None."""
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            parent = int((entry / 'stat').read_text().rsplit(')', 1)[1].split()[1])
            if parent == demo.pid and b'backend' in (entry / 'cmdline').read_bytes():
                return int(entry.name)
        except OSError:
            continue
    return None


@pytest.fixture(scope='module')
def demos(tmp_path_factory):
    """Return the ends of three demos at once, in a shell of odd words, beside another node."""
    folders = [tmp_path_factory.mktemp(name) for name in ('right', 'doctored', 'killed')]
    (folders[0] / 'bags').mkdir()
    # Each of these false loops is more than 3 m off: none may be right by what scans show.
    made(folders[0] / 'bags' / 'demo', 80, 120, '--false-loops', 4, '--scans', '--seed', 7)
    for folder in folders[1:]:
        shutil.copytree(folders[0] / 'bags', folder / 'bags')
    # One of the false loops is called a true one.
    false = folders[1] / 'bags' / 'demo.false.txt'
    false.write_text('\n'.join(false.read_text().splitlines()[:-1]) + '\n')
    assert len(false_of(folders[1] / 'bags' / 'demo')) == 3
    other = subprocess.Popen([sys.executable, '-c', STAND_IN], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, text=True)
    begun = [begin(folder) for folder in folders]
    try:
        assert other.stdout.readline() == 'here\n'
        first = begun[2].stdout.readline() + begun[2].stdout.readline()
        os.kill(backend_of(begun[2]), 9)
        said = [one.communicate(timeout=DEADLINE) for one in begun]
    finally:
        for one in (other, *begun):
            one.kill()
            one.communicate()
    said[2] = first + said[2][0], said[2][1]
    return [(folder, one.returncode, *texts)
            for folder, one, texts in zip(folders, begun, said, strict=True)]


def test_the_demo_tells_the_errors_and_what_became_of_the_loops(demos):
    folder, code, out, err = demos[0]
    by_odometry, in_map = map(float, re.findall(
        r'^position error  ([\d.]+) m by odometry, ([\d.]+) m in the map', out, re.MULTILINE)[0])
    assert in_map < 0.05 < by_odometry
    assert '80 keyframes, 45 loops, 4 of them false' in out
    assert 'refused         4 false loops, 0 true ones' in out
    found, left = map(int, re.findall(r'^from the scans  (\d+) more loops, (\d+) of', out,
                                      re.MULTILINE)[0])
    assert found > 20 and left <= 0.05 * found
    # It fails unless it leaves out hardly any true loop.
    assert (code == 0) == ('left out' not in out), err
    assert (folder / 'demo' / 'map.png').read_bytes().startswith(b'\x89PNG')
    (line,) = (line for line in err.splitlines() if NOBODYS in line and 'demo: ' in line)
    assert line.endswith('is used instead')


def test_the_demo_fails_where_a_true_loop_is_refused(demos):
    _, code, out, err = demos[1]
    assert code == 1 and '3 false loops, 1 true ones' in out
    assert err.splitlines()[-1] == (
        'demo: 3 false loops are refused and 1 true ones, expected all 3 false ones and no true '
        'one')


def test_the_demo_ends_with_a_sentence_when_the_node_has_died(demos):
    _, code, _, err = demos[2]
    assert code == 1
    assert re.match(r'demo: backend ended with exit code -9; \d+ of 80 scans used, \d+ of 80 key',
                    err.splitlines()[-1])


def test_each_demo_is_in_a_domain_where_nobody_else_is(demos):
    numbers = {re.search(r'^demo: in ROS domain (\d+), ', out, re.MULTILINE)[1]
               for _, _, out, _ in demos}
    assert len(numbers | {os.environ['ROS_DOMAIN_ID']}) == 4


def test_without_its_bag_the_demo_is_one_line(tmp_path):
    demo = begin(tmp_path)
    _, err = demo.communicate(timeout=DEADLINE)
    *_, line = err.splitlines()
    assert demo.returncode == 1 and line.startswith('demo: bags/demo: no such file')
