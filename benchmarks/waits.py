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
                               [--turn 0.005]

A public graph comes keyframe by keyframe, at so many a second, to `Backend(background=True)`: its
odometry, its loops and an update, in one thread. Said are the median, p95, p99 and the longest of
these calls together, by the clock and in processor time of that thread, and the longest single
call. Other work on the machine is in the clock's figures: run it with nothing beside it.

An update that has given up the interpreter's lock waits up to one turn to get it back, the switch
interval of Python. `--turn` sets it: 0.005 s is Python's own, 0.0005 s that of the node.
"""

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import peer_environment

os.environ.update(peer_environment.ONE_THREAD)
import numpy as np

from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.io.formats import read_input
from l1slam_ros.paper.updates import Drive

_EVERY = BackendOptions(KeyframeOptions(0.0, 0.0, 0.0), OdometryOptions('increment'))
_BUDGET = 0.1  # [s] that an update may take, which with `background=True` it does not wait for


class Taken(NamedTuple):
    """
    Seconds that calls took.

    Of each keyframe's calls, (n,): the sum by the clock and of the processor, and the longest one
    by the clock and of the processor.
    """

    clock: np.ndarray
    processor: np.ndarray
    call_clock: np.ndarray
    call_processor: np.ndarray


def main() -> None:
    """Measure, and print both rows."""
    summary, _, rest = __doc__.strip().partition('\n')
    parser = argparse.ArgumentParser(description=summary, epilog=rest,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--datasets', type=Path, required=True)
    parser.add_argument('--graph', default='city10000')
    parser.add_argument('--poses', type=int, default=sys.maxsize)
    parser.add_argument('--rate', type=float, default=200.0, help='keyframes per second')
    parser.add_argument('--turn', type=float, default=sys.getswitchinterval(),
                        help='switch interval of the interpreter, in seconds')
    asked = parser.parse_args()
    sys.setswitchinterval(asked.turn)
    drive = Drive.of(read_input(asked.datasets / f'{asked.graph}.g2o').graph)
    gc.freeze()  # no robot has all its messages before it moves, to be searched for garbage
    taken = measure(drive, min(asked.poses, drive.keyframes), asked.rate)
    print(f'{len(taken.clock):,} keyframes of {asked.graph}, {asked.rate:g} a second, '
          f'turns of {1e3 * asked.turn:g} ms')
    for name, seconds, call in (('clock', taken.clock, taken.call_clock),
                                ('processor', taken.processor, taken.call_processor)):
        figures = 1e3 * np.array([*np.percentile(seconds, [50, 95, 99]), seconds.max()])
        print(f'{name:10}' + ''.join(f'{label} {figure:.1f} ms  ' for label, figure in zip(
            ('median', 'p95', 'p99', 'longest'), figures, strict=True))
            + f'longest call {1e3 * call.max():.1f} ms')
    ratio = np.percentile(taken.clock, 99) / np.percentile(taken.processor, 99)
    print(f'p99 of the clock over that of the processor: {ratio:.2f}')


def measure(drive: Drive, keyframes: int, rate: float) -> Taken:
    """Return what the calls of each keyframe took."""
    taken = []
    with Backend(_EVERY, drive.dimension, background=True) as backend:
        due = time.perf_counter()
        for _, (sample, loops) in zip(range(keyframes), drive.messages, strict=False):
            calls: list[Callable[[], object]] = [
                partial(backend.add_odometry, sample),
                *(partial(backend.add_loop, loop) for loop in loops),
                partial(backend.update, _BUDGET)]
            seconds = np.array([_seconds(call) for call in calls])
            taken.append(Taken(*seconds.sum(axis=0), *seconds.max(axis=0)))
            now = time.perf_counter()
            due = max(due + 1 / rate, now)
            time.sleep(due - now)
    return Taken(*np.array(taken).T)


def _seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Return what a call takes by the clock and of the processor [s]."""
    clock, processor = time.perf_counter(), time.thread_time()
    call()
    return time.perf_counter() - clock, time.thread_time() - processor


if __name__ == '__main__':
    main()
