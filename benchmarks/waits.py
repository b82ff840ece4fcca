# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How long a robot's thread waits for its back end: by the clock, and of the processor.

    python benchmarks/waits.py --datasets DIR [--graph city10000] [--poses 10000] [--rate 200]

A public graph comes keyframe by keyframe, at so many a second, to `Backend(background=True)`: its
odometry, its loops and an update, in one thread. Said are the median, p95, p99 and the longest of
these three calls together, by the clock and in processor time of that thread. Other work on the
machine is in the clock's figures: run it with nothing beside it.
"""

import argparse
import gc
import os
import sys
import time
from pathlib import Path

import peer_environment

os.environ.update(peer_environment.ONE_THREAD)
import numpy as np

from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.io.compilation import STEPS, load
from l1slam_ros.io.formats import read_input
from l1slam_ros.paper.updates import Drive

_EVERY = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
_BUDGET = 0.1  # [s] that an update may take, which with `background=True` it does not wait for


def main() -> None:
    """Measure, and print both rows."""
    summary, _, rest = __doc__.strip().partition('\n')
    parser = argparse.ArgumentParser(description=summary, epilog=rest,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--graph', default='city10000')
    parser.add_argument('--poses', type=int, default=sys.maxsize)
    parser.add_argument('--rate', type=float, default=200.0, help='keyframes per second')
    asked = parser.parse_args()
    load(STEPS)
    drive = Drive.of(read_input(asked.datasets / f'{asked.graph}.g2o').graph)
    gc.freeze()  # no robot has all its messages before it moves, to be searched for garbage
    clock, processor = measure(drive, min(asked.poses, drive.keyframes), asked.rate)
    print(f'{len(clock):,} keyframes of {asked.graph}, {asked.rate:g} a second')
    for name, seconds in ('clock', clock), ('processor', processor):
        figures = 1e3 * np.array([*np.percentile(seconds, [50, 95, 99]), seconds.max()])
        print(f'{name:10}' + ''.join(f'{label} {figure:.1f} ms  ' for label, figure in zip(
            ('median', 'p95', 'p99', 'longest'), figures, strict=True)))
    ratio = np.percentile(clock, 99) / np.percentile(processor, 99)
    print(f'p99 of the clock over that of the processor: {ratio:.2f}')


def measure(drive: Drive, keyframes: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the seconds of each keyframe's calls by the clock and of the processor, (n,)."""
    taken = []
    with Backend(_EVERY, drive.dimension, background=True) as backend:
        due = time.perf_counter()
        for _, (sample, loops) in zip(range(keyframes), drive.messages, strict=False):
            clock, processor = time.perf_counter(), time.thread_time()
            backend.add_odometry(sample)
            for loop in loops:
                backend.add_loop(loop)
            backend.update(_BUDGET)
            taken.append((time.perf_counter() - clock, time.thread_time() - processor))
            now = time.perf_counter()
            due = max(due + 1 / rate, now)
            time.sleep(due - now)
    clocks, processors = np.array(taken).T
    return clocks, processors


if __name__ == '__main__':
    main()
