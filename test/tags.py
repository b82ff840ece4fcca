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
_SIGMA_STEP, _SIGMA_TURN, _SIGMA_SIGHT, _SIGMA_SIGHT_TURN = 0.02, 0.005, 0.05, 0.03


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
    truth : (n, 7) poses of the robot; edges : (tail, head, pose (7,), is a sighting); tails and
    heads are numbers of poses, of tags from `n` on; false : set of (pose, tag)

    """

    def __init__(self, seed, poses=300, tags=6, false=0.0, space=False):
        rng = np.random.default_rng(seed)
        self.space, self.n, self.tags = space, poses, tags
        up = np.array([0, 0, 1.0])
        truth = [(np.zeros(3), np.array([0, 0, 0, 1.0]))]
        for k in range(1, poses):
            p, q = truth[-1]
            p = p + _turn(q, np.array([1.0, 0, 0]))
            if space:
                p[2] = np.sin(k / LAP * 4 * np.pi)
            truth.append((p, _times(q, _quaternion(up * np.pi / 2 * (k % _SIDE == 0)))))
        self.truth = np.array([np.concatenate(pose) for pose in truth])
        at = rng.choice(LAP, tags, replace=False) if tags <= LAP else None
        marks = []
        for k in at:
            p, q = truth[k]
            side = np.array([rng.uniform(1, 3), rng.choice((-1, 1)) * rng.uniform(1, 2),
                             rng.uniform(0, 1) * space])
            turn = rng.normal(size=3) if space else up * rng.uniform(-3, 3)
            marks.append((p + _turn(q, side), _times(q, _quaternion(turn))))
        self.edges, self.false = [], set()
        for k in range(1, poses):
            self._see(rng, k - 1, k, truth[k - 1], truth[k], (_SIGMA_STEP, _SIGMA_TURN), False)
        for k in range(poses):
            for tag, mark in enumerate(marks):
                seen = _turn(_inverse(truth[k][1]), mark[0] - truth[k][0])
                if seen[0] > 0 and np.linalg.norm(seen) < _SEEN:
                    if rng.uniform() < false:  # another tag's number, or a wrong pose
                        self.false.add((k, tag))
                        mark = (_SEEN * rng.uniform(-1, 1, 3) * (1, 1, space), _quaternion(
                            rng.normal(size=3) * 2 if space else up * rng.uniform(-3, 3)))
                        mark = (truth[k][0] + mark[0], mark[1])
                    self._see(rng, k, poses + tag, truth[k], mark,
                              (_SIGMA_SIGHT, _SIGMA_SIGHT_TURN), True)

    def _see(self, rng, tail, head, a, b, sigma, sighting):
        p, q = _turn(_inverse(a[1]), b[0] - a[0]), _times(_inverse(a[1]), b[1])
        on = np.ones(3) if self.space else np.array([1, 1, 0.0])
        turn = np.ones(3) if self.space else np.array([0, 0, 1.0])
        p = p + _turn(q, rng.normal(0, sigma[0], 3) * on)
        q = _times(q, _quaternion(rng.normal(0, sigma[1], 3) * turn))
        self.edges.append((tail, head, np.concatenate((p, q)), sighting))

    def write(self, path, ids=None, tags_first=False, identity=False, vertices=False):
        """Write the graph, and its truth beside it; ids : of poses and then of tags."""
        if ids is None:
            ids = [*range(self.n), *range(10 * self.n, 10 * self.n + self.tags)]
        lines = [self._line(ids, *edge) for edge in self.edges]
        sights = [line for line, edge in zip(lines, self.edges, strict=True) if edge[3]]
        steps = [line for line, edge in zip(lines, self.edges, strict=True) if not edge[3]]
        path.write_text('\n'.join(sights + steps if tags_first else steps + sights) + '\n')
        truth = path.with_suffix('.tum') if self.space else path.with_suffix('.txt')
        truth.write_text(''.join(self._true(ids[k], pose) for k, pose in enumerate(self.truth)))
        return truth

    def _true(self, vertex, pose):
        if self.space:
            return 'VERTEX_SE3:QUAT ' + ' '.join(map(str, [vertex, *pose.tolist()])) + '\n'
        return f'{vertex} {pose[0]} {pose[1]} {2 * np.arctan2(pose[5], pose[6])}\n'

    def _line(self, ids, tail, head, pose, sighting):
        sigma = (_SIGMA_SIGHT, _SIGMA_SIGHT_TURN) if sighting else (_SIGMA_STEP, _SIGMA_TURN)
        move, turn = (1 / one**2 for one in sigma)
        if self.space:
            # The information is that of the quaternion's vector part, half of the angle.
            diagonal = np.repeat((move, 4 * turn), 3)
            information = np.diag(diagonal)[np.triu_indices(6)]
            values, tag = pose, 'EDGE_SE3:QUAT'
        else:
            information = (move, 0, 0, move, 0, turn)
            values, tag = (*pose[:2], 2 * np.arctan2(pose[5], pose[6])), 'EDGE_SE2'
        return ' '.join(map(str, [tag, ids[tail], ids[head], *np.round(values, 9), *information]))
