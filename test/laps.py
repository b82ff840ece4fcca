# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A robot on square laps, the loops it sees one lap back, and what drivers do to its odometry."""

import numpy as np
from heard import UNKNOWN, covariance6, pose3
from worlds import between, compose, position_error

import l1slam_ros as l1

# At 1 m/s round four corners of 1 m radius.
LAP = 40.0  # [s]
RATE = 20.0  # [1/s]
START = 100.0  # [s]
_SIDE, _CORNER = LAP / 4, np.pi / 2
LOOP_SIGMA = np.array([0.05, 0.05, 0.02])


def at(time):
    """Return where the robot is, some seconds after its start (n,), (n, 3)."""
    side, rest = np.divmod(time, _SIDE)
    straight = _SIDE - _CORNER
    angle = np.maximum(rest - straight, 0.0)
    on = np.column_stack((np.minimum(rest, straight) + np.sin(angle), 1 - np.cos(angle), angle))
    corners, step = [np.zeros(3)], np.array([straight + 1.0, 1.0, np.pi / 2])
    for _ in range(3):
        corners.append(compose(corners[-1], step))
    return compose(np.array(corners)[side.astype(int) % 4], on)


class Laps:
    """
    What is heard of a drive, without a fault.

    Attributes
    ----------
    samples : of odometry that errs by about 1.5% of each metre and radian; loops : twice a second

    """

    def __init__(self, seed=0, laps=3.0, twist=False):
        rng = np.random.default_rng(seed)
        self.times = np.arange(round(laps * LAP * RATE)) / RATE
        truth = at(self.times)
        steps = between(truth[:-1], truth[1:])
        # Half of it is the same all the way: a wheel's radius, a gyro's scale.
        error = 1 + rng.normal(0, 0.01, 3) + rng.normal(0, 0.01 * np.sqrt(RATE), steps.shape)
        odometry = [np.zeros(3)]
        for step in steps * error:
            odometry.append(compose(odometry[-1], step))
        self.odometry = np.array(odometry)
        x, y, angle = (np.vstack((steps, steps[-1:])) * RATE * twist).T
        self.speeds = [*zip(np.hypot(x, y).tolist(), np.abs(angle).tolist(), strict=True)]
        ends = np.arange(LAP, self.times[-1], 0.5)
        begins = ends - LAP
        measured = compose(between(at(begins), at(ends)),
                           LOOP_SIGMA * rng.standard_normal((len(ends), 3)))
        covariance = covariance6(np.diag(LOOP_SIGMA**2))
        self.loops = [l1.LoopClosure(stamp(begin), stamp(end), pose3(Z), covariance)
                      for begin, end, Z in zip(begins, ends, measured, strict=True)]

    def sample(self, k, pose=None):
        """Return the message of number k; pose (3,) : what it says."""
        pose = self.odometry[k] if pose is None else pose
        return l1.OdometrySample(stamp(self.times[k]), pose3(pose), UNKNOWN, UNKNOWN, '',
                                 self.speeds[k])

    def samples(self):
        """Return all messages of the odometry."""
        return [self.sample(k) for k in range(len(self.times))]

    def silent(self, begin, end):
        """Return the messages but those of some time."""
        return [self.sample(k) for k, time in enumerate(self.times) if not begin < time < end]

    def restarted(self, begin, silence, where):
        """Return the messages of odometry that begins again at `where` (3,) after a silence."""
        last = int(np.searchsorted(self.times, begin, side='right')) - 1
        first = last + max(round(silence * RATE), 1)
        start = self.odometry[last] if where is SAME else np.array(where, float)
        frame = compose(start, between(self.odometry[first], np.zeros(3)))
        return [self.sample(k) for k in range(last + 1)] + [
            self.sample(k, compose(frame, self.odometry[k]))
            for k in range(first, len(self.times))]

    def heard(self, samples):
        """Return samples, in the order they come, and each loop as soon as its end is over."""
        loops = list(self.loops)
        newest = 0
        found = []
        for sample in samples:
            found.append(sample)
            newest = max(newest, sample.stamp)
            while loops and loops[0].stamp <= newest:
                found.append(loops.pop(0))
        return found

    def error(self, snapshot):
        """Return the RMSE of the positions of the keyframes [m]."""
        truth = at((snapshot.stamps - stamp(0.0)) * 1e-9)
        return position_error(snapshot.poses[:, :2], truth[:, :2])


# In the place of a pose: that of the last message before.
SAME = object()


def stamp(time):
    """Return the stamp some seconds after the start [ns]."""
    return round((START + time) * 1e9)


def late(samples, share, delay, rng):
    """Return samples in the order they come if a share of them is so many seconds late."""
    arrival = np.array([one.stamp for one in samples]) * 1e-9
    arrival += delay * (rng.random(len(samples)) < share)
    return [samples[k] for k in np.argsort(arrival, kind='stable')]
