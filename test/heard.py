# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a robot in the plane says on the way, for `l1.Backend`, and the factors made of it."""

import numpy as np
from worlds import between, compose

import l1slam_ros as l1

PERIOD = 0.1  # [s] from one sample to the next
UNKNOWN = np.zeros((6, 6))
UNUSABLE = [UNKNOWN, -np.eye(6), np.full((6, 6), -1.0), np.full((6, 6), np.nan),
            np.full((6, 6), 9999.0), np.full((6, 6), 1e308), np.diag([1.0, 1, 1, 1, 1, -1])]
# Each message is a keyframe.
EVERY = {'keyframe.translation': 0.0, 'keyframe.rotation': 0.0}


def begun(options=EVERY, **more):
    """Return a back end of options by dotted names, and of more of them."""
    return l1.Backend(l1.BackendOptions.from_mapping({**options, **more}))


def seconds(value):
    """Return a stamp [ns]."""
    return round(value * 1e9)


def covariance6(covariance):
    """Return the covariance of a message whose x, y, yaw have this one, (3, 3)."""
    whole = np.zeros((6, 6))
    whole[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    return whole


def pose3(pose):
    """Return a pose x, y, theta as x y z qx qy qz qw."""
    x, y, theta = pose
    return np.array([x, y, 0.0, 0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)])


def odometry(time, pose, covariance=UNKNOWN, twist_covariance=UNKNOWN, **more):
    """Return the sample of a robot at `pose` (3,), `time` in seconds."""
    return l1.OdometrySample(seconds(time), pose3(pose), covariance, twist_covariance, **more)


def loop(reference_time, time, pose, covariance=UNKNOWN, **more):
    """Return the loop that saw the robot at `pose` (3,), times [s]; from None: from the map."""
    reference = None if reference_time is None else seconds(reference_time)
    return l1.LoopClosure(reference, seconds(time), pose3(pose), covariance, **more)


def true_loop(poses, reference, sample, covariance=UNKNOWN, **more):
    """Return what sees sample from reference without noise."""
    return loop(reference * PERIOD, sample * PERIOD, between(poses[reference], poses[sample]),
                covariance, **more)


def curve(n):
    """Return a drive along a curve, .12 m and .01 to .05 rad per sample, (n, 3)."""
    poses = np.zeros((n, 3))
    for k in range(1, n):
        poses[k] = compose(poses[k - 1], np.array([0.12, 0.01, 0.03 + 0.02 * np.sin(k / 5)]))
    return poses


def straight(n, step=1.0):
    """Return a drive straight ahead, (n, 3)."""
    return np.arange(n)[:, None] * np.array([step, 0.0, 0.0])


def drive_on(backend, poses, first=0, start=0.0, period=PERIOD):
    """Add the samples of `poses` (n, 3) from `first` on, number k at `start` + k `period`."""
    for k in range(first, len(poses)):
        backend.add_odometry(odometry(start + k * period, poses[k]))
    return backend


def driven(poses, options=EVERY, *loops, **more):
    """Return a back end of some options that has heard of `poses` (n, 3) and then of loops."""
    backend = drive_on(begun(options, **more), poses)
    assert not hear(backend, loops)
    return backend


def hear(backend, found):
    """Add samples and loops; return what those that are refused at once are refused for."""
    refused = []
    for message in found:
        try:
            if isinstance(message, l1.LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message)
        except l1.L1SlamError as error:
            refused.append(str(error))
    return refused


def covariances(roots):
    """Return the covariances (m, 3, 3) of square roots of information; zeros: nothing is said."""
    inverse = np.linalg.pinv(roots)
    return inverse @ inverse.transpose(0, 2, 1)


def steps_of(backend):
    """Return the odometry factors, measurement (k, 3) and covariance (k, 3, 3)."""
    factors = backend.snapshot().graph.between
    rows = factors.is_odometry
    return factors.measurement[rows], covariances(factors.sqrt_information[rows])


def loops_of(backend):
    """Return keyframes i, j (lists), measurement (k, 3) and covariance (k, 3, 3) of all loops."""
    factors, rows = backend.snapshot().graph.between, backend.loop_states().rows
    return (factors.i[rows].tolist(), factors.j[rows].tolist(), factors.measurement[rows],
            covariances(factors.sqrt_information[rows]))


def refused(backend):
    """Return how many messages were refused for which causes, not counting errors."""
    return {cause: count for cause, count in backend.counts().refused.items() if count}


def told(backend):
    """Return how often the odometry did not go on as robots move, by causes."""
    return dict(backend.counts().told)


def parts(backend):
    """Return the keyframes with which parts of the map begin, but the first."""
    return backend.snapshot().graph.firsts.tolist()
