# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Scan-matched odometry: where the robot goes, how certain that is, and what is said when lost."""

import numpy as np
import pytest
from rooms import WALLS, FrontEndGraph, along, box, drive, driven, random_rays, ranges_at
from worlds import between, compose, wrapped

ROUND = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5), (1.5, 1.8)]))
# Another room: of other proportions, with a pillar.
HALL = np.concatenate((box(-4, -3, 9, 5), box(2, 0.5, 2.6, 1.3), box(5.5, -1.5, 6.5, -1),
                       np.array([(-4, 2, -2.5, 2), (9, -3, 7, -1.5)], float).reshape(2, 4)))
ACROSS = along(np.array([(-2.0, -1.5), (4.0, -1.8), (4.4, 3.0), (-1.0, 3.2), (-2.0, 0.0)]))
# Two rooms with a door between them, each with what tells its walls apart.
ROOMS = np.concatenate((box(0, 0, 14, 6), np.array([
    (7, 0, 7, 2.4), (7, 3.4, 7, 6), (2, 6, 2, 5), (2, 5, 3.5, 5), (3.5, 5, 3.5, 6),
    (9, 0, 9, 1.2), (9, 1.2, 11, 0.8), (11, 0.8, 11, 0), (13, 6, 13, 4.5), (13, 4.5, 14, 4.2),
    (8.5, 6, 8.9, 5), (8.9, 5, 9.6, 6)], float)))
THROUGH = along(np.array([(1.0, 1.2), (4.0, 2.9), (8.4, 2.9), (9.0, 4.6), (12.0, 4.0),
                          (12.0, 1.5), (9.0, 2.9), (5.0, 2.9), (1.5, 4.0)]), 1.0)
CORRIDOR = np.array([(-60, -1, 60, -1), (60, 1, -60, 1)], float)


def short(ranges, *_):
    """Leave of a scan what a laser sees that sees 8 m."""
    return np.where(ranges > 8, np.inf, ranges)


def ahead(ranges, *_):
    """Leave of a scan what a laser sees that looks ahead."""
    quarter = len(ranges) // 4
    return np.concatenate((ranges[:quarter], np.full(2 * quarter, np.nan), ranges[-quarter:]))


def test_it_follows_the_robot_where_the_wheels_drift(tmp_path):
    found = FrontEndGraph(tmp_path, *drive(ROUND))
    off = found.off(ROUND)
    assert np.hypot(*off[:, :2].T).max() < 0.1 and abs(wrapped(off[:, 2])).max() < 0.02
    assert found.said == [] and np.allclose(found.way(), found.poses)


def test_a_step_is_as_certain_as_it_claims(tmp_path):
    """In x, y and heading alike, to 20%; of a laser as good as the usual ones, 2 cm."""
    squares = []
    for seed in range(4):
        for way, walls in ((ROUND, WALLS), (ACROSS, HALL)):
            folder = tmp_path / f'{len(squares)}'
            folder.mkdir()
            found = FrontEndGraph(folder, *drive(way, seed, walls, noise=0.02))
            squares.append((found.errors(way)**2 / np.diagonal(
                found.covariances(), axis1=1, axis2=2))[found.odometry])
    assert np.concatenate(squares).mean(axis=0) == pytest.approx(np.ones(3), abs=0.2)


def test_along_a_corridor_it_claims_no_more_than_the_wheels_and_it_is_no_place(tmp_path):
    way = along(np.array([(0.0, 0.1), (6.0, 0.1), (0.0, 0.1)]))
    found = FrontEndGraph(tmp_path, *drive(way, walls=CORRIDOR, spoil=short))
    sigma = np.sqrt(np.diagonal(found.covariances(), axis1=1, axis2=2))
    straight = abs(found.graph.between.measurement[:, 2]) < 0.1
    assert straight.sum() > 15 and (sigma[straight, 0] > 0.03).all()
    assert (sigma[straight, 1] < 0.02).all()
    assert (abs(found.errors(way))[:, 0] < 3 * sigma[:, 0]).all() and not len(found.loops)


def exactly(true, _):
    """Return the steps that the robot makes."""
    return between(true[:-1], true[1:])


def a_quarter_off(true, seed):
    """Return steps off by .25 m and rad a metre: a match from there may be another wall."""
    steps = exactly(true, seed)
    far = np.hypot(steps[:, 0], steps[:, 1])
    return steps + np.random.default_rng(seed).normal(0, 0.25, steps.shape) * far[:, None]


def forwards(true, seed):
    """Return the steps of wheels that count a metre backwards as forwards."""
    steps = exactly(true, seed)
    steps[steps[:, 0] < 0, 0] *= -1
    return steps


ALONG_A_WALL = along(np.array([(1.5, 1.5), (10.5, 1.5)]), 0.75)


@pytest.mark.parametrize('true, walls, steps, seed, most', [
    # Beyond the door little is known; what is seen there contradicts nothing.
    (THROUGH, ROOMS, exactly, 0, 0.1),
    (THROUGH, ROOMS, a_quarter_off, 0, 0.1),
    (np.concatenate((ALONG_A_WALL[:6], ALONG_A_WALL[4:2:-1], ALONG_A_WALL[3:])), WALLS, forwards,
     0, 0.1)], ids=['a door', 'off', 'backwards'])
def test_a_metre_between_scans_it_goes_where_it_goes_whatever_the_wheels_say(
        tmp_path, true, walls, steps, seed, most):
    scans, _ = drive(true, seed, walls, ahead, period=1.0)
    found = FrontEndGraph(tmp_path, scans, driven(steps(true, seed)))
    assert np.hypot(*found.off(true)[-1, :2]) < most


