# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is built and installed: metadata that agree, files in their place, a core without ROS."""

import importlib.metadata
import re
import shutil
import stat
import subprocess
import sys
import zipfile
from email import message_from_bytes
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
EXECUTABLES = {'backend', 'scan_loops', 'replay', 'l1slam'}

# Run first in a fresh interpreter: ROS and its messages cannot be imported.
WITHOUT_ROS = """
import sys

class Wall:
    def find_spec(self, name, path=None, target=None):
        top = name.split('.')[0]
        if top in ('rclpy', 'builtin_interfaces') or top.endswith('_msgs') or top == 'std_srvs':
            raise ImportError(f'{name} is behind the wall')

sys.meta_path.insert(0, Wall())
"""


@pytest.fixture(scope='module')
def wheel(tmp_path_factory):
    """Build the wheel of a copy, so that nothing is left in the checkout, and open it."""
    source, built = tmp_path_factory.mktemp('source') / 'copy', tmp_path_factory.mktemp('built')
    ignored = shutil.ignore_patterns('.*', '*.egg-info', 'build', 'demo', '__pycache__')
    shutil.copytree(ROOT, source, ignore=ignored, symlinks=True)
    # From this version on setuptools builds wheels by itself: nothing has to be fetched.
    able = Version(importlib.metadata.version('setuptools')) >= Version('70.1')
    command = [sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--wheel-dir',
               str(built), *['--no-build-isolation'] * able, str(source)]
    subprocess.run(command, check=True, timeout=120)
    (file,) = built.glob('*.whl')
    with zipfile.ZipFile(file) as archive:
        yield archive


def stem(wheel):
    """Return name-version, which the folders inside a wheel begin with."""
    return '-'.join(Path(wheel.filename).name.split('-')[:2])


@pytest.fixture(scope='module')
def metadata(wheel):
    return message_from_bytes(wheel.read(f'{stem(wheel)}.dist-info/METADATA'))


@pytest.fixture(scope='module')
def manifest():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def test_package_xml_and_setup_py_say_the_same(metadata, manifest):
    maintainer = manifest.find('maintainer')
    assert manifest.findtext('name') == metadata['Name'].replace('-', '_')
    assert manifest.findtext('version') == metadata['Version']
    assert manifest.findtext('description') == metadata['Summary']
    assert metadata['Description-Content-Type'] == 'text/markdown'
    assert metadata.get_payload(decode=True) == (ROOT / 'README.md').read_bytes()
    assert manifest.findtext('license') in (metadata['License'], metadata['License-Expression'])
    assert maintainer.text == metadata['Maintainer']
    assert maintainer.get('email') == metadata['Maintainer-email']
    assert manifest.findtext('export/build_type') == 'ament_python'


def test_package_xml_and_setup_py_need_the_same(metadata, manifest):
    keys = {element.text for element in manifest.findall('exec_depend')}
    key_of = {'pyyaml': 'python3-yaml'}
    only_of_pip = {'rosbags', 'mcap'}  # see test_release.py
    for text in metadata.get_all('Requires-Dist'):
        requirement = Requirement(text)
        name = requirement.name.lower()
        if requirement.marker is None and name not in only_of_pip:
            assert key_of.get(name, f'python3-{name}') in keys, text


def test_the_changelog_has_the_form_that_bloom_and_catkin_read(metadata):
    """As `catkin_generate_changelog` writes it; what is not released yet is `Forthcoming`."""
    lines = (ROOT / 'CHANGELOG.rst').read_text().splitlines()
    title = 'Changelog for package l1slam_ros'
    assert lines[:4] == ['^' * len(lines[0]), title, '^' * len(lines[0]), '']
    assert len(lines[0]) >= len(title)
    sections = [(lines[k - 1], line) for k, line in enumerate(lines)
                if line and not line.strip('-')]
    assert sections and all(len(line) == len(name) for name, line in sections)
    for name, _ in sections[sections[0][0] == 'Forthcoming':]:
        assert re.fullmatch(r'\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)', name), name
    if sections[0][0] != 'Forthcoming':
        assert sections[0][0].split()[0] == metadata['Version']


