# SPDX-License-Identifier: Apache-2.0
"""`backend` and `replay`: what they say where ROS, or anything else they need, is not there."""

import sys
from importlib import import_module


def backend() -> int:
    """Run the node; return the exit code."""
    return _run('backend', 'run_backend')


def replay() -> int:
    """Play a bag; return the exit code."""
    return _run('replay', 'replay')


def _run(name: str, module: str) -> int:
    try:
        code: int = import_module(f'l1slam_ros.ros.{module}').main()
    except ImportError as error:
        if (error.name or '').startswith('l1slam_ros'):
            raise
        print(f'{name}: {" ".join(str(error).split())}; expected ROS 2 Jazzy: source its setup '
              "file, or `pip install '.[ros]'` here", file=sys.stderr)
        return 1
    return code
