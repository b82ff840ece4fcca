# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is built runs: sdist and wheel by pip, on several Pythons, and colcon workspaces."""

import importlib.metadata
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import sysconfig
import zipfile
from email import message_from_bytes
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from environments import (
    environment,
    interpreter,
    lent_variables,
    new_environment,
    own_variables,
    run,
    running_backend,
)
from hidden import without
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  # [s] for a command to end
EXECUTABLES = {'backend', 'scan_loops', 'replay', 'l1slam'}
OF_ROS = ('rclpy', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs',
          'rcl_interfaces', 'sensor_msgs', 'std_msgs', 'std_srvs', 'tf2_msgs')
# EmPy comes without a wheel.
COLCON = ('colcon-bash', 'colcon-output', 'colcon-ros', 'numpy', 'setuptools<80',
          '--no-binary=empy')

# The core as it compiles soonest; how fast it is then, no test of the package asks.
QUICKLY = {'CXXFLAGS': '-O0'}

# What `l1slam` makes of one small world, run in a folder of its own.
SMOKE = """
import contextlib, importlib.util, io, json, sys
import numpy
from l1slam_ros.cli.main import main

def run(*arguments):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([*arguments]) == 0, arguments
    return printed.getvalue()

def cost(*arguments):
    return json.loads(run('solve', *arguments, '--no-robust', '--json'))['final_cost']

run('simulate', 'world.g2o', '--poses', '150', '--edges', '250', '--seed', '7')
run('convert', 'world.g2o', 'bag')
run('convert', 'bag', 'back.g2o')
odometry = ('--start', 'odometry', '--outer', '0')
with open('back.g2o') as file:
    edges = [list(map(float, line.split()[1:])) for line in file if line.startswith('EDGE')]
print(json.dumps({
    'python': '%d.%d' % sys.version_info[:2],
    'numpy': numpy.__version__,
    'ros': importlib.util.find_spec('rclpy') is not None,
    'edges': edges,
    'costs': [cost('world.g2o', *odometry), cost('bag', *odometry), cost('back.g2o', *odometry),
              cost('world.g2o', '--norm', 'l2'), cost('world.g2o', '--outer', '3')
              ],
}))
"""


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    """Return a copy of the checkout, so that nothing is left in it."""
    copy = tmp_path_factory.mktemp('source') / 'l1slam_ros'
    ignored = shutil.ignore_patterns('.*', '*.egg-info', '*.so', '__pycache__', 'build', 'install',
                                     'log', 'dist', 'demo')
    return shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)


@pytest.fixture(scope='module')
def sdist(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp('sdist')
    run(sys.executable, 'setup.py', '--quiet', 'sdist', '--dist-dir', folder, cwd=source,
        env=own_variables(PYTHONWARNINGS='ignore'))
    (file,) = folder.glob('*.tar.gz')
    return file


@pytest.fixture(scope='module')
def wheel(sdist, tmp_path_factory):
    """Build the wheel of the sdist alone, as packagers do, and open it."""
    folder = tmp_path_factory.mktemp('wheel')
    # From this version on setuptools builds wheels by itself: nothing has to be fetched.
    able = Version(importlib.metadata.version('setuptools')) >= Version('70.1')
    run(sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--wheel-dir', folder,
        *['--no-build-isolation'] * able, sdist, cwd=folder, env=own_variables(**QUICKLY))
    (file,) = folder.glob('*.whl')
    with zipfile.ZipFile(file) as archive:
        yield archive


def stem(wheel):
    """Return name-version, which the folders inside a wheel begin with."""
    return '-'.join(Path(wheel.filename).name.split('-')[:2])


@pytest.fixture(scope='module')
def metadata(wheel):
    return message_from_bytes(wheel.read(f'{stem(wheel)}.dist-info/METADATA'))


@pytest.fixture(scope='module')
def requirements(metadata):
    """Return what the wheel says that it needs without ROS."""
    needed = [Requirement(text) for text in metadata.get_all('Requires-Dist')]
    return [str(requirement) for requirement in needed if requirement.marker is None]


def test_package_xml_and_setup_py_say_and_need_the_same(metadata, requirements):
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    maintainer = manifest.find('maintainer')
    assert manifest.findtext('name') == metadata['Name'].replace('-', '_')
    assert manifest.findtext('version') == metadata['Version']
    assert manifest.findtext('description') == metadata['Summary']
    assert manifest.findtext('license') in (metadata['License'], metadata['License-Expression'])
    assert (maintainer.text, maintainer.get('email')) == (
        metadata['Maintainer'], metadata['Maintainer-email'])
    keys = {element.text for kind in ('depend', 'exec_depend')
            for element in manifest.findall(kind)}
    only_of_pip = {'rosbags', 'mcap'}  # see test_release.py
    needed = {Requirement(text).name.lower() for text in requirements} - only_of_pip
    assert {'python3-yaml' if name == 'pyyaml' else f'python3-{name}' for name in needed} <= keys


def test_the_wheel_has_every_module_no_test_and_what_ros_looks_for(wheel):
    names = wheel.namelist()
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / 'l1slam_ros').rglob('*.py')}
    assert {name for name in names if name.endswith(('.py', 'py.typed'))
            and '.data/' not in name} == modules | {'l1slam_ros/py.typed'}
    assert 'l1slam_ros/cli/report/page.html' in names
    # The compiled core in one file for each level, for every Python, and its types; no source.
    assert '-cp310-abi3-' in Path(wheel.filename).name
    assert {name for name in names if name.endswith(('.pyi', '.so'))} == {
        str(path.relative_to(ROOT)) for end in ('pyi', 'so')
        for path in (ROOT / 'l1slam_ros').rglob(f'*.{end}')}
    assert not [name for name in names if name.endswith('pp')]
    (licence,) = [name for name in names if name.endswith('/LICENSE')]
    assert wheel.read(licence) == (ROOT / 'LICENSE').read_bytes()
    data = f'{stem(wheel)}.data/data/'
    shared = {f'{data}share/l1slam_ros/{folder}/{path.name}' for folder in ('config', 'launch')
              for path in (ROOT / folder).iterdir() if path.is_file()}
    assert shared | {f'{data}share/ament_index/resource_index/packages/l1slam_ros',
                     f'{data}share/l1slam_ros/package.xml'} <= {*names}
    starters = {info.filename.removeprefix(f'{data}lib/l1slam_ros/'): info
                for info in wheel.infolist() if info.filename.startswith(f'{data}lib/')}
    assert starters.keys() == EXECUTABLES
    assert all(info.external_attr >> 16 & stat.S_IXUSR for info in starters.values())


