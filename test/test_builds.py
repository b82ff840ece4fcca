# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What users build runs: sdist and wheel by pip, on several Pythons, and colcon workspaces."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import zipfile
from contextlib import contextmanager
from email import message_from_bytes
from pathlib import Path

import pytest
from environments import (
    environment,
    interpreter,
    lent_variables,
    new_environment,
    own_variables,
    require_registry,
    run,
)
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  # [s] for a node to end
EXECUTABLES = {'backend', 'scan_loops', 'replay', 'l1slam'}
# EmPy comes without a wheel.
COLCON = ('colcon-bash', 'colcon-output', 'colcon-ros', 'setuptools<80', '--no-binary=empy')

# Solves that world again, by kept machine code.
AGAIN = """
import sys
from l1slam_ros.cli.main import main
assert main(['solve', 'world.g2o', '--quiet']) == 0
print('numba' in sys.modules)
"""
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
    return json.loads(run('solve', *arguments, '--json'))['final_cost']

run('simulate', 'world.g2o', '--poses', '150', '--edges', '250', '--seed', '7')
run('convert', 'world.g2o', 'bag')
run('convert', 'bag', 'back.g2o')
odometry = ('--start', 'odometry', '--outer', '0')
print(json.dumps({
    'python': '%d.%d' % sys.version_info[:2],
    'numpy': numpy.__version__,
    'ros': importlib.util.find_spec('rclpy') is not None,
    'costs': [cost('world.g2o', *odometry), cost('bag', *odometry), cost('back.g2o', *odometry),
              cost('world.g2o', '--norm', 'l2'), cost('world.g2o', '--outer', '3')],
}))
"""


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    """Return a copy of the checkout, so that nothing is left in it."""
    copy = tmp_path_factory.mktemp('source') / 'l1slam_ros'
    ignored = shutil.ignore_patterns('.*', '*.egg-info', '__pycache__', 'build', 'install', 'log',
                                     'dist', 'demo')
    return shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)


@pytest.fixture(scope='module')
def distributions(source, tmp_path_factory):
    """Return the sdist, and the wheel built of the sdist alone, as packagers build them."""
    folder = tmp_path_factory.mktemp('dist')
    environment('build', 'setuptools').run(
        'python', '-m', 'build', '--no-isolation', '--outdir', folder, source, cwd=folder)
    (sdist,), (wheel,) = folder.glob('*.tar.gz'), folder.glob('*.whl')
    return {'sdist': sdist, 'wheel': wheel}


@pytest.fixture(scope='module')
def requirements(distributions):
    """Return what the wheel says that it needs without ROS."""
    with zipfile.ZipFile(distributions['wheel']) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith('.dist-info/METADATA')]
        metadata = message_from_bytes(archive.read(name))
    needed = [Requirement(text) for text in metadata.get_all('Requires-Dist')]
    return [str(requirement) for requirement in needed if requirement.marker is None]


@pytest.fixture(scope='module')
def smoke(tmp_path_factory):
    """Return what the running Python makes of the small world."""
    folder = tmp_path_factory.mktemp('smoke')
    return json.loads(run(sys.executable, '-c', SMOKE, cwd=folder, env=dict(os.environ)))


def lowest(requirement):
    """Return the requirement for the lowest version that it allows."""
    (bound,) = Requirement(requirement).specifier
    return f'{Requirement(requirement).name}=={bound.version}.*'


@contextmanager
def running_backend(*command, cwd, env):
    """Start a node that must become ready; end it by SIGTERM, upon which it must exit with 0."""
    process = subprocess.Popen([*command], cwd=cwd, env=env, stderr=subprocess.PIPE, text=True)
    try:
        line = process.stderr.readline()
        assert 'ready' in line, line
        yield
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.communicate()


def test_the_sdist_has_what_builds_the_package_and_nothing_else(distributions, source):
    with tarfile.open(distributions['sdist']) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    wanted = {'setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'LICENSE', 'README.md',
              'resource/l1slam_ros'}
    for folder in ('config', 'launch', 'resource/run', 'l1slam_ros'):
        wanted |= {str(path.relative_to(source)) for path in (source / folder).rglob('*')
                   if path.is_file()}
    assert wanted <= names, wanted - names
    unwanted = {name for name in names if name.split('/')[0] in ('bags', 'benchmarks', 'demo')}
    assert not unwanted


@pytest.fixture(scope='module', params=['wheel', 'sdist'])
def installed(request, distributions, requirements, tmp_path_factory):
    """Install the wheel or the sdist where there is nothing but what it says that it needs."""
    needed = environment(*requirements)
    fresh = new_environment(tmp_path_factory.mktemp(request.param) / 'fresh', sys.executable,
                            below=needed)
    if request.param == 'wheel':
        fresh.install('--no-index', distributions['wheel'])
    else:  # to be built, it has setuptools fetched
        require_registry()
        fresh.install(distributions['sdist'])
    return fresh


def test_the_installed_command_runs(installed, tmp_path):
    installed.run('l1slam', 'simulate', 'world.g2o', '--poses', 150, '--edges', 250, cwd=tmp_path)
    # Solving compiles for half a minute; `test_every_python_comes_to_the_same_costs` does it.
    installed.run('l1slam', 'convert', 'world.g2o', 'bag', cwd=tmp_path)
    installed.run('l1slam', 'plot', 'bag', '--output', 'map.png', cwd=tmp_path)
    assert (tmp_path / 'map.png').exists()
    code = 'import l1slam_ros; print(l1slam_ros.__file__)'
    assert Path(installed.run('python', '-c', code, cwd=tmp_path)).is_relative_to(installed.prefix)


def test_the_installed_node_runs_where_there_is_ros(installed, tmp_path):
    pytest.importorskip('rclpy')
    starter = installed.prefix / 'lib' / 'l1slam_ros' / 'backend'
    with running_backend(starter, cwd=tmp_path, env=lent_variables(HOME=str(tmp_path))):
        pass


@pytest.mark.parametrize('version', ['3.10', '3.11', '3.12'])
def test_every_python_comes_to_the_same_costs(
        distributions, requirements, smoke, version, tmp_path):
    python = interpreter(version)
    if python is None:
        pytest.skip(f'no Python {version} on this machine')
    # From 3.12 on there are no wheels of the lowest Matplotlib.
    oldest = version == next(filter(interpreter, ['3.10', '3.11']), None)
    if not oldest and version == f'{sys.version_info.major}.{sys.version_info.minor}':
        pytest.skip('all other tests run on it')
    needed = environment(*(map(lowest, requirements) if oldest else requirements), python=python)
    fresh = new_environment(tmp_path / 'fresh', python, below=needed)
    fresh.install('--no-index', distributions['wheel'])
    found = json.loads(fresh.run('python', '-c', SMOKE, cwd=tmp_path))
    assert found['python'] == version and not found['ros']
    assert fresh.run('python', '-c', AGAIN, cwd=tmp_path).strip() == 'False'
    assert found['numpy'].startswith('1.26.' if oldest else '2.')
    # Compilers order sums differently, and a solver stops within 10^-6 of the optimum.
    assert found['costs'] == pytest.approx(smoke['costs'], rel=1e-6)


@pytest.mark.parametrize('kind', ['editable', 'wheel'])
def test_a_type_checker_finds_the_types_in_every_kind_of_install(
        distributions, source, kind, tmp_path):
    """As `make` installs it, `--editable`, and as users do; strictly, and by a user's file."""
    tools = environment('mypy~=2.4.1', 'numpy', 'setuptools>=70.1')
    fresh = new_environment(tmp_path / 'fresh', sys.executable, below=tools)
    if kind == 'editable':
        copy = shutil.copytree(source, tmp_path / 'copy', symlinks=True)
        fresh.install('--no-deps', '--no-build-isolation', '--editable', copy)
    else:
        fresh.install('--no-deps', '--no-index', distributions['wheel'])
    example = re.search(r'## .*Python.*?```python\n(.*?)```', (ROOT / 'README.md').read_text(),
                        re.S)[1]
    (tmp_path / 'right.py').write_text(example)
    (tmp_path / 'wrong.py').write_text(f'{example}\nl1.solve(3)\n')
    asked = [tools.python, '-m', 'mypy', '--strict', '--python-executable', fresh.python]
    run(*asked, 'right.py', cwd=tmp_path, env=own_variables())
    found = subprocess.run([*asked, 'wrong.py'], cwd=tmp_path, env=own_variables(), text=True,
                           capture_output=True, timeout=PATIENCE)
    assert found.returncode == 1 and 'has incompatible type "int"' in found.stdout, found.stdout


