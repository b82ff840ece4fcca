# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The lines that every file of Python begins with, and a command that puts them where they are not.

    python test/headers.py

The first is what ament_copyright looks for, the next are the notice of the Apache licence in as
few lines as may be: that linter knows no SPDX (ament_lint issues 246 and 462), but does not look
at where lines break.
"""

from pathlib import Path

ROOT = Path(__file__).parents[1]
SPDX = '# SPDX-License-Identifier: Apache-2.0\n'
HEADER = """\
# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
""" + SPDX


def files_of_python() -> list[Path]:
    """Return those of the checkout that are not empty."""
    folders = (ROOT / name for name in ('l1slam_ros', 'test', 'benchmarks', 'config', 'doc',
                                      'launch'))
    found = [path for folder in folders for path in sorted(folder.rglob('*.py'))]
    return [path for path in (ROOT / 'setup.py', *found) if path.stat().st_size]


def without_header(path: Path) -> str:
    """Return what a file says below its header."""
    return path.read_text().removeprefix(HEADER)


def put_headers() -> list[Path]:
    """Put the header before what has none; return what was changed."""
    changed = [path for path in files_of_python() if not path.read_text().startswith(HEADER)]
    for path in changed:
        path.write_text(HEADER + path.read_text().removeprefix(SPDX))
    return changed


if __name__ == '__main__':
    for changed in put_headers():
        print(changed.relative_to(ROOT))
