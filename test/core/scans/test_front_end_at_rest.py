# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Keyframes that have yet to ask, and comparisons that wait, go on while no scan comes."""

from dataclasses import replace

import numpy as np
from rooms import along, scan_at

from l1slam_ros.core.scans.front_end import FrontEndOptions, ScanFrontEnd
from l1slam_ros.core.scans.loops import LoopOptions

# Along one side of a block, and back.
WAY = np.concatenate((along(np.array([(1.2, 1.4), (10.4, 1.4)]), 0.5),
                      along(np.array([(10.0, 1.8), (1.4, 1.8)]), 0.5)))


def test_what_waits_is_looked_for_a_little_at_a_time_while_no_scan_comes():
    rng = np.random.default_rng(0)
    front_end = ScanFrontEnd(FrontEndOptions(loop=LoopOptions(apart=5.0)))
    for k, pose in enumerate(WAY):
        front_end.add(replace(scan_at(pose, rng), stamp=k + 1), pose)
    poses = np.array([keyframe.pose for keyframe in front_end.keyframes])
    front_end.place(poses, np.tile((0.1, 0.02), (len(poses), 1)))
    found = front_end.loops()
    calls = 1
    assert front_end.waiting > 0
    while front_end.waiting:
        found += front_end.loops()
        calls += 1
    assert len(found) >= 2 and calls >= 3
