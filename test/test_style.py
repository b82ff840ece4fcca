# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""ruff and mypy, as configured in pyproject.toml, find nothing."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize('tool', [['ruff', 'check'], ['mypy']], ids=['ruff', 'mypy'])
def test_tool_finds_nothing(tool):
    if importlib.util.find_spec(tool[0]) is None and 'CI' not in os.environ:
        pytest.skip(f'{tool[0]} is not installed')
    found = subprocess.run([sys.executable, '-m', *tool], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
