# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What look-ups of transforms find that are made at once."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

LOOKUPS = Path(__file__).parents[2] / 'benchmarks' / 'ros' / 'lookups.py'


def test_look_ups_made_at_once_are_answered():
    """On a busy machine; at rest `benchmarks/ros/lookups.py` finds next to none that are not."""
    # Each in a domain of its own: most of the time is waiting for messages.
    variables = {name: value for name, value in os.environ.items() if name != 'ROS_DOMAIN_ID'}
    patterns = [subprocess.Popen([sys.executable, LOOKUPS, '5', pattern], env=variables, text=True,
                                 stdout=subprocess.PIPE) for pattern in ('5', '10j')]
    for process in patterns:
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0
        ((total, future),) = re.findall(r'(\d+) look-ups, .* \((\d+)\)', said)
        assert int(total) > 20 and int(future) <= 0.05 * int(total), said