@pytest.mark.parametrize('name', ['backend', 'scan_loops', 'replay'])
def test_what_needs_ros_says_so_in_one_line(name, tmp_path):
    ran = subprocess.run([Path(sysconfig.get_path('scripts')) / name], capture_output=True,
                         env=without(tmp_path, *OF_ROS), text=True, timeout=PATIENCE)
    assert ran.returncode == 1 and ran.stderr.count('\n') == 1, ran.stderr
    assert ran.stderr.startswith(f'{name}: ') and '; expected ROS 2' in ran.stderr


def test_the_installed_wheel_runs(wheel, requirements, tmp_path):
    """Where there is nothing but what it says that it needs."""
    needed = environment(*requirements)
    fresh = new_environment(tmp_path / 'fresh', sys.executable, below=needed)
    fresh.install('--no-index', wheel.filename)
    fresh.run('l1slam', 'simulate', 'bag', '--poses', 150, '--edges', 250, cwd=tmp_path)
    fresh.run('l1slam', 'solve', 'bag', '--plot', 'map.png', cwd=tmp_path)
    assert (tmp_path / 'map.png').exists()
    code = 'import l1slam_ros; print(l1slam_ros.__file__)'
    assert Path(fresh.run('python', '-c', code, cwd=tmp_path)).is_relative_to(fresh.prefix)
    pytest.importorskip('rclpy')
    with running_backend(fresh.prefix / 'lib' / 'l1slam_ros' / 'backend', cwd=tmp_path,
                         env=lent_variables(HOME=str(tmp_path))):
        pass


def lowest(requirement):
    """Return the requirement for the lowest version that it allows."""
    (bound,) = Requirement(requirement).specifier
    return f'{Requirement(requirement).name}=={bound.version}.*'


@pytest.mark.parametrize('version', ['3.10', '3.11', '3.12', '3.13'])
def test_every_python_makes_the_same_map(wheel, requirements, version, tmp_path):
    python = interpreter(version)
    if python is None:
        pytest.skip(f'no Python {version} on this machine')
    # From 3.12 on there are no wheels of the lowest Matplotlib.
    oldest = version == next(filter(interpreter, ['3.10', '3.11']), None)
    if not oldest and version == f'{sys.version_info.major}.{sys.version_info.minor}':
        pytest.skip('all other tests run on it')
    needed = environment(*(map(lowest, requirements) if oldest else requirements), python=python)
    fresh = new_environment(tmp_path / 'fresh', python, below=needed)
    fresh.install('--no-index', wheel.filename)

    def made(name, python, env):
        (tmp_path / name).mkdir()
        return json.loads(run(python, '-c', SMOKE, cwd=tmp_path / name, env=env))

    found = made('there', fresh.python, own_variables())
    assert found['python'] == version and not found['ros']
    assert found['numpy'].startswith('1.26.' if oldest else '2.')
    # Compilers order sums differently, and a solver stops within 10^-6 of the optimum.
    here = made('here', sys.executable, {**os.environ})
    assert found['costs'] == pytest.approx(here['costs'], rel=1e-6)
    np.testing.assert_allclose(found['edges'], here['edges'], rtol=1e-9, atol=1e-9)
    assert len(here['edges']) == 250


