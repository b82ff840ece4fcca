# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a bar on a terminal, in a log a line now and then."""

import os
import sys
import time
from contextlib import suppress
from types import TracebackType
from typing import Any, TextIO

# [s] What takes less is not worth a line in a log; the next ones are so far apart.
_PATIENCE, _APART = 3.0, 5.0


def say(sentence: str, program: str = 'l1slam') -> None:
    """Print one line to standard error, which may be closed, or a file on a full disk."""
    if sys.stderr is None:  # `print` would take standard output, where JSON may be
        return
    line = sentence.replace('\n', '\\n')  # the name of a file may have one in it
    try:
        print(f'{program}: {line}', file=sys.stderr, flush=True)
    except OSError:
        forget(sys.stderr)


def forget(stream: TextIO) -> None:
    """Let Python not fail again on what nobody can read when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class Progress:
    """
    Shows the progress of some work; a context manager.

    Parameters
    ----------
    total : largest number of steps; None: unknown
    unit : name of a step
    quiet : show nothing
    label : name of the work; without it nothing is written to a log
    delay : [s] before the bar appears; shorter work shows none

    """

    def __init__(self, total: float | None, unit: str, quiet: bool = False, label: str = '',
                 delay: float = 0.0):
        self._total = total
        self._unit = unit
        self._label = label
        self._done = 0.0
        self._delay = delay
        self._next_line = time.monotonic() + _PATIENCE if label and not quiet else float('inf')
        self._on_terminal = not quiet and sys.stderr is not None and sys.stderr.isatty()
        self._bar: Any = None

    def __enter__(self) -> 'Progress':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()

    def advance(self, steps: float = 1, note: str = '') -> None:
        """Count some steps; note : what came of them."""
        self._done += steps
        if self._on_terminal:
            self._advance_bar(steps, note)
            return
        now = time.monotonic()
        if now >= self._next_line:
            self._next_line = now + _APART
            # Another solver may go on where one came no further.
            within = self._total is not None and self._done <= self._total
            of_all = f' of {self._total:,.0f}' if within else ''
            say(f'{self._label}: {self._unit} {self._done:,.0f}{of_all}'
                f'{", " if note else ""}{note}')

    def _advance_bar(self, steps: float, note: str) -> None:
        if self._bar is None:
            try:
                from tqdm import tqdm
            except ImportError:  # lines, as in a log
                self._on_terminal = False
                return

            self._bar = tqdm(total=self._total, unit=self._unit, leave=False,
                             desc=self._label or None, delay=self._delay)
        self._bar.total = self._total
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(steps)

    def reach(self, steps: float, total: float) -> None:
        """Go on to so many steps of a total that is known by now."""
        self._total = total
        self.advance(steps - self._done)

    def report(self, iteration: int, cost: float) -> None:
        """Count one iteration of a solver and show its cost."""
        self.advance(1, f'cost {cost:.6g}')
