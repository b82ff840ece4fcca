# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The odometry of `scan_loops` in the back end: keyframes, parts and how certain the way is."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.measurements import OdometrySample
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.scans.odometry import ScanKeyframes, Step
from l1slam_ros.core.scans.submaps import Keyframe
from l1slam_ros.io.node_options import read_params_file
from l1slam_ros.ros.scans.messages import whole
from l1slam_ros.ros.scans.scan_odometry import IncrementalOdometry

SHIPPED = Path(__file__).parents[2] / 'config' / 'scan_loops.yaml'
S = 10**9


def shipped_backend():
    """Return a back end that `config/scan_loops.yaml` is for."""
    return Backend(read_params_file(SHIPPED), 2)


def steps(rng, count=40):
    """Yield stamps and what a front end says of a robot that goes along, a metre in ten scans."""
    options, keyframe, pose = ScanKeyframes(), np.zeros(3), np.zeros(3)
    for k in range(count):
        pose = se2.compose(pose[None], np.array([[0.1, 0.0, 0.02]]))[0] if k else pose
        moved = se2.between(keyframe[None], pose[None])[0]
        is_keyframe = not k or np.hypot(*moved[:2]) >= options.translation
        root = rng.normal(0, 0.02, (3, 3)) * (1, 1, 0.3)
        covariance = root @ root.T + 1e-5 * np.eye(3)
        made = Keyframe(k, pose, None, 0, 0.0) if is_keyframe else None
        yield (k + 1) * S // 10, Step(pose, made, covariance)
        keyframe = pose if is_keyframe else keyframe


def test_the_back_end_has_the_keyframes_of_the_scans_and_what_they_know(rng):
    backend = shipped_backend()
    told, keyframes, stated = IncrementalOdometry(ScanKeyframes()), [], []
    for stamp, step in steps(rng):
        pose, covariance = told.tell(stamp, step, begins=False)
        assert np.linalg.eigvalsh(covariance).min() > 0
        backend.add_odometry(OdometrySample(
            stamp, se2.to_pose3(pose[None])[0], whole(covariance), np.zeros((6, 6)), 'base'))
        if step.keyframe is not None:
            keyframes.append(stamp)
            stated.append(step.covariance)
    now = backend.snapshot()
    assert now.stamps.tolist() == keyframes and len(keyframes) > 5
    factors = now.graph.between
    found = np.linalg.inv(np.einsum('mki,mkj->mij', factors.sqrt_information[:],
                                    factors.sqrt_information[:]))
    for covariance, expected in zip(found, stated[1:], strict=True):
        # No less than the front end knows, in any direction; random ones that shrink add some.
        assert np.linalg.eigvalsh(covariance - expected).min() > -1e-9


def test_where_a_scan_shows_nothing_known_the_back_end_makes_no_keyframe_either():
    """The way on to the next that is known is as certain as the front end says, not as wheels."""
    told = IncrementalOdometry(ScanKeyframes())
    backend = shipped_backend()
    known, vague = np.diag((4e-4, 4e-4, 1e-4)), np.diag((0.04, 0.04, 0.01))
    for k in range(14):
        pose = np.array([0.1 * k, 0.0, 0.0])
        lost = k in (5, 6)
        made = Keyframe(k, pose, None, 0, 0.0) if k in (0, 7, 12) else None
        pose, covariance = told.tell((k + 1) * S // 10, Step(pose, made, vague if lost else known),
                                     begins=False)
        assert (covariance is None) == lost
        if covariance is not None:
            backend.add_odometry(OdometrySample(
                (k + 1) * S // 10, se2.to_pose3(pose[None])[0], whole(covariance),
                np.zeros((6, 6)), 'base'))
    now = backend.snapshot()
    assert now.stamps.tolist() == [(k + 1) * S // 10 for k in (0, 7, 12)]
    root = now.graph.between.sqrt_information[0]
    np.testing.assert_allclose(np.diag(np.linalg.inv(root.T @ root)), np.diag(known), rtol=0.05)


def test_a_robot_that_is_lost_is_not_silent_for_long():
    told = IncrementalOdometry(ScanKeyframes())
    silent = 0
    for k in range(40):
        made = Keyframe(0, np.zeros(3), None, 0, 0.0) if k == 0 else None
        _, covariance = told.tell((k + 1) * S // 10, Step(
            np.array([0.6 * (k > 0), 0.0, 0.0]), made, 1e-4 * np.eye(3)), begins=False)
        silent = 0 if covariance is not None else silent + 1
        assert silent < 15


def test_a_steady_covariance_is_stated_as_it_is():
    told, expected = IncrementalOdometry(ScanKeyframes()), np.diag((4e-4, 1e-4, 1e-5))
    total, last = np.zeros((3, 3)), np.zeros(3)
    for k in range(6):
        pose = np.array([0.1 * k, 0.0, 0.0])
        made = Keyframe(k, pose, None, 0, 0.0) if k in (0, 5) else None
        _, covariance = told.tell(k + 1, Step(pose, made, expected), begins=False)
        if k:
            Ad = se2.adjoint(se2.between(pose[None], last[None]))[0]
            total = Ad @ total @ Ad.T + covariance
        last = pose
    np.testing.assert_allclose(np.diag(total), np.diag(expected), rtol=0.05)


def test_a_new_part_is_a_gap_to_the_back_end():
    told = IncrementalOdometry(ScanKeyframes())
    backend = shipped_backend()
    for k in range(30):
        pose = np.array([0.1 * k, 0.0, 0.0])
        made = Keyframe(k, pose, None, k // 15, 0.0) if k in (0, 5, 10, 15, 20, 25) else None
        pose, covariance = told.tell((k + 1) * S // 10, Step(pose, made, 1e-4 * np.eye(3)),
                                     begins=k == 15)
        backend.add_odometry(OdometrySample(
            (k + 1) * S // 10, se2.to_pose3(pose[None])[0], whole(covariance), np.zeros((6, 6)),
            'base'))
    now = backend.snapshot()
    assert now.stamps.tolist() == [(k + 1) * S // 10 for k in (0, 5, 10, 15, 20, 25)]
    assert len(now.graph.between) == 4
    assert backend.counts().told['new_part'] == 1
