# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The entry point `l1slam`: an interrupt at any time ends it with one exit code and no traceback.

It imports next to nothing before that holds.
"""
# PYTHON_ARGCOMPLETE_OK

import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn

_INTERRUPTED = 130
# [s] Between an interrupt that a destructor hid, and the next one.
_MOMENT = 0.001
# The signals that have come.
_interrupts: list[int] = []


def main() -> int:
    """Run the command of this process; return its exit code, see `l1slam --help`."""
    # A process in the background of a script ignores SIGINT.
    taken = [number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
             if signal.getsignal(number) != signal.SIG_IGN]
    try:
        for number in taken:
            signal.signal(number, _interrupt)
        sys.unraisablehook = _unraisable
        from l1slam_ros.cli import main as command

        code = command.main(sys.argv[1:])
    except BaseException:
        # Amid an import or a callback, C code makes an error of its own of KeyboardInterrupt.
        if not _interrupts:
            raise
    finally:  # the end of Python has nothing to say about one
        for number in taken:
            signal.signal(number, signal.SIG_DFL)
    return _INTERRUPTED if _interrupts else code


def _interrupt(number: int, frame: 'FrameType | None') -> 'NoReturn':
    _interrupts.append(number)
    raise KeyboardInterrupt


def _unraisable(unraisable: 'sys.UnraisableHookArgs') -> None:
    """Interrupt again, in a moment, what was interrupted in a destructor, which hides that."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, _MOMENT)
    else:
        sys.__unraisablehook__(unraisable)
