# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Worlds of 13 families, written apart from what judges loops: `draw(number)` makes one.

A world is a graph with its truth and with the knowledge which loops are false. A fifth of the
worlds has no lie; a tenth is hopeless: few loops, most of them false.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

Array = np.ndarray
# A keyframe's step from .. to [m], and how far the robot strays from its way, in steps.
PLANE = {'office': (.4, 1, .3), 'warehouse': (.4, .8, .2), 'blocks': (1.5, 4, .2),
         'eights': (.5, 2, .4), 'ring': (1, 5, .3), 'mowing': (.5, 1.5, .1), 'hub': (.4, 1, .3),
         'campus': (1, 3, .3), 'shop': (.3, .7, .3)}
SPACE = {'storeys': (.4, .8, .3), 'car park': (.7, 1.5, .2), 'drone': (2, 6, .2),
         'handheld': (.25, .5, .6)}
GRIDS = {'office': ((15, 7), (40, 12), (3, 5)), 'blocks': ((60, 60), (120, 120), (4, 4)),
         'handheld': ((3, 3), (7, 7), (4, 4))}  # spacing from, to [m]; crossings
FAULTS = ('white', 'misstated', 'scale', 'bias', 'walk', 'slip', 'tails', 'clean')
LIES = ('random', 'alias', 'shift', 'along')


class World(NamedTuple):
    """A pose graph whose truth is known; its first n - 1 edges are the odometry."""

    family: str
    facts: dict[str, str]  # what kinds of lies, noise and information
    truth: Array  # (n, 4, 4)
    start: Array  # (n, 4, 4), the odometry chain
    pairs: Array  # (m, 2)
    measured: Array  # (m, 4, 4)
    information: Array  # diagonals (m, 3 or 6) of the file: in space of the quaternion's vector
    false: Array  # (m,) bool

    def text(self, used: Array) -> str:
        """Give the g2o text of the edges used, (m,) bool."""
        d = self.information.shape[1]
        tag = 'SE2' if d == 3 else 'SE3:QUAT'
        lines = [f'VERTEX_{tag} {k} {_join(x)}' for k, x in enumerate(_rows(self.start, d))]
        edges = zip(self.pairs, _rows(self.measured, d), self.information, used, strict=True)
        lines += [f'EDGE_{tag} {i} {j} {_join(z)} {_join(np.diag(w)[np.triu_indices(d)])}'
                  for (i, j), z, w, use in edges if use]
        return '\n'.join(lines) + '\n'


def _join(row: Array) -> str:
    return ' '.join(f'{x:.10g}' for x in row)


def _rows(T: Array, d: int) -> Array:
    R, t = Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3]
    return np.hstack([t[:, :2], R.as_rotvec()[:, 2:]] if d == 3 else [t, R.as_quat()])


def _poses(R: Rotation, t: Array) -> Array:
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), t
    return T


def _log(rng: Any, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(max(low, high)))))


def _wander(rng: Any, length: float, shape: Iterable[int], spacing: Array, z: float = 0) -> Array:
    """Walk from crossing to crossing of a grid, not turning back, in the end to the first one."""
    path, gone, turns = [np.zeros(2, int)], 0., np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    while gone < length:
        free = [d for d in turns if np.all((path[-1] + d >= 0) & (path[-1] + d < shape))
                and (len(path) < 2 or np.any(path[-1] + d != path[-2]))]
        path.append(path[-1] + free[rng.integers(len(free))])
        gone += float(np.abs(path[-1] - path[-2]) @ spacing)
    path += [path[-1] * (0, 1), path[0]]
    return np.column_stack([path * spacing, np.full(len(path), z)])


