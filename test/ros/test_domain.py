# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The ROS domain that is chosen where nobody is, and the arguments that are not those of ROS."""

import os
import subprocess
import sys

import pytest

pytest.importorskip('rclpy')

from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.ros.shell import domain
from l1slam_ros.ros.shell.arguments import split

CHOOSE = ('from l1slam_ros.ros.shell.domain import go_where_nobody_is as go; '
          'print(go(), flush=True); input()')
STAND_IN = ('import os, rclpy; rclpy.init(); node = rclpy.create_node("other"); '
            'print("here", flush=True); input()')


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


def is_free(number):
    mark = domain._take(number)
    if mark is not None:
        mark.close()
    return mark is not None


def test_who_choose_at_once_are_in_different_domains_until_they_end(python):
    begun = [python(CHOOSE) for _ in range(4)]
    chosen = {int(said) for _, said in begun}
    assert len(chosen) == 4 and int(os.environ['ROS_DOMAIN_ID']) not in chosen
    assert not any(is_free(number) for number in chosen)
    for process, _ in begun:
        process.kill()
        process.wait()
    assert all(is_free(number) for number in chosen)


@pytest.mark.parametrize('told', [
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, {'ROS_LOCALHOST_ONLY': '1'}])
def test_a_domain_with_a_node_in_it_is_not_free(python, told):
    process, said = python(CHOOSE)
    process.kill()
    process.wait()
    number = int(said)
    assert is_free(number)
    python(STAND_IN, ROS_DOMAIN_ID=said, **told)
    assert not is_free(number)


def test_where_no_domain_is_free_it_is_said(monkeypatch):
    before = os.environ['ROS_DOMAIN_ID']
    monkeypatch.setattr(domain, '_DOMAINS', range(int(before), int(before) + 1))
    with pytest.raises(L1SlamError, match='expected a free one'):
        domain.go_where_nobody_is()
    assert os.environ['ROS_DOMAIN_ID'] == before


@pytest.mark.parametrize('line, own', [
    ('', ''), ('bag --remap a:=b', 'bag --remap a:=b'), ('--ros-args -r a:=b', ''),
    ('--ros-args -r a:=b -- bag', 'bag'), ('bag --ros-args -r a:=b -- --clock --ros-args -p x:=1',
                                           'bag --clock')])
def test_a_command_line_is_split(line, own):
    mine, of_ros = split(line.split())
    assert mine == own.split()
    assert sorted(mine + of_ros) == sorted(line.split())
