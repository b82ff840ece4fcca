# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""From scans that mislead to a map: it is right, or it is said that it may not be."""

import contextlib
import io
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rooms import (
    WALLS,
    along,
    box,
    drive,
    driven,
    glass,
    mirrored,
    random_rays,
    write_scan_bag,
    write_truth,
)
from worlds import between

from l1slam_ros.cli.main import main

ROUND = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5)] * 2 + [(1.5, 1.8)]))
BACK = np.array([(1.5, 6.4), (1.5, 1.5), (10.5, 1.5), (10.5, 6)])


def mirrored_corridor():
    """Return a drive through a corridor, a hall, and a corridor that is the first in a mirror."""
    first = np.array([(0, -1, 5, -1), (6, -1, 12, -1), (5, -1, 5, -2.5), (6, -1, 6, -2.5),
                      (5, -2.5, 6, -2.5), (0, 1, 3, 1), (3, 1, 3, 2), (3, 2, 4, 2), (4, 2, 4, 1),
                      (4, 1, 12, 1)], float)
    hall = np.array([(12, -1, 12, -4), (12, -4, 18, -4), (18, -4, 18, -1), (12, 1, 12, 4),
                     (12, 4, 18, 4), (18, 4, 18, 1), (0, -1, 0, 1), (30, -1, 30, 1)], float)
    walls = np.concatenate((first, hall, mirrored(first) + (18, 0, 18, 0)))
    way = along(np.array([(1, 0), (29, 0), (29, 0.2), (1, 0.2), (1, 0), (20, 0)], float))
    return way, *drive(way, walls=walls)


def equal_rooms():
    """Return a drive into one of two equal rooms, into the other, and into the first again."""
    room = np.array([(0, 0, 4, 0), (0, 0, 0, 4), (4, 0, 4, 4), (0, 4, 1.5, 4), (2.5, 4, 4, 4),
                     (1, 1.2, 1.8, 1.2), (1, 1.2, 1, 2)], float)
    hall = np.array([(4, 4, 8, 4), (-2, 4, 0, 4), (12, 4, 14, 4), *box(-2, 4, 14, 6)[1:]])
    walls = np.concatenate((room, room + (8, 0, 8, 0), hall))
    inside = np.array([(2, 5), (2, 3), (3.2, 3), (3.2, 0.6), (2.4, 0.6), (2.4, 3), (2, 3), (2, 5)])
    way = along(np.concatenate((inside, inside + (8, 0), inside[:4])))
    return way, *drive(way, walls=walls)


def standing(true, scans, first, last):
    """Return a drive whose wheels stand between two scans."""
    wheels = drive(true)[1]
    steps = between(wheels[:-1], wheels[1:])
    steps[first:last] = 0
    return true, scans, driven(steps)


def carried():
    """Return a drive in which the robot is carried on for 20 s, and goes on."""
    at = len(ROUND) // 3
    hands = ROUND[at] + np.linspace(0, 1, 100)[:, None] * (-3.5, 3.6, 1.4)
    true = np.concatenate((ROUND[:at], hands, along(np.concatenate((hands[-1:, :2], BACK)))))
    return standing(true, drive(true)[0], at - 1, at + 99)


def carried_in_the_dark():
    """Return one in which it is carried for 20 s and no scan is taken."""
    at = len(ROUND) // 3
    true = np.concatenate((ROUND[:at], along(np.concatenate(([(7, 6.2)], BACK)))))
    scans = [replace(scan, stamp=scan.stamp + 20 * 10**9 * (k >= at))
             for k, scan in enumerate(drive(true)[0])]
    return standing(true, scans, at - 1, at)


def carried_elsewhere():
    """Return one that goes on in a room which it has not seen."""
    room = np.array([(40, 0, 46, 0), (46, 0, 46, 9), (46, 9, 40, 7), (40, 7, 40, 0),
                     (42, 0, 42, 1.2), (44, 8.3, 44, 6.5), (46, 4, 45, 4.8)], float)
    before = len(ROUND) // 2
    other = along(np.array([(41, 2.0), (45, 2.0), (45, 5.5), (41.5, 5.5), (41.5, 2.5)]))
    true = np.concatenate((ROUND[:before], other))
    return standing(true, drive(true, walls=np.concatenate((WALLS, room)))[0],
                    before - 1, before)


def upside_down():
    """Return a drive with a laser that hangs, which nobody says."""
    scans, wheels = drive(ROUND)
    return ROUND, [replace(scan, ranges=np.roll(scan.ranges[::-1], 1)) for scan in scans], wheels


def without_wheels():
    """Return a drive of a robot without encoders: its odometry never moves."""
    scans, wheels = drive(ROUND)
    return ROUND, scans, np.zeros_like(wheels)


CASES = {
    'a tenth of the rays is random': lambda: (ROUND, *drive(ROUND, spoil=random_rays)),
    'a fifth goes through glass': lambda: (ROUND, *drive(ROUND, spoil=glass)),
    'a mirrored corridor': mirrored_corridor, 'two equal rooms': equal_rooms,
    'carried away': carried, 'carried away in the dark': carried_in_the_dark,
    'carried elsewhere': carried_elsewhere, 'upside down': upside_down,
    'without wheels': without_wheels}


@pytest.fixture(scope='module')
def solved(tmp_path_factory):
    """Return what gives the exit code of `solve`, and what it says; each case is solved once."""
    @cache
    def solve(case):
        folder = tmp_path_factory.mktemp('case')
        true, scans, wheels = CASES[case]()
        write_scan_bag(folder / 'bag', scans, wheels,
                       mount=((0.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0)))
        write_truth(folder / 'truth.csv', scans, true)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            code = main(['solve', str(folder / 'bag'), '--scans', '/scan', '--odom-topic',
                         '/wheels', '--reference', str(folder / 'truth.csv'), '--json'])
        return code, json.loads(printed.getvalue())

    return solve


@pytest.mark.parametrize('case', CASES)
def test_no_wrong_map_in_silence(case, solved):
    code, said = solved(case)
    assert said['ate'] < 0.1 or (code == 4 and said['status'] == 'doubtful'), said
    # That scans turn against the wheels is said where they do, and nowhere else.
    hangs = any(' is the laser upside down? ' in sentence for sentence in said['warnings'])
    assert hangs == (case == 'upside down')


@pytest.mark.parametrize('case', list(CASES)[:4])
def test_what_is_hard_to_see_does_not_spoil_the_map(case, solved):
    code, said = solved(case)
    assert code == 0 and said['ate'] < 0.1 and said['loops'] - len(said['rejected']) >= 3


def test_a_drive_in_parts_that_nothing_joins_is_doubtful(solved):
    code, said = solved('carried elsewhere')
    assert code == 4 and said['parts'] == 2
    assert [doubt['kind'] for doubt in said['doubts']] == ['parts']
    assert ' joins 2 parts of the map, between ' in said['warnings'][-1]


def test_a_drive_of_which_scans_alone_show_the_motion_is_doubtful(solved):
    code, said = solved('without wheels')
    assert code == 4 and 'no wheels' in [doubt['kind'] for doubt in said['doubts']]
    assert any('the odometry beside the scans never moves' in one for one in said['warnings'])
