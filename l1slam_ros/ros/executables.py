# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The entry points `backend`, `scan_loops`, `replay` and the demo, before ROS is imported.

They check the arguments and the middleware, and print one line if ROS or another library is
missing.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module

from l1slam_ros.core.errors import L1SlamError, optional_libraries
from l1slam_ros.core.options import Options
from l1slam_ros.ros.run_backend import leave
from l1slam_ros.ros.shell.arguments import help_of, split
from l1slam_ros.ros.shell.middleware import use_what_is_there

_BAD_INPUT = 2


def backend() -> int:
    """Run the back end; return the exit code: 2 for an unknown argument."""
    def options() -> Options:
        from l1slam_ros.io.node_options import NodeOptions

        return NodeOptions()

    return _run_node('backend', 'run_backend', options)


def scan_loops() -> int:
    """Run the scan front end; return the exit code: 2 for an unknown argument."""
    def options() -> Options:
        from l1slam_ros.ros.scans.options import ScanLoopsOptions

        return ScanLoopsOptions()

    return _run_node('scan_loops', 'scans.run_scan_loops', options)


def replay() -> int:
    """Play a bag; return the exit code."""
    return _run('replay', 'replay')


def demo() -> int:
    """Run the demo; return the exit code."""
    return _run('demo', 'demo')


def _run_node(name: str, module: str, options: Callable[[], Options]) -> int:
    """Run a node, whose only argument besides those of ROS is --help."""
    own, _ = split(sys.argv[1:])
    if '-h' in own or '--help' in own:
        with suppress(BrokenPipeError):  # the reader may have closed the pipe
            print(help_of(name, options()))
        leave(0)
    if own:
        print(f'{name}: {own[0]!r} is not an argument of {name}; expected arguments of ROS, after '
              f'--ros-args, see {name} --help', file=sys.stderr)
        return _BAD_INPUT
    return _run(name, module)


def _run(name: str, module: str) -> int:
    try:
        if sentence := use_what_is_there():
            print(f'{name}: {sentence}', file=sys.stderr, flush=True)
        with optional_libraries():
            code: int = import_module(f'l1slam_ros.ros.{module}').main()
    except L1SlamError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return _BAD_INPUT
    except ImportError as error:
        if (error.name or '').startswith('l1slam_ros'):
            raise
        print(f'{name}: {" ".join(str(error).split())}; expected ROS 2 Jazzy: source its setup '
              "file, or `pip install '.[ros]'` here", file=sys.stderr)
        return 1
    return code


if __name__ == '__main__':  # by `make demo`, as by a command
    sys.exit(demo())
