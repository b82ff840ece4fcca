# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How anything here is measured: by turns, in one process, medians; and the record of it.

Machines differ from day to day and from minute to minute, so whatever is compared is run in turn,
round after round: a slow minute then hits all alike. Time is the processor's, of all threads of
the process: on one idle core that is the wall's, on a busy one it leaves out what others take.
"""

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from l1slam_ros.core.geometry.manifold import Array

_PACKAGES = ('numpy', 'scipy', 'gtsam', 'g2opy', 'clarabel', 'highspy', 'ortools')

Key = TypeVar('Key')
clock = time.process_time


@dataclass(frozen=True)
class Answer:
    """What a solver returned, a step or poses, and the time [s] it took."""

    x: Array
    seconds: float


@dataclass(frozen=True)
class Measured:
    """All times [s] of one thing, and its last answer; whoever took too long ran only once."""

    seconds: tuple[float, ...]
    x: Array

    @property
    def median(self) -> float:
        """Of the seconds."""
        return statistics.median(self.seconds)


@dataclass(frozen=True)
class Row:
    """
    One figure of a part: what was measured, and the median [s], None where it was not reached.

    problem, solver : of which, by whom; ours : whether it is ours; group : what its ratios are
    within, e.g. a start; seconds, runs, least, most : median, how many, extremes [s]; numbers :
    whatever else, by name.
    """

    problem: str
    group: str
    solver: str
    ours: bool
    seconds: float | None
    runs: int = 0
    least: float | None = None
    most: float | None = None
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells it from the other rows of its part."""
        return self.problem, self.group, self.solver


def row(problem: str, group: str, solver: str, ours: bool, measured: Measured | None,
        **numbers: Any) -> Row:
    """Return the row of a measurement; None: what was wanted was not reached."""
    if measured is None:
        return Row(problem, group, solver, ours, None, numbers=numbers)
    seconds = measured.seconds
    return Row(problem, group, solver, ours, measured.median, len(seconds), min(seconds),
               max(seconds), numbers)


def timed(work: Callable[[], Array]) -> Answer:
    """Return what `work` returns, and its time."""
    began = clock()
    x = work()
    return Answer(x, clock() - began)


def interleaved(
    runs: Mapping[Key, Callable[[], Answer]], repeats: int, limit: float
) -> dict[Key, Measured]:
    """
    Run each once to warm up, then all of them in turn, `repeats` times.

    What took longer than `limit` [s] the first time is not run again: that time is its result.
    """
    first = {key: run() for key, run in runs.items()}
    seconds: dict[Key, list[float]] = {key: [] for key in runs}
    last = dict(first)
    for _ in range(repeats):
        for key, run in runs.items():
            if first[key].seconds <= limit:
                last[key] = run()
                seconds[key].append(last[key].seconds)
    return {key: Measured(tuple(seconds[key] or [first[key].seconds]), last[key].x)
            for key in runs}


def report_progress(text: str) -> None:
    """Say on standard error what is being measured."""
    print(text, file=sys.stderr, flush=True)


def record(part: str, rows: list[Row]) -> dict[str, Any]:
    """Return what is written about a part: the machine, the versions, the rows."""
    return {
        'part': part,
        'machine': {'cpu': _cpu_model(), 'cores': os.cpu_count(),
                    'used': len(os.sched_getaffinity(0))},
        'versions': {'python': platform.python_version()} | {
            name: version(name) for name in _PACKAGES if _is_there(name)},
        'rows': [asdict(r) for r in rows],
    }


def rows_of(recorded: Mapping[str, Any]) -> list[Row]:
    """Return the rows of what `record` returned."""
    return [Row(**fields) for fields in recorded['rows']]


def _is_there(package: str) -> bool:
    try:
        return bool(version(package))
    except PackageNotFoundError:
        return False


def _cpu_model() -> str:
    information = Path('/proc/cpuinfo')
    lines = information.read_text().splitlines() if information.exists() else []
    models = [line.split(':', 1)[1].strip() for line in lines if line.startswith('model name')]
    return models[0] if models else platform.processor() or platform.machine()
