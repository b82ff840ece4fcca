# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loops of scans: one place is known again, and what only looks like it is not."""

import numpy as np
import pytest
from rooms import WALLS, FrontEndGraph, along, box, drive, glass, random_rays, ranges_at

# Round a block, and along its first side again, a little aside.
WAY = along(np.array([(1.2, 1.4), (10.4, 1.4), (10.5, 6.5), (1.5, 6.5), (1.4, 1.8), (10.4, 1.8)]),
            0.25)
AGAIN = np.flatnonzero(np.hypot(*(WAY[:, :2] - (1.4, 1.8)).T) < 0.01)[-1]
# One side is much wider: the room looks like itself from one place alone.
ROOM = np.vstack((box(0, 0, 16, 8), WALLS[4:]))
# 1.2 m of the outer wall are a way into the next room.
OPENED = np.concatenate((ROOM[1:], [(0, 0, 6.6, 0), (7.8, 0, 16, 0), (6, -4, 10, -4),
                                     (6, -4, 6, 0), (10, -4, 10, 0)]))


def a_door_that_opened(ranges, k, rng):
    return ranges if k < AGAIN else ranges_at(WAY[k], rng, OPENED)


def nothing(ranges, *_):
    return ranges


@pytest.mark.parametrize('spoil, least', [
    (nothing, 6), (random_rays, 6), (glass, 6), (a_door_that_opened, 4)])
def test_a_place_is_known_again_and_no_other_is_taken_for_it(tmp_path, spoil, least):
    """Also where a tenth of the rays ends anywhere, or glass lets a fifth of them through."""
    found = FrontEndGraph(tmp_path, *drive(WAY, walls=ROOM, spoil=spoil))
    assert len(set(found.loops[:, 1].tolist())) >= least
    wrong = found.errors(WAY)[~found.odometry]
    assert np.hypot(*wrong[:, :2].T).max() < 0.1 and abs(wrong[:, 2]).max() < 0.03
    squared = np.einsum('mi,mij,mj->m', wrong, np.linalg.inv(
        found.covariances()[~found.odometry]), wrong)
    assert squared.mean() < 3.0 or spoil is not nothing
    # Neighbours on the way are not compared, and ends are in the order of time.
    way = np.concatenate(([0], np.hypot(*np.diff(WAY[:, :2], axis=0).T).cumsum()))[found.rows]
    assert (np.diff(way[found.loops], axis=1) > 5).all()
