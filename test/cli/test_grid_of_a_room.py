# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid of a drive agrees with the room, as a map server reads it."""

import numpy as np
import yaml
from command import run
from PIL import Image
from rooms import WALLS, along, drive, write_whole_log
from scipy.spatial import KDTree

ROUND = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5), (1.5, 1.8)]), 0.3)


def test_what_is_occupied_is_wall_and_what_is_free_is_not(tmp_path, capsys):
    """As nav2's map_io.cpp has it: occupancy by shade, the lower left pixel at the origin."""
    write_whole_log(tmp_path / 'a.log', *drive(ROUND))
    run(capsys, 'solve', tmp_path / 'a.log', '--grid', tmp_path / 'room.pgm', code=None)
    document = yaml.safe_load((tmp_path / 'room.yaml').read_text())
    shade = np.array(Image.open(tmp_path / document['image'])).astype(float)
    assert document['mode'] == 'trinary' and document['negate'] == 0
    probability = ((255 - shade) / 255)[::-1].T
    occupied, free = (probability > document['occupied_thresh'],
                      probability < document['free_thresh'])
    # The map begins at the first pose, (1.5, 1.5) of the room.
    centres = 1.5 + np.array(document['origin'][:2]) + document['resolution'] * (
        0.5 + np.stack(np.meshgrid(*map(np.arange, probability.shape), indexing='ij'), axis=2))
    # Walls sampled each centimetre, for an independent drawing of the room.
    part = np.linspace(0, 1, 1200)[:, None, None]
    walls = KDTree((WALLS[:, :2] + part * (WALLS[:, 2:] - WALLS[:, :2])).reshape(-1, 2))
    distance = walls.query(centres)[0]
    assert (distance[occupied] < 0.08).mean() > 0.97
    assert (distance[free] > 0.02).mean() > 0.97
    x, y = np.moveaxis(centres, 2, 0)
    block = (x > 3.2) & (x < 8.8) & (y > 3.2) & (y < 4.8)
    outside = (x < -0.2) | (x > 12.2) | (y < -0.2) | (y > 8.2)
    assert not (occupied | free)[block | outside].any(), 'nothing looked there'
    lane = (x > 0.5) & (x < 11) & (y > 0.9) & (y < 1.9)
    assert free[lane].mean() > 0.99
