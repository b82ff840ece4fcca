# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam` in this process."""

import json
import re

import pytest

from l1slam_ros.cli.main import main


def run(capsys, *arguments, code=0):
    """Run a command that must end with a code, if any; return its standard output and error."""
    capsys.readouterr()
    found = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert code in (found, None), err
    return out, err


def solve_json(capsys, *arguments, code=0):
    """Return what `l1slam solve --json` says, which must end with a code."""
    return json.loads(run(capsys, 'solve', *arguments, '--json', code=code)[0])


def help_of(capsys, *arguments):
    """Return what a command says of itself."""
    with pytest.raises(SystemExit) as ended:
        main([*arguments, '--help'])
    assert ended.value.code == 0
    return capsys.readouterr().out


def texts_of(path):
    """Return the texts of an SVG: matplotlib draws outlines, and notes them in comments."""
    return re.findall(r'<!-- (.*?) -->', path.read_text())