def test_a_type_checker_finds_the_types_of_the_installed_wheel(wheel, tmp_path):
    """Strictly, by a user's file."""
    tools = environment('mypy~=2.4.1', 'numpy', 'setuptools>=70.1')
    fresh = new_environment(tmp_path / 'fresh', sys.executable, below=tools)
    fresh.install('--no-deps', '--no-index', wheel.filename)
    example = re.search(r'## .*Python.*?```python\n(.*?)```', (ROOT / 'README.md').read_text(),
                        re.S)[1]
    (tmp_path / 'right.py').write_text(example)
    (tmp_path / 'wrong.py').write_text(f'{example}\nl1.solve(3)\n')
    found = subprocess.run(
        [tools.python, '-m', 'mypy', '--strict', '--python-executable', fresh.python, 'right.py',
         'wrong.py'], cwd=tmp_path, env=own_variables(), text=True, capture_output=True,
        timeout=2 * PATIENCE)
    wrong, *rest = found.stdout.splitlines()
    assert wrong.startswith('wrong.py') and 'has incompatible type "int"' in wrong, found.stdout
    assert 'Found 1 error in 1 file' in rest[-1]


@pytest.fixture(scope='module', params=[[], ['--symlink-install']], ids=['plain', 'symlink'])
def workspace(request, source, tmp_path_factory):
    """Build a workspace by colcon; return it."""
    folder = tmp_path_factory.mktemp('workspace')
    shutil.copytree(source, folder / 'src' / 'l1slam_ros', symlinks=True)
    # Setuptools warns where Python is told to write no bytecode.
    built = environment(*COLCON).run('colcon', 'build', *request.param, cwd=folder,
                                     HOME=str(folder), PYTHONDONTWRITEBYTECODE='', **QUICKLY)
    # Were anything said on standard error, colcon would show it to its user and say so below.
    assert re.search('Summary: 1 package finished.*\n$', built), built
    return folder


@pytest.mark.parametrize('workspace', [[]], ids=['plain'], indirect=True)
def test_colcon_tests_a_workspace(workspace, tmp_path):
    """By a part of the suite, with what the running Python has."""
    colcon = environment(*COLCON).prefix / 'bin' / 'colcon'
    lent = lent_variables(HOME=str(tmp_path))
    run(colcon, 'test', '--pytest-args', 'test/test_make.py', cwd=workspace, env=lent)
    found = run(colcon, 'test-result', '--all', cwd=workspace, env=lent)
    assert re.search(r'Summary: [1-9]\d* tests, 0 errors, 0 failures', found), found


def sourced(workspace, *command):
    """Return a command that sources the workspace, and then is `command`."""
    return ['bash', '-c', '. "$0/install/setup.bash" && exec "$@"', workspace, *command]


def test_a_sourced_workspace_runs_the_command_and_the_node(workspace, tmp_path):
    lent = lent_variables(HOME=str(tmp_path))
    prefix = workspace / 'install' / 'l1slam_ros'
    lib, share = prefix / 'lib' / 'l1slam_ros', prefix / 'share' / 'l1slam_ros'
    assert {path.name for path in lib.iterdir()} == EXECUTABLES
    out = run(*sourced(workspace, lib / 'l1slam', 'info', ROOT / 'bags' / 'demo'), cwd=tmp_path,
              env=lent)
    assert 'poses       ' in out
    run(*sourced(workspace, lib / 'l1slam', 'simulate', 'world.g2o', '--poses', '60', '--edges',
                 '100'), cwd=tmp_path, env=lent)
    run(*sourced(workspace, lib / 'l1slam', 'solve', 'world.g2o', '--quiet'), cwd=tmp_path,
        env=lent)
    for path in ('package.xml', 'config/backend.yaml', 'launch/backend.launch.py'):
        assert (share / path).read_bytes() == (ROOT / path).read_bytes()
    pytest.importorskip('rclpy')
    code = """
import ament_index_python as index, l1slam_ros
print(index.get_package_prefix('l1slam_ros'))
print(index.get_package_share_directory('l1slam_ros'))
print(l1slam_ros.__file__)
"""
    found = run(*sourced(workspace, environment(*COLCON).python, '-c', code), cwd=tmp_path,
                env=lent).splitlines()
    assert found[:2] == [str(prefix), str(share)] and Path(found[2]).is_relative_to(workspace)
    command = sourced(workspace, lib / 'backend', '--ros-args', '--params-file',
                      share / 'config' / 'backend.yaml')
    with running_backend(*command, cwd=tmp_path, env=lent):
        played = subprocess.run(sourced(workspace, lib / 'replay', 'no-such-bag'), cwd=tmp_path,
                                env=lent, capture_output=True, text=True, timeout=PATIENCE)
    assert played.returncode == 2 and 'no such file' in played.stderr
