# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The package's metadata; the version is that of package.xml, a test compares the rest with it."""

import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

# `colcon build --symlink-install` runs a link to this file, in a folder without what lies here.
sys.path.insert(0, str(Path(__file__).resolve().parent))

from build_backend import HERE, BuildCore, extensions

package_name = 'l1slam_ros'

data_files = [
    ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
    (f'share/{package_name}', ['package.xml']),
    (f'share/{package_name}/config', sorted(glob('config/*'))),
    (f'share/{package_name}/launch', sorted(glob('launch/*.py'))),
]
# `ros2 run` looks in lib/<package>. colcon (it calls `install` or `develop`) puts the console
# scripts there by setup.cfg; pip puts them in bin, so what pip installs carries starters.
if not {'install', 'develop'}.intersection(sys.argv):
    data_files.append((f'lib/{package_name}', sorted(glob('resource/run/*'))))

setup(
    name=package_name,
    version=ElementTree.parse(HERE / 'package.xml').findtext('version'),
    description='Pose-graph SLAM back end for ROS 2: L1 norm, primal-dual, robust to false loops',
    long_description=(HERE / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    maintainer='l1slam_ros maintainers',
    maintainer_email='maintainers@l1slam-ros.invalid',
    license='Apache-2.0',
    packages=find_packages(exclude=['test']),
    ext_modules=extensions(),
    cmdclass={'build_ext': BuildCore},
    options={'bdist_wheel': {'py_limited_api': 'cp310'}, 'build_ext': {'parallel': 2}},
    # Said though it is so anyway: then an editable install is a path, which type checkers follow,
    # and not a hook of the import, which they do not.
    package_dir={'': '.'},
    package_data={
        package_name: ['py.typed'],  # its annotations are there to be used
        f'{package_name}.core.native': ['*.pyi'],
        f'{package_name}.cli.report': ['page.html'],
    },
    data_files=data_files,
    zip_safe=False,
    python_requires='>=3.10',
    # Lower bounds: what Ubuntu 24.04, the home of ROS 2 Jazzy, ships. rosbags comes from PyPI
    # there too; before 0.11.6 it reads the messages of one time in any order.
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'matplotlib>=3.6',
        'tqdm>=4.66',
        'PyYAML>=6.0',
        'mcap>=1.2',
        'rosbags>=0.11.7',
    ],
    extras_require={
        # The distribution must be named: the wheels' unpinned `ros-rclpy` is not Jazzy.
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        # The TAB key: commands and options of l1slam; see `l1slam --help`.
        'completion': ['argcomplete>=3.1'],
        # `l1slam solve --report`; the library that Ubuntu 24.04 ships, or newer.
        'report': ['plotly>=5.15'],
        # JRL files in their compressed form; older ones bound less of what strangers write.
        'cbor': ['cbor2>=6.3'],
        # `l1slam batch --scheduler`; on one machine it needs nothing.
        'fleet': ['distributed>=2024.1'],
        # Newer style tools find other things, and a test asserts that they find none.
        # setuptools: a test builds the wheel, and from 70.1 on it can do so by itself.
        # pip: tests install into other environments; before 23.1 it cannot into those of 3.12.
        'test': [
            'pytest>=7.4',
            'pytest-xdist>=3.2',
            'hypothesis>=6.98',
            'ruff~=0.17.5',
            'mypy~=2.4.1',
            'packaging',
            'argcomplete>=3.1',
            'cbor2>=6.3',
            'plotly>=5.15',
            'distributed>=2024.1',
            'pip>=23.1',
            'setuptools>=70.1',
        ],
    },
    entry_points={
        'console_scripts': [
            'backend = l1slam_ros.ros.executables:backend',
            'scan_loops = l1slam_ros.ros.executables:scan_loops',
            'replay = l1slam_ros.ros.executables:replay',
            'l1slam = l1slam_ros.cli.entry:main',
        ],
    },
)
