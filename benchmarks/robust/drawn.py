# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Worlds drawn at random, each with its own noise, and what is made wrong in them.

In: a random generator. Out: a place whose truth is known, and a condition as `verdict` has them.
"""

from collections.abc import Callable

import numpy as np
from robust.places import Place, error_by_time, measured, place_of
from scipy.spatial import cKDTree

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world

# What is changed, with its amounts; the lies, and their share.
Condition = tuple[str, tuple[float | str, ...], str, float]
Rng = np.random.Generator
_KINDS = {'clean': 0.05, 'random': 0.2, 'identity': 0.08, 'grouped': 0.12, 'slip': 0.15,
          'odometry': 0.1, 'information': 0.1, 'thinned': 0.05, 'aliased': 0.05,
          'half aliased': 0.03, 'drift': 0.07}


def condition(rng: Rng, is_lap: bool) -> Condition:
    """Return what is made wrong; is_lap : two steps less leave the world in two parts."""
    kind = str(rng.choice(list(_KINDS), p=list(_KINDS.values())))
    if kind == 'clean':
        return '', (), '', 0.0
    if kind in ('random', 'identity'):
        return '', (), kind, round(rng.uniform(0.1, 0.9), 2)
    if kind == 'grouped':
        return '', (), kind, round(rng.uniform(0.2, 0.7), 2)
    amounts: dict[str, Callable[[], tuple[float | str, ...]]] = {
        'slip': lambda: (str(rng.choice(['translation', 'rotation'])),
                         1 if is_lap else int(rng.integers(1, 4))),
        'odometry': lambda: (_between(rng, 1.5, 12),),
        'information': lambda: (str(rng.choice(['odometry', 'loops'])),
                                float(10**rng.uniform(-2.5, 2.5))),
        'thinned': lambda: (float(rng.uniform(0.05, 0.5)),),
        'aliased': lambda: (int(rng.integers(1, 5)), str(rng.choice(['own', 'same']))),
        'half aliased': lambda: (12,), 'drift': lambda: (_between(rng, 0.003, 0.08),)}
    drawn = amounts[kind]()
    if kind in ('aliased', 'half aliased'):
        return kind, drawn, '', 0.0
    share = 0.5 if kind == 'thinned' else round(rng.uniform(0.1, 0.5), 2)
    return kind, drawn, 'random', share


def _between(rng: Rng, least: float, most: float) -> float:
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def streets(rng: Rng) -> Place:
    """Return a drive in the streets of a Manhattan."""
    poses = int(rng.integers(300, 900))
    loops = int(poses * _between(rng, 0.06, 0.5))
    world = simulate_world(poses, poses - 1 + loops, WorldOptions(
        block=int(rng.integers(3, 13)), odometry_sigma_translation=_between(rng, 0.02, 0.1),
        odometry_sigma_rotation=_between(rng, 0.002, 0.02),
        loop_sigma_translation=_between(rng, 0.03, 0.3),
        loop_sigma_rotation=_between(rng, 0.005, 0.05)), rng)
    return place_of('made', world.graph, None, error_by_time(world.truth[:, :2]))


def laps(rng: Rng) -> Place:
    """Return two to four laps, with loops along all of the way."""
    count, times = int(rng.integers(120, 300)), int(rng.integers(2, 5))
    angle = 2 * np.pi * np.arange(count * times) / count
    radius = count / 6.3 * (1 + rng.uniform(0, 0.3) * np.sin(rng.integers(2, 6) * angle))
    radius += np.repeat(rng.normal(0, 0.5, times), count)
    way = radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    i = np.arange(0, count * (times - 1), int(rng.integers(1, 12)))
    return _along(way, i, i + count, rng, rng.random() < 0.2)


def spokes(rng: Rng) -> Place:
    """Return a way out and back along several arms, with loops on these and where they meet."""
    arms, length = int(rng.integers(3, 7)), int(rng.integers(25, 70))
    way = [np.zeros((1, 2))]
    hubs = [0]
    pairs = []
    for arm in range(arms):
        heading, s = 2 * np.pi * arm / arms + rng.normal(0, 0.1), np.arange(1, length + 1)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        out = s[:, None] * ahead + np.sin(s / 7)[:, None] * np.array([-ahead[1], ahead[0]])
        start = sum(map(len, way))
        way += [out, out[::-1][1:] + rng.normal(0, 0.1, (length - 1, 2)),
                np.zeros((1, 2)) + rng.normal(0, 0.1, 2)]
        hubs.append(sum(map(len, way)) - 1)
        pairs += [(start + s, start + 2 * length - 2 - s) for s in rng.choice(
            length - 8, max(3, length // 6), replace=False)]
    pairs = pairs if rng.random() < 0.8 else []
    pairs += [(one, other) for number, one in enumerate(hubs) for other in hubs[number + 1:]
              if rng.random() < 0.7]
    i, j = np.array(pairs).T
    return _along(np.concatenate(way), i, j, rng)


def lawn(rng: Rng) -> Place:
    """Return lanes side by side, and a way across them at the end."""
    lanes, length, gap = (int(rng.integers(*ends)) for ends in ((4, 9), (30, 80), (2, 6)))
    parts = []
    for lane in range(lanes):
        x = np.arange(length)[::(1 if lane % 2 == 0 else -1)].astype(float)
        parts.append(np.column_stack((x, np.full(length, lane * gap, float))))
        if lane + 1 < lanes:
            parts.append(np.column_stack((np.full(gap - 1, x[-1]),
                                          lane * gap + np.arange(1, gap))))
    end, half = parts[-1][-1], length // 2
    parts.append(np.column_stack((np.linspace(end[0], length / 2, half), np.full(half, end[1]))))
    down = np.arange((lanes - 1) * gap)[::-1].astype(float)
    parts.append(np.column_stack((np.full(len(down), length / 2), down)))
    way = np.concatenate(parts)
    reach = 1.6 if rng.random() < 0.5 else gap + 0.1
    pairs = np.array([(a, b) for a, b in cKDTree(way).query_pairs(reach) if b - a > 15])
    count = min(len(pairs), int(_between(rng, 8, 150)))
    i, j = pairs[rng.choice(len(pairs), count, replace=False)].T
    return _along(way, i, j, rng)


def _along(way: Array, i: Indices, j: Indices, rng: Rng, tails: bool = False) -> Place:
    """Return what is measured along positions (n, 2), the robot looking ahead; tails: of loops."""
    ahead = np.gradient(way, axis=0)
    truth = np.column_stack((way, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))))
    step = (_between(rng, 0.02, 0.1),) * 2 + (_between(rng, 0.002, 0.015),)
    loop = (_between(rng, 0.03, 0.3),) * 2 + (_between(rng, 0.005, 0.05),)
    return of_truth(truth, i, j, step, loop, rng, tails)


def of_truth(truth: Array, i: Indices, j: Indices, step: tuple[float, ...],
             loop: tuple[float, ...], rng: Rng, tails: bool) -> Place:
    """
    Return what is measured of a truth (n, 3), with loops from keyframes i to j.

    step, loop : sigmas [m, m, rad]; tails : of loops, with two degrees of freedom
    """
    sigma = np.concatenate((np.tile(step, (len(truth) - 1, 1)), np.tile(loop, (len(i), 1))))
    noise = sigma * rng.standard_normal(sigma.shape)
    if tails:
        noise[len(truth) - 1:] *= np.abs(rng.standard_t(2, (len(i), 1)))
    return place_of('made', measured(truth, i, j, sigma, noise), None,
                    error_by_time(truth[:, :2]))
