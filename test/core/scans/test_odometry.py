# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Scan-matched odometry: where the robot goes, how certain that is, and what it says when lost."""

import numpy as np
import pytest
from rooms import WALLS, along, box, drive, random_rays, ranges_at, ranges_on_the_way

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.scans import odometry as module
from l1slam_ros.core.scans.front_end import ScanFrontEnd
from l1slam_ros.core.scans.matching import Match
from l1slam_ros.core.scans.odometry import ScanKeyframes, ScanOdometry
from l1slam_ros.core.scans.points import Scan, points_of

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
THROUGH = np.array([(1.0, 1.2), (4.0, 2.9), (8.4, 2.9), (9.0, 4.6), (12.0, 4.0), (12.0, 1.5),
                    (9.0, 2.9), (5.0, 2.9), (1.5, 4.0)])


def steps_of(true, walls=WALLS, seed=0, spoil=None, odometry=None, noise=0.01):
    """Return what odometry says of a drive, and how its steps between keyframes are wrong."""
    scans, wheels = drive(true, seed, walls, spoil, noise)
    odometry = ScanOdometry() if odometry is None else odometry
    steps = [odometry.add(scan.stamp, points_of(scan), pose)
             for scan, pose in zip(scans, wheels, strict=True)]
    at = [k for k, step in enumerate(steps) if step.keyframe is not None]
    poses = np.array([step.pose for step in steps])[at]
    wrong = se2.local(se2.between(true[at][:-1], true[at][1:]),
                      se2.between(poses[:-1], poses[1:]))
    return steps, wrong, np.array([steps[k].covariance for k in at[1:]])


def led(scans, steps, start=(0.0, 0.0, 0.0)):
    """Return the odometry of scans whose wheels make these steps, and its poses, (n, 3)."""
    odometry = ScanOdometry()
    wheels = [np.asarray(start)]
    for step in steps:
        wheels.append(se2.compose(wheels[-1][None], step[None])[0])
    return odometry, np.array([odometry.add(scan.stamp, points_of(scan), pose).pose
                               for scan, pose in zip(scans, wheels, strict=True)])


def test_it_follows_the_robot_where_the_wheels_drift():
    steps, _, _ = steps_of(ROUND)
    poses = np.array([step.pose for step in steps])
    true = se2.between(np.broadcast_to(ROUND[0], ROUND.shape), ROUND)
    assert np.hypot(*(poses - true)[:, :2].T).max() < 0.1
    assert abs(se2.wrap(poses[:, 2] - true[:, 2])).max() < 0.02
    assert all(step.said == '' for step in steps)


@pytest.mark.parametrize('options, apart', [
    (ScanKeyframes(0.0, 0.0, 0.0), 1), (ScanKeyframes(0.0, 0.0, 1.0), 5),
    (ScanKeyframes(0.0, 0.0, 0.05), 1), (ScanKeyframes(0.0, 100.0, 0.0), 0)])
def test_a_threshold_of_0_is_off_and_without_any_each_scan_is_a_keyframe(options, apart):
    steps, _, _ = steps_of(ROUND[:31], odometry=ScanOdometry(options))
    at = [k for k, step in enumerate(steps) if step.keyframe is not None]
    assert at == (list(range(0, 31, apart)) if apart else [0])


def nis(seeds):
    """Return each component of the normalised innovation of steps squared, its mean, (3,)."""
    squares = []
    for seed in seeds:
        for way, walls in ((ROUND, WALLS), (ACROSS, HALL)):
            _, wrong, covariance = steps_of(way, walls, seed, noise=0.02)
            squares.append(wrong**2 / np.diagonal(covariance, axis1=1, axis2=2))
    return np.concatenate(squares).mean(axis=0)


def test_a_step_is_as_certain_as_it_claims():
    """In x, y and heading alike, to 20%; of a laser as good as the usual ones, 2 cm."""
    assert nis(range(6)) == pytest.approx(np.ones(3), abs=0.2)


def test_along_a_corridor_it_claims_no_more_than_the_wheels():
    walls = np.array([(-60, -1, 60, -1), (60, 1, -60, 1)], float)
    def short(ranges, *_):
        return np.where(ranges > 8, np.inf, ranges)

    way = along(np.array([(0.0, 0.1), (6.0, 0.1)]))
    _, wrong, covariance = steps_of(way, walls, spoil=short)
    along_, across = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
    assert (along_ > 0.03).all() and (across < 0.02).all()
    assert (abs(wrong[:, 0]) < 3 * along_).all()