@pytest.fixture(scope='module', params=[[], ['--symlink-install']], ids=['plain', 'symlink'])
def workspace(request, source, tmp_path_factory):
    """Build a workspace by colcon; return it."""
    folder = tmp_path_factory.mktemp('workspace')
    shutil.copytree(source, folder / 'src' / 'l1slam_ros', symlinks=True)
    # Setuptools warns where Python is told to write no bytecode.
    built = environment(*COLCON).run('colcon', 'build', *request.param, cwd=folder,
                                     HOME=str(folder), PYTHONDONTWRITEBYTECODE='')
    # Were anything said on standard error, colcon would show it to its user and say so below.
    assert re.search('Summary: 1 package finished.*\n$', built), built
    return folder


def test_colcon_tests_a_workspace(workspace, tmp_path):
    """By a part of the suite, with what the running Python has."""
    colcon = environment(*COLCON).prefix / 'bin' / 'colcon'
    # These tests solve nothing, so there is nothing to compile for this place.
    lent = lent_variables(HOME=str(tmp_path), NUMBA_DISABLE_JIT='1')
    run(colcon, 'test', '--pytest-args', 'test/core/test_options.py', cwd=workspace, env=lent)
    found = run(colcon, 'test-result', '--all', cwd=workspace, env=lent)
    assert re.search(r'Summary: [1-9]\d* tests, 0 errors, 0 failures', found), found


