# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A live map and the map of its recording are measured alike."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rooms import along, drive, write_log

from l1slam_ros.cli.main import main
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.scans.points import Mount
from l1slam_ros.io.scans.carmen import read_carmen
from l1slam_ros.io.scans.to_graph import map_scans

sys.path.append(str(Path(__file__).parents[1] / 'benchmarks' / 'ros'))
path_error = importlib.import_module('path_error')


@pytest.mark.parametrize('each', [1, 9])
def test_it_is_the_error_that_solve_prints(each, rng, tmp_path, capsys):
    """Of truth that is denser than the map, and of truth that is sparser."""
    true = along(np.array([(1.5, 1.5), (9.5, 1.5), (9.5, 3)]))
    scans, wheels = drive(true)
    log = tmp_path / 'drive.log'
    write_log(log, scans, wheels)
    recorded = read_carmen(log)
    table = tmp_path / 'truth.csv'
    stamps = np.array([scan.stamp for scan in recorded.scans])
    noisy = true[: len(stamps)] + 0.1 * rng.standard_normal((len(stamps), 3)) * (1, 1, 0)
    table.write_text('stamp,x,y,theta\n' + ''.join(
        f'{stamp * 1e-9:.9f},{x},{y},{t}\n'
        for stamp, (x, y, t) in zip(stamps[::each], noisy[::each], strict=True)))
    main(['solve', str(log), '--reference', str(table), '--json'])
    said = json.loads(capsys.readouterr().out)
    made = map_scans(zip(recorded.scans, recorded.wheels, strict=True), Mount())
    path, graph = made.path, made.record.graph.between
    poses = [np.zeros(3)]
    for step in graph.measurement[graph.is_odometry]:
        poses.append(se2.compose(poses[-1][None], step[None])[0])
    # On this way there is no loop, so that the map is the odometry.
    assert graph.is_odometry.all()
    found = path_error.path_error(made.record.times, np.array(poses), path.stamps, path.poses,
                                  table)
    assert found == pytest.approx(said['ate'], abs=1e-6)
    assert found > 0.05
