# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Fixtures every test may ask for."""

import os
import signal
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from l1slam_ros.cli.main import main

# A step of 1 m in the plane and in space, known to 1 m and 1 rad.
IN_THE_PLANE = 'EDGE_SE2 {} {} 1 0 0 ' + '1 0 0 1 0 1'
IN_SPACE = 'EDGE_SE3:QUAT {} {} 1 0 0 0 0 0 1 ' + '1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1'

# No robot nearby hears the tests, nor they it: what the shell says of ROS is forgotten, before
# anything of it is imported, and for all that is started.
for _name in [name for name in os.environ
              if name.startswith(('RCUTILS_', 'ROS_', 'RMW_', 'FASTRTPS_', 'FASTDDS_'))]:
    del os.environ[_name]
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def _domain():
    """Return a ROS domain, and what marks it as taken: a port that DDS leaves alone."""
    for k in range(101):
        domain = 1 + (os.getpid() + k) % 101
        mark = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with suppress(OSError):
            mark.bind(('', 7400 + 250 * domain + 5))
            return str(domain), mark
        mark.close()
    raise RuntimeError('each ROS domain is in use on this machine')


os.environ['ROS_DOMAIN_ID'], _MARK = _domain()


def pytest_sessionstart(session):
    """Compile before the first test: a solve that compiles takes long, and says so."""
    if hasattr(session.config, 'workerinput'):
        return
    capture = session.config.pluginmanager.getplugin('capturemanager')
    with capture.global_and_fixture_disabled(), TemporaryDirectory() as folder:
        for step in (IN_THE_PLANE, IN_SPACE):
            graph = Path(folder, 'steps.g2o')
            graph.write_text(f'{step}\n{step}\n'.format(0, 1, 1, 2))
            assert main(['solve', str(graph), '--output', str(Path(folder, 'solved.g2o'))]) == 0


def pytest_collection_modifyitems(items):
    """
    Begin with the modules of this folder, which build, install and run what the pages say.

    They take longest: last, one worker would still be at them when the other has nothing left, and
    where it has taken over some of a module, both would build what its tests share.
    """
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent)


@pytest.fixture
def rng():
    """Return a generator with a fixed seed: a failing test fails again."""
    return np.random.default_rng(0)


@pytest.fixture(scope='session')
def datasets():
    """Return the folder of the paper's own graphs; they are not part of the repository."""
    folder = Path(__file__).parents[2] / 'shared' / 'datasets'
    if not folder.is_dir():
        pytest.skip('the public datasets are not on this machine')
    return folder


@pytest.fixture(scope='session')
def shared():
    """Return the folder of inputs that are not part of the repository."""
    folder = Path(__file__).parents[2] / 'shared'
    if not folder.is_dir():
        pytest.skip('the shared inputs are not on this machine')
    return folder


@pytest.fixture
def ros():
    """Bring ROS up for one test and down after it; skip where there is none."""
    rclpy = pytest.importorskip('rclpy')
    rclpy.init()
    yield rclpy
    rclpy.try_shutdown()


@pytest.fixture
def bench(ros):
    """Return what makes a node with a peer, of some parameters; all are closed after the test."""
    from node_bench import Bench

    benches = []

    def make(**parameters):
        benches.append(Bench(ros, parameters))
        return benches[-1]

    yield make
    for made in benches:
        made.close()


@pytest.fixture
def start():
    """Return what starts the node as a process, in a session of its own; it ends with the test."""
    from node_bench import executable

    processes = []

    def begin(*arguments, first='', **environment):
        """Start it, after the shell has done something first."""
        processes.append(subprocess.Popen(
            ['sh', '-c', f'{first} exec "$@"', 'sh', executable('backend'), *arguments],
            stderr=subprocess.PIPE, text=True, start_new_session=True,
            env={**os.environ, **environment},
            # Under `nohup` the tests ignore it, and so would the node.
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)))
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.communicate()
