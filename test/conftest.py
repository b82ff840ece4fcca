# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Fixtures every test may ask for."""

import atexit
import os
import signal
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest


def _own_domain():
    """Return a ROS domain that nobody on this machine is in, and what marks it as taken."""
    for k in range(101):
        domain = 1 + (os.getpid() + k) % 101
        taken = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        try:
            # What DDS is discovered by, which must be free, and what it leaves alone.
            for offset, one in zip((0, 5), taken, strict=True):
                one.bind(('', 7400 + 250 * domain + offset))
        except OSError:
            taken[1].close()
            continue
        finally:
            taken[0].close()
        return str(domain), taken[1]
    raise OSError('each ROS domain is in use on this machine')


# Whatever the shell says, before anything of ROS is imported, and for all that is started. No
# robot nearby hears the tests, nor they it. Tests read what ROS logs.
_ABOUT_THE_INSTALLATION = {'ROS_DISTRO', 'ROS_VERSION', 'ROS_PYTHON_VERSION'}
for _name in {*os.environ} - _ABOUT_THE_INSTALLATION:
    if _name.startswith(('ROS_', 'RCL_', 'RCUTILS_', 'RMW_', 'FAST', 'CYCLONEDDS_', 'ZENOH_')):
        del os.environ[_name]
os.environ['ROS_DOMAIN_ID'], _mark = _own_domain()
atexit.register(_mark.close)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


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
    for one in benches:
        one.close()


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
