# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""How much of the odometry is kept: what loops between keyframes may yet ask for, and no more."""

import numpy as np
import pytest
from problems import covariance6, odometry

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.noise import LEAST_VARIANCE
from l1slam_ros.core.graph.measurements import LoopClosure
from l1slam_ros.core.online import keyframes
from l1slam_ros.core.online.graph_builder import GraphBuilder
from l1slam_ros.core.online.keyframes import KeyframeOptions, OdometryOptions
from l1slam_ros.core.online.loops.loop_factors import LoopOptions
from l1slam_ros.core.online.odometry.odometry_track import OdometryTrack
from l1slam_ros.core.online.options import GraphBuilderOptions

N = 6000
MISSED = LEAST_VARIANCE**0.5
NS = 10**9
WAYS = ('stands', 'straight', 'curve', 'shakes', 'stops and goes')
# What of 6000 samples may be left, beside the two newest blocks.
FEW = {'stands': 60, 'straight': 60, 'curve': 1500, 'shakes': N, 'stops and goes': 2500}


def way(kind, manifold, rng):
    """Return samples of a robot at 100 Hz, (n, p)."""
    s = 0.005 * np.arange(N)
    if kind == 'stands':
        s = np.zeros(N)
    if kind == 'stops and goes':
        s = np.cumsum(0.005 * (np.arange(N) // 300 % 2))
    pose = np.zeros((N, 7))
    pose[:, 0], pose[:, 6] = s, 1.0
    if kind not in ('stands', 'straight'):
        pose[:, :2] = np.stack((10 * np.sin(s / 10), 10 - 10 * np.cos(s / 10)), axis=1)
        pose[:, 5], pose[:, 6] = np.sin(s / 20), np.cos(s / 20)
    if kind == 'shakes':
        pose[:, :2] += rng.normal(0, 1e-3, (N, 2))
    return manifold.from_pose3(pose)


@pytest.mark.parametrize('manifold', [se2, se3])
@pytest.mark.parametrize('kind', WAYS)
def test_what_is_left_finds_the_rest_again(rng, manifold, kind):
    poses, track = way(kind, manifold, rng), OdometryTrack(manifold)
    marked = np.unique(np.append(0, rng.choice(N, 40)))
    stamps, parts = np.arange(1, N + 1) * NS // 100, []
    for k in range(N):
        if k in (2000, 2001):  # a part of one sample, too
            track.begin_part(int(stamps[k]))
            parts.append(k)
        track.append(int(stamps[k]), poses[k : k + 1], k in marked or k in parts)
        if track.may_be_thinned:
            track.thin()
    assert len(track) <= FEW[kind] + 1024
    metres, radians = manifold.motion(manifold.local(track.at(stamps), poses))
    assert metres.max() <= MISSED * (1 + 1e-6) and radians.max() <= MISSED * (1 + 1e-6)
    known = np.union1d(marked, parts)
    assert track.keyframe_stamps.tolist() == stamps[known].tolist()
    assert (track.keyframe_poses == poses[known]).all()
    assert track.gaps.tolist() == np.searchsorted(known, parts).tolist()
    # Nothing is carried across a gap.
    before = stamps[[1999, 2000]] + 1
    assert np.allclose(track.at(before), poses[[1999, 2000]])


def grown(poses, loops, every=None, monkeypatch=None):
    """Return a graph that is asked for its loops every so many samples, and at its end."""
    if monkeypatch:
        monkeypatch.setattr(OdometryTrack, 'may_be_thinned', False)
    builder = GraphBuilder(se2, GraphBuilderOptions(loop=LoopOptions(wait=1e6)))
    for k, pose in enumerate(poses):
        for loop in loops.get(k, ()):
            builder.add_loop(loop)
        builder.add_odometry(odometry((k + 1) / 100, pose))
        if every and k % every == 0:
            builder.add_due_loops()
    builder.add_due_loops()
    return builder


@pytest.mark.parametrize('kind, every', [('curve', 20), ('stops and goes', None)])
def test_loops_are_the_same_factors_as_with_all_samples(rng, monkeypatch, kind, every):
    poses, loops = way(kind, se2, rng), {}
    for k in range(0, N - 1, 7):
        begin, end = np.sort(rng.choice(N, 2, replace=False)) + 1
        # Some come before their odometry has, some long after.
        loops.setdefault(min(k, N - 1), []).append(LoopClosure(
            int(begin) * NS // 100 + 3, int(end) * NS // 100 + 3,
            se2.to_pose3(rng.normal(size=(1, 3)))[0], covariance6(0.01 * np.eye(3))))
    thinned, whole = grown(poses, loops, every), grown(poses, loops, monkeypatch=monkeypatch)
    assert len(thinned.robots[0].track) < len(whole.robots[0].track) == N or not every
    order = [np.lexsort(one.loops.stamps[0].T) for one in (thinned, whole)]
    rows = [one.loops.rows[o] for one, o in zip((thinned, whole), order, strict=True)]
    a, b = (one.graph.between for one in (thinned, whole))
    assert len(rows[0]) == len(rows[1]) > 100 and thinned.notes.refused == whole.notes.refused
    assert (a.pairs[rows[0]] == b.pairs[rows[1]]).all()
    difference = se2.local(a.measurement[rows[0]], b.measurement[rows[1]])
    assert np.abs(difference).max() < 50 * MISSED  # by levers of a keyframe's way, and turns


@pytest.mark.parametrize('source', ['increment', 'twist'])
def test_messages_without_a_keyframe_are_summed_up(rng, monkeypatch, source):
    options = OdometryOptions(source)
    poses = way('curve', se2, rng)[:1000]
    stated = [covariance6(np.diag(rng.uniform(1e-6, 1e-4, 3))) for _ in poses]

    def covariance(at_once):
        monkeypatch.setattr(keyframes, '_SUMMED', at_once)
        motion = keyframes.KeyframeMotion(se2, 0, poses[:1])
        for k in range(1, len(poses)):
            motion.add(odometry(k / 100, poses[k], stated[k], stated[k]), poses[k : k + 1],
                       options)
        assert len(motion._poses) <= at_once
        return motion.covariance(options)

    whole = covariance(10**6)
    for at_once in (2, 512, 999):
        assert np.allclose(covariance(at_once), whole, rtol=1e-9)


def test_one_message_without_a_covariance_is_not_summed_up(monkeypatch):
    monkeypatch.setattr(keyframes, '_SUMMED', 2)
    motion, pose = keyframes.KeyframeMotion(se2, 0, np.zeros((1, 3))), np.zeros((1, 3))
    for k in range(1, 9):
        known = covariance6((k != 3) * np.eye(3))
        motion.add(odometry(float(k), pose[0], known), pose, OdometryOptions('increment'))
    assert np.allclose(motion.covariance(OdometryOptions('increment')),
                       keyframes.diagonal_covariance(se2, 0.02, 0.02))
    assert not motion.is_keyframe(KeyframeOptions())
