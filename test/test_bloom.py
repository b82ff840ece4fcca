# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bloom makes the files of a Debian package, with an index and keys that lie on this machine."""

import shutil
from pathlib import Path

import pytest
import yaml
from environments import environment, require_registry
from rosdep_keys import OF_JAZZY, OF_ROSDEP

ROOT = Path(__file__).parents[1]
PACKAGES = OF_ROSDEP | {key: f'ros-jazzy-{key.replace("_", "-")}' for key in OF_JAZZY}


@pytest.fixture
def index(tmp_path):
    """Return the variables by which bloom and rosdep know Jazzy, Noble and these keys alone."""
    def written(name, told):
        path = tmp_path / name
        path.write_text('%YAML 1.1\n---\n' + yaml.safe_dump(told))
        return path.as_uri()

    (tmp_path / 'home').mkdir()
    (tmp_path / 'sources').mkdir()
    keys = written('keys.yaml', {key: {'ubuntu': {'noble': [package]}}
                                 for key, package in PACKAGES.items()})
    (tmp_path / 'sources' / '20.list').write_text(f'yaml {keys}\n')
    jazzy = written('jazzy.yaml', {'type': 'distribution', 'version': 2, 'repositories': {},
                                   'release_platforms': {'ubuntu': ['noble']}})
    cache = tmp_path / 'jazzy-cache.yaml.gz'
    of_all = written('index.yaml', {'type': 'index', 'version': 4, 'distributions': {'jazzy': {
        'distribution': [jazzy], 'distribution_cache': cache.as_uri(), 'python_version': 3,
        'distribution_status': 'active', 'distribution_type': 'ros2'}}})
    return {'ROSDISTRO_INDEX_URL': of_all, 'ROSDEP_SOURCE_PATH': str(tmp_path / 'sources'),
            'HOME': str(tmp_path / 'home')}


def test_bloom_makes_a_debian_package_of_every_key(index, tmp_path):
    require_registry()
    # EmPy comes without a wheel.
    tools = environment('bloom', 'rosdep', 'rosdistro', 'setuptools<80', '--no-binary=empy')
    copy = tmp_path / 'l1slam_ros'
    copy.mkdir()
    for name in ('package.xml', 'LICENSE'):
        shutil.copy(ROOT / name, copy)
    # As catkin_prepare_release does it.
    text = (ROOT / 'CHANGELOG.rst').read_text().replace(
        'Forthcoming\n-----------', '0.1.0 (2026-01-01)\n------------------')
    (copy / 'CHANGELOG.rst').write_text(text)
    tools.run('rosdistro_build_cache', index['ROSDISTRO_INDEX_URL'], 'jazzy', cwd=tmp_path,
              **index)
    tools.run('rosdep', 'update', '--rosdistro', 'jazzy', cwd=tmp_path, **index)
    tools.run('bloom-generate', 'rosdebian', '--os-name', 'ubuntu', '--os-version', 'noble',
              '--ros-distro', 'jazzy', cwd=copy, **index)
    control = (copy / 'debian' / 'control').read_text()
    assert control.startswith('Source: ros-jazzy-l1slam-ros\n')
    assert 'Maintainer: "l1slam_ros maintainers"' in control
    needed = {word.strip(' ,') for line in control.splitlines() for word in line.split(', ')}
    assert 'is doubtful' in (copy / 'debian' / 'changelog').read_text()
    wanted = ('rclpy', 'nav_msgs', 'python3-dev', 'python3-numpy')
    assert {PACKAGES[key] for key in wanted} <= needed