def test_motion_within_a_scan_is_taken_out():
    """A robot that drives a curve, with a laser that turns once in a fifth of a second."""
    rng = np.random.default_rng(0)
    velocity, period = np.array([0.6, 0.0, 0.35]), 0.2
    motion = velocity * period
    true = [np.array([4.5, 1.2, 0.0])]
    for _ in range(24):
        true.append(se2.retract(true[-1][None], motion[None])[0])
    ranges = [ranges_on_the_way(pose, velocity, period, rng, box(0, 0, 9, 6)) for pose in true]

    def off(time_increment):
        odometry = ScanOdometry(ScanKeyframes(0.2, 0.2))
        for k, seen in enumerate(ranges):
            scan = Scan(k, seen, 0.0, 2 * np.pi / len(seen), 0.05, 30.0, time_increment)
            step = odometry.add(k, points_of(scan, velocity=velocity), true[k])
        moved = se2.between(true[0][None], true[-1][None])[0]
        return step.pose - moved

    good, bad = off(period / 240), off(0.0)
    assert np.hypot(*good[:2]) < 0.03 and abs(good[2]) < 0.01
    assert np.hypot(*bad[:2]) > 2 * np.hypot(*good[:2])


def test_a_robot_that_begins_to_turn_while_it_scans():
    """What the wheels did before the scan says nothing of it; what they did meanwhile does."""
    rng = np.random.default_rng(0)
    stand, turning = np.array([4.5, 1.2, 0.0]), np.array([0.0, 0.0, 1.5])
    period = 0.2

    def turned(velocity):
        front_end, last = ScanFrontEnd(), None
        for k in range(4):
            seen = ranges_on_the_way(stand, np.zeros(3) if k < 3 else turning, period, rng,
                                     box(0, 0, 9, 6))
            scan = Scan(k * 200_000_000, seen, 0.0, 2 * np.pi / len(seen), 0.05, 30.0,
                        period / len(seen), velocity=velocity if k == 3 else None)
            last = front_end.add(scan, stand)
        return abs(last.pose[2])

    assert turned(turning) < 0.005 and turned(None) > 0.05


def test_matches_that_each_hold_the_robot_back_a_little_do_not_for_long(monkeypatch):
    """By each scan it stands, little enough against the wheels; but not against all they say."""
    walls = np.array([(-60, -1, 60, -1), (60, 1, -60, 1)], float)
    monkeypatch.setattr(module, 'match', lambda *_, **__: Match(
        np.zeros(3), np.diag((30.0, 50.0, 100.0)) ** 2, 0.6, 0.1))
    monkeypatch.setattr(module, 'search', lambda *_: None)
    odometry = ScanOdometry()
    for k in range(40):
        seen = ranges_at((0.0, 0.1, 0.0), np.random.default_rng(k), walls)
        scan = Scan(k, np.where(seen > 8, np.inf, seen), 0.0, 2 * np.pi / len(seen), 0.05, 30.0)
        step = odometry.add(k, points_of(scan), np.array([0.04 * k, 0.0, 0.0]))
    assert step.pose[0] > 1.0


def test_wheels_that_lie_are_not_followed():
    """They say the robot stands while it goes on, then turn the wrong way."""
    scans, wheels = drive(ROUND)
    steps = se2.between(wheels[:-1], wheels[1:])
    steps[20:26] = 0.0
    steps[45:48] *= (1, 1, -1)
    odometry, pose = ScanOdometry(), wheels[0]
    said = odometry.add(scans[0].stamp, points_of(scans[0]), pose).said
    for scan, step in zip(scans[1:80], steps[:79], strict=True):
        pose = se2.compose(pose[None], step[None])[0]
        found = odometry.add(scan.stamp, points_of(scan), pose)
        said += found.said
    true = se2.between(ROUND[:1], ROUND[79:80])[0]
    assert np.hypot(*(found.pose - true)[:2]) < 0.15
    assert 'the scans disagree with the wheels, and are followed' in said


def ahead(ranges, *_):
    """Leave of a scan what a laser sees that looks ahead."""
    quarter = len(ranges) // 4
    return np.concatenate((ranges[:quarter], np.full(2 * quarter, np.nan), ranges[-quarter:]))


def test_a_metre_between_scans_it_goes_through_a_door_and_back():
    """Beyond the door little is known; what is seen there contradicts nothing."""
    way = along(THROUGH, 1.0)
    scans, wheels = drive(way, walls=ROOMS, spoil=ahead)
    odometry = ScanOdometry()
    steps = [odometry.add(scan.stamp, points_of(scan), pose)
             for scan, pose in zip(scans, wheels, strict=True)]
    true = se2.between(np.broadcast_to(way[0], way.shape), way)
    assert np.hypot(*(np.array([step.pose for step in steps]) - true)[:, :2].T).max() < 0.1
    assert {keyframe.part for keyframe in odometry.keyframes} == {0}


def test_a_metre_backwards_that_the_wheels_count_as_forwards():
    way = along(np.array([(1.5, 1.5), (10.5, 1.5)]), 0.75)
    way = np.concatenate((way[:6], way[4:2:-1], way[3:]))
    scans, wheels = drive(way, spoil=ahead)
    steps = se2.between(way[:-1], way[1:])
    steps[steps[:, 0] < 0] *= -1
    odometry, poses = led(scans, steps, wheels[0])
    true = se2.between(way[:1], way[-1:])[0]
    assert np.hypot(*(poses[-1] - true)[:2]) < 0.1
    assert {keyframe.part for keyframe in odometry.keyframes} == {0}


