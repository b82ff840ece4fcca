# SPDX-License-Identifier: Apache-2.0
"""`l1slam` in this process."""

import json

from l1slam_ros.cli.main import main


def run(capsys, *arguments, code=0):
    """Run a command that must end with a code; return its standard output and error."""
    capsys.readouterr()
    found = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert found == code, err
    return out, err


def solve_json(capsys, *arguments):
    """Return what `l1slam solve --json` says."""
    return json.loads(run(capsys, 'solve', *arguments, '--json')[0])
