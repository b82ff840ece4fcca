# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The versions of l1slam, with its commit, of Python and of NumPy, for reports of faults."""

import json
import subprocess
from contextlib import suppress
from importlib.metadata import Distribution, distribution, version
from pathlib import Path
from platform import python_version


def version_text() -> str:
    """Return one line: the version, the commit where it is known, Python and NumPy."""
    ours = distribution('l1slam_ros')
    commit = _commit(ours)
    return (f'l1slam {ours.version}{", commit " if commit else ""}{commit}, '
            f'Python {python_version()}, NumPy {version("numpy")}')


def _commit(ours: Distribution) -> str:
    """Return the commit of the checkout this runs from, or that pip installed; empty: unknown."""
    root = Path(__file__).parents[2]
    if (root / '.git').exists():
        with suppress(OSError, subprocess.SubprocessError):
            return subprocess.run(
                ['git', '-C', str(root), 'describe', '--always', '--dirty', '--exclude', '*'],
                check=True, capture_output=True, text=True, timeout=5).stdout.strip()
    origin = json.loads(ours.read_text('direct_url.json') or '{}')
    commit: str = origin.get('vcs_info', {}).get('commit_id', '')
    return commit[:7]
