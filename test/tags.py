# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A robot that drives laps through a hall whose walls carry tags, as files of its graph."""

import numpy as np

LAP = 100  # poses, 1 m apart
_SIDE, _SEEN = 25, 5.0
# [m, rad] Of a step, and of a sighting.
_SIGMAS = (0.02, 0.005), (0.05, 0.03)


def _quaternion(vector):
    """Return the quaternion x y z w of a rotation vector."""
    angle = np.linalg.norm(vector)
    return np.append(np.sinc(angle / (2 * np.pi)) / 2 * vector, np.cos(angle / 2))


def _times(a, b):
    """Return the product of two quaternions x y z w."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])


def _turn(q, v):
    """Return a vector turned by a quaternion."""
    return _times(_times(q, np.append(v, 0)), _inverse(q))[:3]


def _inverse(q):
    return q * (-1, -1, -1, 1)


class TagWorld:
    """
    Laps of a square of 25 m a side, tags beside it, each seen from the poses within 5 m.

    Attributes
    ----------
    truth : of the poses of the robot, as of the tags, (position (3,), quaternion (4,)); edges :
    [tail, head, (7,), is a sighting], heads from `n` on are tags; false : set of (pose, tag)

    """

    def __init__(self, seed, poses=300, tags=6, false=0.0, space=False):
        self._rng = rng = np.random.default_rng(seed)
        self.space, self.n, self.tags = space, poses, tags
        self._up = np.array([0, 0, 1.0])
        self.truth = [(np.zeros(3), np.array([0, 0, 0, 1.0]))]
        for k in range(1, poses):
            p, q = self.truth[-1]
            p = p + _turn(q, np.array([1.0, 0, 0]))
            p[2] = np.sin(k / LAP * 4 * np.pi) * space
            q = _times(q, _quaternion(self._up * np.pi / 2 * (k % _SIDE == 0)))
            self.truth.append((p, q))
        self._marks = [self._beside(*self.truth[k])
                       for k in rng.choice(LAP, tags, replace=False).tolist()]
        self.edges, self.false = [], set()
        for k in range(1, poses):
            self._measure(k - 1, k, self.truth[k], False)
        for k in range(poses):
            away = np.array([at for at, _ in self._marks]) - self.truth[k][0]
            for tag in np.flatnonzero(np.linalg.norm(away, axis=1) < _SEEN).tolist():
                if _turn(_inverse(self.truth[k][1]), away[tag])[0] > 0:
                    self.see(k, tag, rng.uniform() < false)

    @property
    def sightings(self):
        """How many there are."""
        return sum(edge[3] for edge in self.edges)

    @property
    def false_pairs(self):
        """The pairs of ids of false sightings, as `write` gives them where none are asked for."""
        return {(pose, 10 * self.n + tag) for pose, tag in self.false}

    def see(self, pose, tag, false=False):
        """Add a sighting; a false one is of something near, turned by anything."""
        mark = self._marks[tag]
        if false:
            self.false.add((pose, tag))
            at = _SEEN * self._rng.uniform(-1, 1, 3) * (1, 1, self.space)
            mark = self.truth[pose][0] + at, self._any_turn()
        self._measure(pose, self.n + tag, mark, True)

    def falsify_first(self, tag):
        """Let the first sighting of a tag be false."""
        first = next(k for k, edge in enumerate(self.edges) if edge[1] == self.n + tag)
        self.see(self.edges[first][0], tag, True)
        self.edges[first] = self.edges.pop()

    def _beside(self, p, q):
        rng = self._rng
        side = np.array([rng.uniform(1, 3), rng.choice((-1, 1)) * rng.uniform(1, 2),
                         rng.uniform(0, 1) * self.space])
        return p + _turn(q, side), _times(q, self._any_turn())

    def _any_turn(self):
        return _quaternion(2 * self._rng.normal(size=3) if self.space
                           else self._up * self._rng.uniform(-3, 3))

    def _measure(self, tail, head, there, sighting):
        """Add the edge from a pose of the robot to what is there."""
        move, turn = _SIGMAS[sighting]
        p, q = self.truth[tail]
        at, turned = _turn(_inverse(q), there[0] - p), _times(_inverse(q), there[1])
        plane = np.ones(3) if self.space else 1 - self._up
        axes = np.ones(3) if self.space else self._up
        at = at + _turn(turned, self._rng.normal(0, move, 3) * plane)
        turned = _times(turned, _quaternion(self._rng.normal(0, turn, 3) * axes))
        self.edges.append([tail, head, np.concatenate((at, turned)), sighting])

    def write(self, path, ids=None, tags_first=False):
        """Write the graph, and its truth beside it; ids : of poses and then of tags."""
        if ids is None:
            ids = [*range(self.n), *range(10 * self.n, 10 * self.n + self.tags)]
        lines = [self._line(ids, *edge) for edge in self.edges]
        sights = [line for line, edge in zip(lines, self.edges, strict=True) if edge[3]]
        steps = [line for line, edge in zip(lines, self.edges, strict=True) if not edge[3]]
        path.write_text('\n'.join(sights + steps if tags_first else steps + sights) + '\n')
        truth = path.with_name('truth.g2o' if self.space else 'truth.txt')
        truth.write_text(''.join(self._true(ids[k], np.concatenate(pose))
                                 for k, pose in enumerate(self.truth)))
        return truth

    def _true(self, vertex, pose):
        if self.space:
            return ' '.join(map(str, ['VERTEX_SE3:QUAT', vertex, *pose])) + '\n'
        return f'{vertex} {pose[0]} {pose[1]} {2 * np.arctan2(pose[5], pose[6])}\n'

    def _line(self, ids, tail, head, pose, sighting):
        move, turn = (1 / one**2 for one in _SIGMAS[sighting])
        if self.space:
            # The information is that of the quaternion's vector part, half of the angle.
            diagonal = np.repeat((move, 4 * turn), 3)
            information = np.diag(diagonal)[np.triu_indices(6)]
            values, tag = pose, 'EDGE_SE3:QUAT'
        else:
            information = (move, 0, 0, move, 0, turn)
            values, tag = (*pose[:2], 2 * np.arctan2(pose[5], pose[6])), 'EDGE_SE2'
        return ' '.join(map(str, [tag, ids[tail], ids[head], *np.round(values, 9), *information]))