def _storeys(rng: Any, length: float) -> tuple[Array, Array]:
    """Walk each storey, up and down again, by stairs or by ramps."""
    h, n, spacing, points = rng.uniform(2.8, 4.2), rng.integers(2, 5), rng.uniform(6, 15, 2), []
    run, order = rng.choice([-5, -20]), [*range(n), *range(n - 2, -1, -1)]
    spacing *= min(1, length / len(order) / 6 / spacing.mean())
    for k in order:
        if points:
            mid = (points[-1][-1, 2] + k * h) / 2
            points.append(np.array([[run, 0, mid], [run, 1.5, mid], [0, 1.5, k * h]]))
        points.append(_wander(rng, length / len(order), rng.integers(2, 5, 2), spacing, k * h))
    return np.vstack(points), np.array([0, 0, h])


def _car_park(rng: Any, length: float) -> tuple[Array, Array]:
    """Drive up a square spiral, once round on top, and down again."""
    decks, h = int(rng.integers(2, 6)), rng.uniform(2.6, 3.4)
    a, u = length / (2 * decks + 1) / 3.2, np.arange(4 * decks + 5)
    up = np.column_stack([a * (u // 2 % 2 != u % 2), .6 * a * (u // 2 % 2),
                          h * np.minimum(u / 4, decks)])
    return np.vstack([up, up[-5::-1]]), np.array([0, 0, h])


def _warehouse(rng: Any, length: float) -> tuple[Array, Array]:
    """Drive through every aisle, then through some again."""
    n, apart = int(rng.integers(5, 11)), rng.uniform(3, 4.5)
    aisles = np.append(np.arange(n), rng.integers(0, n, max(4, int(length / 30) - n)))
    long, k = np.clip(length / len(aisles) - apart * n / 4, 8, 45), np.arange(2 * len(aisles))
    return (np.column_stack([apart * aisles[k // 2], long * ((k + 1) // 2 % 2), 0 * k]),
            np.array([apart, 0, 0]))


def _rows_of_a_field(rng: Any, length: float, step: float) -> tuple[Array, Array]:
    """Cover a square row by row, then across or once more."""
    apart = step * rng.uniform(1.5, 3)
    rows = max(4, int(np.ceil(np.sqrt(length / apart / 2))))
    k = np.arange(2 * rows)
    z = apart * ((rows - 1) * ((k + 1) // 2 % 2) + 1j * (k // 2))
    z = np.append(z, 1j * z.conj() if rng.random() < .5 else z)
    return np.column_stack([z.real, z.imag, 0 * z.real]), np.array([0, apart, 0])


def _laps(rng: Any, family: str, length: float) -> Array:
    """Come back again and again: to a lap's beginning, to the middle of a star, to a dock."""
    laps = rng.integers(2, 7)
    u = np.linspace(0, 2 * np.pi * laps, 90 * laps)
    if family == 'eights':
        z = np.sin(u) + 1j * np.sin(u) * np.cos(u)
    elif family == 'ring':
        z = np.exp(1j * u) * (1 + sum(rng.uniform(0, .3) / k * np.cos(k * u + rng.uniform(0, 6))
                                      for k in (2, 3, 4)))
    elif family == 'campus':  # each lap another way, from the gate and back
        lap = np.minimum(u // (2 * np.pi), laps - 1).astype(int)
        turn = np.exp(2j * np.pi / laps * (lap + rng.uniform(-.3, .3, laps)[lap]))
        z = turn * rng.uniform(.6, 1.4, laps)[lap] * (
            1 - np.cos(u) + 1j * np.sin(u) * rng.uniform(.5, 1.2, laps)[lap])
    elif family == 'hub':
        k = np.concatenate([rng.permutation(laps + 2) for _ in range(rng.integers(1, 4))])
        way = rng.uniform(.6, 1.4, laps + 2)[k] * np.exp(2j * np.pi * k / (laps + 2))
        z = np.column_stack([.05 * way, way, .05 * way]).ravel()
    else:  # the shop
        z = [0, .1]
        for stops in rng.integers(2, 6, max(4, int(length / 50))):
            z += [*(rng.random(stops) + .7j * rng.random(stops)), .1, 0]
    points = np.column_stack([np.real(z), np.imag(z), np.zeros(len(z))])
    return points * length / np.linalg.norm(np.diff(points, axis=0), axis=1).sum()


def _tour(rng: Any, family: str, length: float, step: float) -> tuple[Array, Array | None]:
    """Plan a drive: its corners (k, 3), and the way (3,) to the next place that is alike."""
    if family == 'storeys' or (family == 'handheld' and rng.random() < .4):
        return _storeys(rng, length)
    if family in GRIDS:
        low, high, shape = GRIDS[family]
        spacing = rng.uniform(low, high)
        spacing *= min(1, length / 14 / spacing.mean())
        return _wander(rng, length, shape, spacing), np.array([0, spacing[1], 0])
    if family in ('car park', 'warehouse'):
        return (_car_park if family == 'car park' else _warehouse)(rng, length)
    if family in ('mowing', 'drone'):
        return _rows_of_a_field(rng, length, step)
    return _laps(rng, family, length), None


def _drive(rng: Any, family: str, step: float) -> tuple[Array, Array | None]:
    """Drive a family's tour: 150 to 1,500 true poses (n, 4, 4), and what is alike."""
    points, alike = _tour(rng, family, _log(rng, 180, 1400) * step, step)
    gone = np.insert(np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)), 0, 0)
    dense = np.arange(0, gone[-1], step / 5)
    x = gaussian_filter1d([np.interp(dense, gone, c) for c in points.T], 4, mode='nearest').T

    def slow(size: float, width: float = 40) -> Array:
        y = gaussian_filter1d(rng.normal(size=len(x)), width)
        return size * y / y.std()

    flown, held = family == 'drone', family == 'handheld'
    stray = (PLANE | SPACE)[family][2] * step
    x += np.column_stack([slow(stray), slow(stray), slow((.6 * flown + .2 * held) * step)])
    way = np.gradient(x, axis=0)
    yaw = gaussian_filter1d(np.unwrap(np.arctan2(way[:, 1], way[:, 0])), 3)
    yaw = slow(.1) if flown and rng.random() < .5 else yaw + slow(.4 * held, 20)
    tilt = .15 if held else .06 if flown else .01 if family in SPACE else 0
    slope = -np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1])) * (not flown and not held)
    pitch = slow(tilt, 15) + gaussian_filter1d(slope, 5)
    keep = np.cumsum(rng.uniform(4, 6, 1500)).astype(int)
    keep = keep[keep < len(x)]
    angles = np.column_stack([yaw, pitch, slow(tilt, 15)])
    return _poses(Rotation.from_euler('ZYX', angles[keep]), x[keep]), alike


def _odometry(rng: Any, noise: Iterable[str], step: Array, size: float) -> tuple[Array, Array]:
    """Put a robot's faults into true steps (n, 4, 4); give the errors and the stated sigmas."""
    n, good = len(step), .2 if 'clean' in noise else 1
    sigma = np.full((n, 6), good * size * _log(rng, .005, .05))
    sigma[:, 3:] = good * _log(rng, .001, .01)
    if rng.random() < .5:  # the more it turns, the less it knows
        sigma[:, 3:] += .02 * good * Rotation.from_matrix(step[:, :3, :3]).magnitude()[:, None]
    error = rng.normal(size=(n, 6)) * sigma
    if 'misstated' in noise:
        error *= 4 ** rng.uniform(-1, 1)
    if 'tails' in noise:
        error *= np.where(rng.random(n) < .05, rng.uniform(4, 10, n), 1)[:, None]
    if 'scale' in noise:
        step[:, :3, 3] *= 1 + rng.choice([-1, 1]) * rng.uniform(.01, .025)
    if 'bias' in noise:
        error[:, 5] += rng.choice([-1, 1]) * rng.uniform(.05, .4) / n
    if 'walk' in noise:
        bias = np.cumsum(rng.normal(size=n))
        error[:, 5] += bias * rng.uniform(.1, .5) / np.abs(np.cumsum(bias)).max()
    for k in rng.integers(n, size=rng.integers(1, 6) if 'slip' in noise else 0):
        burst = slice(k, k + rng.integers(2, 11))
        step[burst, :3, 3] *= rng.uniform(.3, .9)
        error[burst, 5] += rng.normal(0, .05)
    return error, sigma


def _revisits(rng: Any, truth: Array, step: float, most: float) -> tuple[float, int, Array]:
    """Find what a front end could join: radius, smallest gap in keyframes, pairs (k, 2)."""
    t, ahead = truth[:, :3, 3], truth[:, :3, 0]
    radius, camera = min(most, step * rng.uniform(.8, 3)), rng.random() < .4
    distance = np.linalg.norm(t[:, None] - t, axis=2)
    while True:
        gap = max(15, int(4 * radius / step))
        near = np.triu(distance < radius, gap) & (not camera or ahead @ ahead.T > .5)
        if near.sum() >= 30:
            return radius, gap, np.argwhere(near)
        radius, camera = radius * (1 if camera else 1.3), False


def _lie(rng: Any, kind: str, T: Array, near: tuple[float, int, float], alike: Array | None,
         count: int) -> tuple[Array, Array]:
    """Claim by one transform that a later stretch is at an earlier one: pairs, relative poses."""
    t, (radius, gap, step), best = T[:, :3, 3], near, (np.empty((0, 2), int), T[:0])
    for _ in range(30):
        j = rng.integers(gap + 1, len(t)) + np.arange(1 if kind == 'random' else 2 * count)
        j = j[j < len(t)]
        S, far = np.eye(4), .8 * step
        if kind == 'shift' and alike is not None:
            S[:3, 3] = rng.choice([-1, 1]) * alike
        elif kind == 'along':
            S[:3, 3] = rng.choice([-1, 1]) * rng.uniform(1, 5) * radius * T[j[0], :3, 0]
        else:
            a, b, far = rng.integers(j[0] - gap), j[0], 3 * radius
            yaw = [np.arctan2(T[k, 1, 0], T[k, 0, 0]) for k in (a, b)]
            turn = yaw[0] - yaw[1] + rng.choice([0, 0, 0, np.pi])
            S[:3, :3] = Rotation.from_euler('z', turn).as_matrix()
            S[:2, 3] = rng.uniform(-.4, .4, 2) * radius
            S[:3, 3] += t[a] - S[:3, :3] @ t[b]
        moved = S @ T[j]
        distance = np.linalg.norm(moved[:, None, :3, 3] - t, axis=2)
        distance[np.arange(len(t)) > j[:, None] - gap] = np.inf
        wrong = np.linalg.norm(moved[:, :3, 3] - t[j], axis=1) > far
        k = np.flatnonzero(wrong & (distance.min(axis=1) < radius))[:count]
        if len(k) > len(best[0]):
            i = distance[k].argmin(axis=1)
            best = np.column_stack([i, j[k]]), np.linalg.inv(T[i]) @ moved[k]
    return best


def _loops(rng: Any, kind: str, truth: Array, alike: Array | None, step: float
           ) -> tuple[float, int, list[tuple[Array, Array]]]:
    """Draw loops: the radius within which they are found, how many are true, pairs and claims."""
    most = np.inf if alike is None else max(step, .6 * float(np.linalg.norm(alike)))
    radius, gap, pairs = _revisits(rng, truth, step, most)
    true = int(rng.integers(3, 11) if kind == 'hopeless' else
               _log(rng, 3, min(len(pairs), 1.5 * len(truth))))
    place = rng.random(len(truth))[pairs[:, 1] // rng.choice([1, 8])]  # singly, or by places
    pairs = pairs[np.argsort(place + .01 * rng.random(len(pairs)))[:true]]
    found = [(pairs, np.linalg.inv(truth[pairs[:, 0]]) @ truth[pairs[:, 1]])]
    share = {'none': 0, 'hopeless': rng.uniform(.55, .85), 'hard': rng.uniform(.2, .5)}.get(
        kind, .5 if 'alias' in kind and rng.random() < .4 else .05 + .45 * rng.beta(1, 1.5))
    left = int(np.ceil(true * share / (1 - share)))
    for _ in range({'alias': 1, 'aliases': rng.integers(2, 6)}.get(kind, 2 * left)):
        which = rng.choice(LIES) if kind[0] == 'h' else 'alias' if kind == 'aliases' else kind
        size = min(left, int(rng.integers(10, 41)))
        if size > 0:
            found.append(_lie(rng, which, truth, (radius, gap, step), alike, size))
            left -= len(found[-1][0])
    return radius, true, found


def _loop_error(rng: Any, radius: float, n: int) -> tuple[Array, Array]:
    sigma = np.repeat([_log(rng, .02, .1) * radius, _log(rng, .002, .03)], 3)
    tails = rng.random(n) < (.05 if rng.random() < .2 else 0)
    error = rng.normal(size=(n, 6)) * sigma
    return error * np.where(tails, rng.uniform(3, 8, n), 1)[:, None], np.tile(sigma, (n, 1))


def draw(number: int) -> World:
    """Make the world of a number, always the same."""
    rng = np.random.default_rng([906, number])
    family, lot = str(rng.choice([*(SPACE if rng.random() < 1 / 3 else PLANE)])), rng.random()
    kind = ('none' if lot < .2 else 'hopeless' if lot < .3 else 'hard' if lot < .4
            else str(rng.choice([*LIES, 'aliases'])))
    noise = rng.choice(FAULTS[1:7] if kind == 'hard' else FAULTS, replace=False,
                       size=3 if kind == 'hard' else rng.choice([1, 1, 1, 2]))
    stated = str(rng.choice(['honest', 'identity', 'equal'], p=[.7, .12, .18]))
    step = rng.uniform(*(PLANE | SPACE)[family][:2])
    truth, alike = _drive(rng, family, step)
    radius, true, found = _loops(rng, kind, truth, alike, step)
    k, d, rows = np.arange(len(truth) - 1), 6 if family in SPACE else 3, len(truth) - 1
    found.insert(0, (np.column_stack([k, k + 1]), np.linalg.inv(truth[:-1]) @ truth[1:]))
    pairs, first = np.unique(np.vstack([p for p, _ in found]), axis=0, return_index=True)
    order = np.lexsort([pairs[:, 1], first >= rows])  # loops as they come; one for each pair
    pairs, first = pairs[order], first[order]
    measured = np.concatenate([z for _, z in found])[first]
    error, sigma = _odometry(rng, noise, measured[:rows], step)
    spread, of_loop = _loop_error(rng, radius, len(pairs) - rows)
    error, sigma = np.vstack([error, spread]), np.vstack([sigma, of_loop])
    if d == 3:
        error[:, 2:5] = 0
    measured = measured @ _poses(Rotation.from_rotvec(error[:, 3:]), error[:, :3])
    start = np.tile(np.eye(4), (rows + 1, 1, 1))
    for k in range(rows):
        start[k + 1] = start[k] @ measured[k]
    weight = 1 / sigma[:, [0, 1, 5] if d == 3 else slice(6)] ** 2
    if stated == 'honest':
        weight[:, 3:] *= 4  # of the quaternion's vector part, which is half the angle
    else:
        weight = weight[:, :1] ** (stated == 'equal') * np.ones(d)
    facts = {'lies': kind, 'noise': '+'.join(noise), 'information': stated}
    return World(family, facts, truth, start, pairs, measured, weight, first >= rows + true)
