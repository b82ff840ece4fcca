# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
How much memory odometry takes that makes few keyframes.

    python benchmarks/ros/history.py [MESSAGES]

The back end is fed with a million samples at 1,000 per second, of a robot that stands, that goes
back and forth within a keyframe's way, and the same seen by odometry that shakes by a millimetre.
Loops may yet name any time, so the motion between keyframes is kept: the samples that
interpolation between their neighbours would miss by more than .1 mm or .1 mrad, which is the least
standard deviation that a measurement may claim. Whatever is not redundant in that sense stays, at
32 bytes in the plane and 64 in space.
"""

import argparse
import resource
import time

import numpy as np

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.running.backend import Backend, BackendOptions

MESSAGES, RATE = 1_000_000, 1_000
_SECOND = 10**9  # [ns]
_WAY, _SHAKES = 0.2, 1e-3  # [m]
_REPORTS = 4
_COVARIANCE = 1e-8 * np.eye(6)


def position(kind: str, seconds: float, rng: np.random.Generator) -> float:
    """Return where the robot is [m]."""
    # There and back in 20 s, as a machine that keeps its speed.
    way = 0.0 if kind == 'stands' else _WAY * abs(1 - seconds / 10 % 2)
    return way + (rng.normal(0, _SHAKES) if kind == 'shakes' else 0.0)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('messages', type=int, nargs='?', default=MESSAGES)
    count = parser.parse_args().messages
    for kind in ('stands', 'goes', 'shakes'):
        for source in ('model', 'increment'):
            _run(kind, source, count)


def _run(kind: str, source: str, count: int) -> None:
    rng = np.random.default_rng(0)
    backend = Backend(BackendOptions.from_mapping({'odometry': {'covariance_source': source}}))
    pose3 = se2.to_pose3(np.zeros((1, 3)))[0]
    before, began = _resident(), time.process_time()
    print(f'{kind}, covariance: {source}', flush=True)
    for k in range(1, count + 1):
        pose = pose3.copy()
        pose[0] = position(kind, k / RATE, rng)
        backend.add_odometry(OdometrySample(k * _SECOND // RATE, pose, _COVARIANCE, _COVARIANCE))
        if k % (count // _REPORTS) == 0:
            kept = len(backend._keeper._builder.robots[0].track)
            print(f'  {k:9,} messages: {_resident() - before:6.1f} MB more, {kept:9,} samples '
                  f'kept, {len(backend.snapshot().stamps)} keyframes, '
                  f'{(time.process_time() - began) / k * 1e6:.0f} us each', flush=True)


def _resident() -> float:
    """Return the resident memory of this process [MB]."""
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


if __name__ == '__main__':
    main()