def sourced(workspace, *command):
    """Return a command that sources the workspace, and then is `command`."""
    return ['bash', '-c', '. "$0/install/setup.bash" && exec "$@"', workspace, *command]


def test_a_sourced_workspace_runs_the_command(workspace, tmp_path):
    lib, lent = workspace / 'install' / 'l1slam_ros' / 'lib' / 'l1slam_ros', lent_variables()
    assert {path.name for path in lib.iterdir()} == EXECUTABLES
    run(*sourced(workspace, lib / 'l1slam', 'simulate', 'world.g2o', '--poses', 50,
                 '--edges', 80), cwd=tmp_path, env=lent)
    out = run(*sourced(workspace, lib / 'l1slam', 'info', 'world.g2o'), cwd=tmp_path, env=lent)
    assert 'poses       50' in out and 'loops       31' in out


def test_a_sourced_workspace_is_found_by_ros(workspace, tmp_path):
    pytest.importorskip('rclpy')
    code = """
import ament_index_python as index, l1slam_ros
print(index.get_package_prefix('l1slam_ros'))
print(index.get_package_share_directory('l1slam_ros'))
print(l1slam_ros.__file__)
"""
    python = environment(*COLCON).python
    prefix, share, module = map(Path, run(
        *sourced(workspace, python, '-c', code), cwd=tmp_path, env=lent_variables()).splitlines())
    assert prefix == workspace / 'install' / 'l1slam_ros'
    for path in ('package.xml', 'config/backend.yaml', 'launch/backend.launch.py'):
        assert (share / path).read_bytes() == (ROOT / path).read_bytes()
    assert module.is_relative_to(workspace)


def test_a_sourced_workspace_runs_the_node(workspace, tmp_path):
    pytest.importorskip('rclpy')
    lib = workspace / 'install' / 'l1slam_ros' / 'lib' / 'l1slam_ros'
    params = workspace / 'install' / 'l1slam_ros' / 'share' / 'l1slam_ros' / 'config'
    lent = lent_variables(HOME=str(tmp_path))
    command = sourced(workspace, lib / 'backend', '--ros-args', '--params-file',
                      params / 'backend.yaml')
    with running_backend(*command, cwd=tmp_path, env=lent):
        played = subprocess.run(sourced(workspace, lib / 'replay', 'no-such-bag'), cwd=tmp_path,
                                env=lent, capture_output=True, text=True, timeout=PATIENCE)
    assert played.returncode == 2 and 'no such file' in played.stderr
