# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The demo bag is what its README says."""

from pathlib import Path

import numpy as np
from records import read

from bags import recording_of
from l1slam_ros.cli.main import main

DEMO = Path(__file__).parents[2] / 'bags' / 'demo'


def test_the_bag_is_made_by_the_command_its_readme_gives(tmp_path):
    command = next(line.split() for line in (DEMO.parent / 'README.md').read_text().splitlines()
                   if line.startswith('    l1slam simulate'))
    assert command[2] == 'bags/demo'
    assert main(['simulate', str(tmp_path / 'demo'), *command[3:]]) == 0
    made, kept = ([(topic, stamp) for topic, _, stamp, _ in recording_of(bag)]
                  for bag in (tmp_path / 'demo', DEMO))
    assert made == kept
    made, kept = (read(bag).graph.between.measurement for bag in (tmp_path / 'demo', DEMO))
    np.testing.assert_allclose(made, kept, rtol=1e-9, atol=1e-12)
    made, kept = (Path(f'{bag}.false.txt').read_text() for bag in (tmp_path / 'demo', DEMO))
    assert made == kept and len(kept.splitlines()) == 11  # the mark, and ten