@pytest.mark.parametrize('seed', [0, 2])
def test_wheels_that_are_a_quarter_of_a_metre_off_lead_to_no_wrong_wall(seed):
    """What a match finds from there may be another wall, and what fits better another door."""
    way = along(THROUGH, 1.0)
    scans, _ = drive(way, seed, ROOMS, ahead)
    steps = se2.between(way[:-1], way[1:])
    far = np.hypot(steps[:, 0], steps[:, 1])
    steps += np.random.default_rng(seed).normal(0, 0.25, steps.shape) * far[:, None]
    poses = led(scans, steps)[1]
    true = se2.between(way[:1], way[-1:])[0]
    assert np.hypot(*(poses[-1] - true)[:2]) < 0.1


@pytest.mark.parametrize('seed', [2, 3])
def test_among_thin_things_it_backs_up_and_the_wheels_say_forwards(seed):
    """Of 40 legs 6 cm thick one scan sees others than the next, and little of its map."""
    low = np.random.default_rng(seed).uniform((0.5, 0.5), (13.5, 5.5), (40, 2))
    walls = np.concatenate((ROOMS, *(box(x, y, x + 0.06, y + 0.06) for x, y in low)))
    way = along(THROUGH, 1.0)
    back = se2.compose(np.tile(way[9], (2, 1)), np.array([(-0.6, 0, 0.4), (-0.6, 0, 0.9)]))
    way = np.concatenate((way[:10], back, way[10:]))
    scans, _ = drive(way, seed, walls, ahead)
    steps = se2.between(way[:-1], way[1:])
    steps[steps[:, 0] < 0, 0] *= -1
    found = led(scans, steps)[1]
    true = se2.between(np.broadcast_to(way[0], way.shape), way)
    assert np.hypot(*(found - true)[:, :2].T).max() < 0.15


def test_a_laser_a_little_aside_is_no_reason_to_doubt_the_wheels():
    """It sits 9 cm ahead of where it is said to be, and the robot turns on the spot."""
    true = np.column_stack((np.full((12, 2), (4.0, 1.5)), 0.5 * np.arange(12)))
    laser = se2.compose(true, np.tile((0.09, 0.0, 0.0), (12, 1)))
    scans, _ = drive(laser)
    odometry = ScanOdometry()
    steps = [odometry.add(scan.stamp, points_of(scan), pose)
             for scan, pose in zip(scans, true, strict=True)]
    moved = se2.between(laser[:1], laser[-1:])[0]
    assert {step.said for step in steps} == {''}
    assert np.hypot(*(steps[-1].pose - moved)[:2]) < 0.05


def test_carried_away_it_says_so_and_begins_anew():
    scans, wheels = drive(np.concatenate((ROUND[:40], ACROSS[:40])), spoil=lambda ranges, k, rng: (
        ranges if k < 40 else ranges_at(ACROSS[k - 40], rng, HALL)))
    wheels[40:] = se2.compose(np.broadcast_to(wheels[39], (40, 3)),
                              se2.between(np.broadcast_to(ACROSS[0], (40, 3)), ACROSS[:40]))
    odometry = ScanOdometry()
    steps = [odometry.add(scan.stamp, points_of(scan), pose)
             for scan, pose in zip(scans, wheels, strict=True)]
    said = {step.said for step in steps}
    assert 'the scans show nothing known any more; a new part of the map begins' in said
    assert {keyframe.part for keyframe in odometry.keyframes} == {0, 1}


def assert_follows_in_one_part(spoil):
    """Drive with spoilt scans; the robot is known in the end, and no new part has begun."""
    odometry = ScanOdometry()
    steps, _, _ = steps_of(ROUND[:60], spoil=spoil, odometry=odometry)
    true = se2.between(ROUND[:1], ROUND[59:60])[0]
    assert np.hypot(*(steps[-1].pose - true)[:2]) < 0.15
    assert {keyframe.part for keyframe in odometry.keyframes} == {0}


def test_a_crowd_that_passes_is_no_other_place():
    """For 1.2 s and less than a metre nothing is seen but what stands around."""
    assert_follows_in_one_part(lambda ranges, k, rng: (
        rng.uniform(0.5, 1.0) + 0.2 * np.sin(np.arange(len(ranges)) / 9 + k)
        if 20 <= k < 26 else ranges))


def test_random_rays_do_not_disturb_it():
    steps, _, _ = steps_of(ROUND[:80], spoil=random_rays)
    true = se2.between(ROUND[:1], ROUND[79:80])[0]
    assert np.hypot(*(steps[-1].pose - true)[:2]) < 0.1


def test_where_nothing_is_seen_the_wheels_are_followed():
    """Blind for a while; it is not lost for that."""
    assert_follows_in_one_part(lambda ranges, k, _: (
        np.full_like(ranges, np.inf) if 20 <= k < 32 else ranges))