def test_the_licence_is_apache(wheel):
    (name,) = [name for name in wheel.namelist() if name.endswith('/LICENSE')]
    text = wheel.read(name).decode()
    assert 'Apache License' in text and 'Version 2.0, January 2004' in text
    assert text == (ROOT / 'LICENSE').read_text()


def test_every_module_is_in_the_wheel_and_no_test(wheel):
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / 'l1slam_ros').rglob('*.py')}
    in_wheel = {name for name in wheel.namelist()
                if name.endswith(('.py', 'py.typed')) and '.data/' not in name}
    assert in_wheel == modules | {'l1slam_ros/py.typed'}
    assert 'l1slam_ros/cli/report/page.html' in wheel.namelist()


def test_every_folder_with_modules_is_a_package():
    folders = {path.parent for path in (ROOT / 'l1slam_ros').rglob('*.py')}
    assert all((folder / '__init__.py').is_file() for folder in folders)


def test_ros_finds_the_data_files(wheel):
    data = f'{stem(wheel)}.data/data/'
    names = {name.removeprefix(data) for name in wheel.namelist() if name.startswith(data)}
    shared = {f'share/l1slam_ros/{folder}/{path.name}' for folder in ('config', 'launch')
              for path in (ROOT / folder).iterdir() if path.is_file()}
    assert 'share/ament_index/resource_index/packages/l1slam_ros' in names
    assert 'share/l1slam_ros/package.xml' in names
    assert shared <= names
    assert {'share/l1slam_ros/config/backend.yaml',
            'share/l1slam_ros/launch/backend.launch.py'} <= names


def test_ros2_run_finds_executables(wheel):
    folder = f'{stem(wheel)}.data/data/lib/l1slam_ros/'
    starters = {info.filename.removeprefix(folder): info for info in wheel.infolist()
                if info.filename.startswith(folder)}
    assert starters.keys() == EXECUTABLES
    for info in starters.values():
        assert info.external_attr >> 16 & stat.S_IXUSR


@pytest.mark.parametrize('name', sorted(EXECUTABLES))
def test_a_starter_runs_the_executable_of_its_name(name, tmp_path):
    folder = tmp_path / 'a prefix' / 'lib' / 'l1slam_ros'
    folder.mkdir(parents=True)
    (tmp_path / 'a prefix' / 'bin').mkdir()
    shutil.copy(ROOT / 'resource' / 'run' / name, folder / name)
    target = tmp_path / 'a prefix' / 'bin' / name
    target.write_text('#!/bin/sh\necho "$0" "$#" "$2"\nexit 3\n')
    target.chmod(0o755)
    ran = subprocess.run([folder / name, 'one', 'two words'], capture_output=True, text=True)
    assert ran.stdout.endswith(f'bin/{name} 2 two words\n')
    assert ran.returncode == 3


def test_entry_points_exist(wheel):
    pytest.importorskip('rclpy')
    text = wheel.read(f'{stem(wheel)}.dist-info/entry_points.txt').decode()
    entries = dict(re.findall(r'^(\w+) = (\S+)$', text, re.MULTILINE))
    assert entries.keys() == EXECUTABLES
    for entry in entries.values():
        module, function = entry.split(':')
        assert callable(getattr(importlib.import_module(module), function)), entry


@pytest.mark.parametrize('name', ['backend', 'scan_loops', 'replay'])
def test_what_needs_ros_says_so_in_one_line(name):
    code = WITHOUT_ROS + f'import l1slam_ros.ros.executables as e; sys.exit(e.{name}())'
    ran = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                         timeout=60)
    assert ran.returncode == 1 and ran.stderr.count('\n') == 1, ran.stderr
    assert ran.stderr.startswith(f'{name}: ') and 'behind the wall; expected ROS 2' in ran.stderr


def test_the_core_and_the_command_need_no_ros():
    code = WITHOUT_ROS + """
import importlib, pkgutil
import l1slam_ros.cli.main, l1slam_ros.core, l1slam_ros.io
for package in l1slam_ros.core, l1slam_ros.io:
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
        importlib.import_module(module.name)
try:
    import rclpy
except ImportError:
    print('walled')
"""
    ran = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                         timeout=60)
    assert (ran.stdout, ran.stderr) == ('walled\n', '')
