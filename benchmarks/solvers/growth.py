# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Part `growth`: time and memory of a whole solve against the size of the world.

Each world is made and solved in a process of its own, from the odometry chain through seed and
outer loop. Time = c edges^p is fitted to the sparse worlds.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Answer, Row, interleaved, report_progress, row

_FOLDER = Path(__file__).resolve().parents[1]
# Loops enough that there are 1.6 edges to a pose, as in the paper's sparse graphs.
SPARSE = tuple((n, 16 * n // 10) for n in (1_000, 2_000, 5_000, 10_000, 20_000, 50_000))
# Worlds with as many loops as poses, up to what takes minutes.
LARGE = tuple((n, 2 * n) for n in (25_000, 100_000, 200_000, 1_000_000))
DENSE = ((10_000, 64_000), (50_000, 700_000))
PHASES = ('seed', 'solve')
# [s] A world that takes longer than this, all in all, is given up.
_PATIENCE = 1800.0


def measure(repeats: int, limit: float) -> list[Row]:
    """Return a row for each world, and phase of its solution."""
    reports: dict[tuple[int, int], dict[str, Any]] = {}
    measured = interleaved(
        {size: _runner(size, reports) for size in (*SPARSE, *DENSE, *LARGE)}, repeats, limit)
    rows: list[Row] = []
    for size, found in measured.items():
        group = 'sparse' if size in SPARSE else 'large' if size in LARGE else 'dense'
        name = f'world {size[0]} / {size[1]}'
        if not np.isfinite(found.seconds[0]):
            rows.append(row(name, group, 'ours', True, None, edges=size[1]))
            continue
        rows.append(row(name, group, 'ours', True, found, edges=size[1], **reports[size]))
    return rows


def exponent(edges: np.ndarray, seconds: np.ndarray) -> float:
    """Return p of the least squares fit of seconds = c edges^p, in logarithms."""
    return float(np.polyfit(np.log(edges), np.log(seconds), 1)[0])


def _runner(size: tuple[int, int],
            reports: dict[tuple[int, int], dict[str, Any]]) -> Callable[[], Answer]:
    """Return what solves a world in a new process, and notes what that reports."""

    def run() -> Answer:
        report_progress(f'growth: {size[0]} poses, {size[1]} edges')
        command = [sys.executable, '-m', 'solvers.one_world', *map(str, size)]
        try:
            ran = subprocess.run(command, cwd=_FOLDER, capture_output=True, text=True,
                                 check=True, timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            return Answer(np.zeros(0), np.inf)
        reports[size] = json.loads(ran.stdout)
        return Answer(np.zeros(0), sum(reports[size][phase] for phase in PHASES))

    return run
