# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The page with the order of what happens to a message, held to the code."""

import ast
import importlib.util
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from test_floors import code_lines

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / 'benchmarks' / 'ros'))
parts = list(importlib.import_module('page').parts())
LONGEST_WAY, LONGEST_FILE = 14, 260


@cache
def functions(file):
    """Return the functions of a file of the package, with those of classes, by their names."""
    found = {}
    for node in ast.parse((ROOT / 'l1slam_ros' / file).read_text()).body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.ClassDef):
            found |= {f'{node.name}.{one.name}': one for one in node.body
                      if isinstance(one, ast.FunctionDef)}
    return found


def test_the_page_has_its_parts():
    assert [part.thread for part in parts] == ['intake', 'intake', 'solver', 'map', 'judge']


@pytest.mark.parametrize('part', parts, ids=lambda part: part.title)
def test_each_step_is_a_call_one_can_jump_to_and_no_file_is_entered_twice(part):
    assert [step.number for step in part.steps] == list(range(1, len(part.steps) + 1))
    files = [step.file for step in part.steps]
    assert len(files) == len(set(files)) <= LONGEST_WAY
    for step in part.steps:
        assert step.call in functions(step.file)
        assert len(code_lines(ROOT / 'l1slam_ros' / step.file)) <= LONGEST_FILE


def test_the_real_node_goes_the_way_of_the_page():
    if importlib.util.find_spec('rclpy') is None:
        pytest.skip('there is no ROS')
    walk = subprocess.run([sys.executable, 'benchmarks/ros/walk.py'], cwd=ROOT, timeout=300,
                          capture_output=True, text=True)
    assert walk.returncode == 0 and 'NOT MET' not in walk.stdout, walk.stdout + walk.stderr