def test_wheels_that_stand_and_turn_the_wrong_way_are_not_followed(tmp_path):
    scans, wheels = drive(ROUND[:80])
    steps = between(wheels[:-1], wheels[1:])
    steps[20:26] = 0.0
    steps[45:48] *= (1, 1, -1)
    found = FrontEndGraph(tmp_path, scans, driven(steps))
    assert np.hypot(*found.off(ROUND)[-1, :2]) < 0.15
    assert any('the scans disagree with the wheels, and are followed' in one for one in found.said)


def test_a_laser_a_little_aside_is_no_reason_to_doubt_the_wheels(tmp_path):
    """It sits 9 cm ahead of where it is said to be, and the robot turns on the spot."""
    true = np.column_stack((np.full((12, 2), (4.0, 1.5)), 0.5 * np.arange(12)))
    laser = compose(true, np.array([0.09, 0.0, 0.0]))
    found = FrontEndGraph(tmp_path, drive(laser)[0], true)
    assert found.said == [] and np.hypot(*found.off(laser)[-1, :2]) < 0.05


def test_carried_away_it_says_so_and_begins_anew(tmp_path):
    scans, wheels = drive(np.concatenate((ROUND[:40], ACROSS[:40])), spoil=lambda ranges, k, rng: (
        ranges if k < 40 else ranges_at(ACROSS[k - 40], rng, HALL)))
    wheels[40:] = compose(wheels[39], between(ACROSS[0], ACROSS[:40]))
    found = FrontEndGraph(tmp_path, scans, wheels)
    assert found.parts == 2 and any(one.startswith(
        'the scans show nothing known any more; a new part of the map begins')
        for one in found.said)


@pytest.mark.parametrize('spoil', [
    # For 1.2 s and less than a metre nothing is seen but the crowd that stands around.
    lambda ranges, k, rng: rng.uniform(0.5, 1.0) + 0.2 * np.sin(
        np.arange(len(ranges)) / 9 + k) if 20 <= k < 26 else ranges,
    lambda ranges, k, _: np.full_like(ranges, np.inf) if 20 <= k < 32 else ranges, random_rays],
    ids=['a crowd', 'blind', 'random rays'])
def test_what_is_not_seen_for_a_while_begins_no_new_part(tmp_path, spoil):
    found = FrontEndGraph(tmp_path, *drive(ROUND[:60], spoil=spoil))
    assert np.hypot(*found.off(ROUND)[-1, :2]) < 0.15


# A robot at 2 m/s, five times a second.
STRAIGHT = np.column_stack((0.4 * np.arange(20), np.zeros(20), np.zeros(20)))
JUMP = 'the wheels jump further than a robot moves; it is taken to go on as before (1 time)'


def blindly(folder, wheels, period=0.2):
    """Return the graph of a drive in which nothing is seen: it goes by the wheels."""
    scans, _ = drive(wheels, spoil=lambda ranges, *_: np.full_like(ranges, np.inf), period=period)
    return FrontEndGraph(folder, scans, wheels)


def began_anew(wheels, k):
    """Return poses (n, 3) of which those from number k on begin at the origin."""
    return np.concatenate((wheels[:k], between(wheels[k], wheels[k:])))


@pytest.mark.parametrize('k', [2, 10])
def test_a_driver_that_begins_anew_is_no_motion(tmp_path, k):
    """At the jump the robot goes on as fast as before."""
    away = compose(np.array([30.0, 2.0, 1.0]), STRAIGHT)
    found = blindly(tmp_path, began_anew(away, k))
    assert JUMP in found.said
    np.testing.assert_allclose(found.off(STRAIGHT), 0, atol=1e-9)


@pytest.mark.parametrize('wheels, period', [
    (STRAIGHT, 0.2), (STRAIGHT[::-1], 0.2), (5 * STRAIGHT, 2.0),
    # Standing, then off at 4 m/s; a world where a step of 2 m and a quarter turn take .2 s.
    (np.maximum(STRAIGHT - STRAIGHT[10], 0) * 2, 0.2),
    (5 * STRAIGHT + (0, 0, 1.5) * (STRAIGHT > 4).any(axis=1)[:, None], 0.2)])
def test_what_a_robot_does_is_no_jump(tmp_path, wheels, period):
    found = blindly(tmp_path, wheels, period)
    assert JUMP not in found.said
    np.testing.assert_allclose(found.off(wheels), 0, atol=1e-9)


def test_scans_carry_a_robot_over_a_jump_of_the_wheels(tmp_path):
    true = along(np.array([(1.5, 1.5), (10.5, 1.5), (10.5, 6.5)]))
    scans, wheels = drive(true)
    found = FrontEndGraph(tmp_path, scans, began_anew(wheels, 70))  # 2 m behind the corner
    assert found.said == [JUMP]
    assert np.hypot(*found.off(true)[:, :2].T).max() < 0.05


@pytest.mark.parametrize('wrong', [0.95, 1.05])
def test_a_bare_corridor_after_another_is_as_long_as_it_is(tmp_path, wrong):
    """What wheels are off by was learnt before: 5% would be a metre."""
    walls = np.concatenate([box(0, 0, 80, 2)] + [
        box(x, 1.8, x + 0.3, 2.0) for x in np.arange(2.0, 20.0, 3.0)])
    true = along(np.array([(3.0, 1.0), (36.0, 1.0)]), 0.3)
    scans, _ = drive(true, 1, walls, short)
    found = FrontEndGraph(tmp_path, scans, true * (wrong, 1, 1))
    assert abs(found.off(true)[-1, 0]) < 0.3
