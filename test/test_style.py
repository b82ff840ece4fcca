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
