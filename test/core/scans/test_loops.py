# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Loops: one place is known again, and what only looks like it is not."""

import numpy as np
import pytest
from rooms import WALLS, along, box, glass, mirrored, random_rays, ranges_at, scan_at

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.scans.loops import LoopFinder
from l1slam_ros.core.scans.points import Scan, points_of
from l1slam_ros.core.scans.submaps import AROUND, Keyframe

# Along one side of a block, and back on the way where the robot came from, half a metre aside.
OUT = along(np.array([(1.2, 1.4), (10.4, 1.4)]), 0.5)
AGAIN = along(np.array([(10.0, 1.8), (1.4, 1.8)]), 0.5)


def keyframes_at(poses, walls=WALLS, seed=0, spoil=None, start=(), farthest=30.0):
    """Return keyframes at true poses (n, 3), with what is seen there; they follow `start`."""
    rng = np.random.default_rng(seed)
    keyframes = list(start)
    way = start[-1].travelled + 20.0 if start else 0.0
    for k, pose in enumerate(poses):
        if spoil is None:
            scan = scan_at(pose, rng, walls, farthest=farthest)
        else:
            ranges = spoil(ranges_at(pose, rng, walls), k, rng)
            scan = Scan(0, ranges, 0.0, 2 * np.pi / len(ranges), 0.05, farthest)
        keyframes.append(Keyframe(k, pose, points_of(scan), 0, way + 0.5 * k))
    return keyframes


def loops_of(keyframes, first, off=(0.0, 0.0, 0.0), sigma=(1.0, 0.1)):
    """Return the loops that those from `first` on find, where the map has these off (3,)."""
    poses = np.array([keyframe.pose for keyframe in keyframes])
    poses[first:] = se2.compose(np.tile(off, (len(poses) - first, 1)), poses[first:])
    finder, spread = LoopFinder(keyframes), np.tile(sigma, (len(keyframes), 1))
    # The maps of the first few would hold keyframes from before the jump, too.
    for j in range(first + AROUND, len(keyframes)):
        finder.ask(j, poses, spread)
    return finder.find(finder.waiting)


def errors(loops, keyframes):
    """Return what is wrong with loops, (l, 3) in the axes of their ends."""
    return np.array([se2.between(loop.measurement[None], se2.between(
        keyframes[loop.i].pose[None], keyframes[loop.j].pose[None]))[0] for loop in loops])


@pytest.mark.parametrize('spoil', [None, random_rays, glass])
def test_a_place_is_known_again_from_the_other_side(spoil):
    """Also where a tenth of the rays ends anywhere, or glass lets a fifth of them through."""
    keyframes = keyframes_at(AGAIN, seed=1, spoil=spoil, start=keyframes_at(OUT, spoil=spoil))
    loops = loops_of(keyframes, len(OUT), off=(1.0, -0.6, 0.15))
    assert len({loop.j for loop in loops}) >= 6
    wrong = errors(loops, keyframes)
    assert np.hypot(*wrong[:, :2].T).max() < 0.1 and abs(wrong[:, 2]).max() < 0.03


def test_what_a_loop_says_is_as_certain_as_it_claims():
    nis = []
    for seed in range(3):
        keyframes = keyframes_at(AGAIN, seed=2 * seed + 1, start=keyframes_at(OUT, seed=2 * seed))
        loops = loops_of(keyframes, len(OUT))
        nis += [e @ np.linalg.solve(loop.covariance, e)
                for e, loop in zip(errors(loops, keyframes), loops, strict=True)]
    assert len(nis) > 15 and np.mean(nis) < 3.0


def test_a_mirrored_room_is_not_the_same_room():
    """Of the same size, with a wall across a corner and a cupboard: what differs is a sixth."""
    room = np.concatenate((box(0, -3, 8, 3), box(1.5, 1.6, 3.5, 3), [(6.5, 3, 8, 1.2)]))
    way = along(np.array([(1.0, 0.0), (7.0, 0.0)]), 0.5)
    start = keyframes_at(way, room)
    for walls, same in ((room, True), (mirrored(room), False)):
        keyframes = keyframes_at(way + (0.1, 0.05, 0), walls, 1, start=start)
        assert bool(loops_of(keyframes, len(way), sigma=(2.0, 1.0))) == same


def test_a_corridor_is_no_place():
    walls = np.array([(-60, -1, 60, -1), (60, 1, -60, 1)], float)
    corridor = along(np.array([(0.0, 0.1), (6.0, 0.1)]), 0.5)
    keyframes = keyframes_at(corridor, walls, 1, start=keyframes_at(corridor, walls, farthest=8.0),
                             farthest=8.0)
    assert loops_of(keyframes, len(corridor)) == []


def test_a_door_that_opened_does_not_hide_the_place():
    """1.2 m of the outer wall are a way into the next room now."""
    opened = np.concatenate((
        WALLS[1:], [(0, 0, 6.6, 0), (7.8, 0, 12, 0), (6, -4, 10, -4), (6, -4, 6, 0),
                    (10, -4, 10, 0)]))
    keyframes = keyframes_at(AGAIN, opened, 1, start=keyframes_at(OUT))
    loops = loops_of(keyframes, len(OUT))
    assert len({loop.j for loop in loops}) >= 4
    assert np.hypot(*errors(loops, keyframes)[:, :2].T).max() < 0.1


def test_neighbours_on_the_way_are_not_compared():
    keyframes = keyframes_at(OUT[:8])
    assert loops_of(keyframes, 1) == []


def test_keyframes_ask_once_their_surroundings_are_known():
    keyframes = keyframes_at(OUT[:12])
    growing = keyframes[:8]
    finder = LoopFinder(growing)
    assert not len(finder.due())
    growing += keyframes[8:]
    due = finder.due()
    assert len(due) and due.max() < len(growing) - 4 and not len(finder.due())


@pytest.mark.parametrize(('step', 'ask'), [(1.5, 1), (1.0, 1), (0.5, 2), (0.25, 4), (0.0, 40)])
def test_keyframes_ask_by_the_way_and_not_by_their_number(step, ask):
    """Of a log with few scans each asks, of one that turns on the spot the first."""
    points = keyframes_at(OUT[:1])[0].points
    growing, due = [], []
    finder = LoopFinder(growing)
    for k in range(40):
        growing.append(Keyframe(k, np.array((step * k, 0.0, 0.0)), points, 0, step * k))
        due += finder.due().tolist()
    assert due == list(range(4, 36, ask))


@pytest.mark.parametrize(('first', 'last', 'compared'), [
    ((2.0, 1.5, 0.0), (9.0, 1.5, np.pi), 1), ((5.0, 1.5, np.pi), (6.0, 1.5, 0.0), 0)])
def test_what_is_compared_saw_the_same_whether_or_not_it_stood_there(first, last, compared):
    """Of a laser that looks ahead: of two that face each other, and of two back to back."""
    def ahead(ranges, *_):
        ranges[60:-60] = np.inf
        return ranges

    def nothing(ranges, *_):
        return np.full_like(ranges, np.inf)

    keyframes = keyframes_at(np.array([first]), spoil=ahead)
    keyframes = keyframes_at(np.full((9, 3), 100.0), spoil=nothing, start=keyframes)
    keyframes = keyframes_at(np.array([last]), spoil=ahead, start=keyframes)
    finder = LoopFinder(keyframes)
    finder.ask(10, np.array([keyframe.pose for keyframe in keyframes]), np.ones((11, 2)))
    assert finder.waiting == compared
