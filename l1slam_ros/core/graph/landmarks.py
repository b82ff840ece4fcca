# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Landmarks: pose vertices that the robot was never at, seen from several of its keyframes.

In: the vertices and edges of a graph file. Out: which vertices are landmarks (AprilTags, other
markers): no odometry leads through them. And a graph where each landmark follows the keyframe of
one of its sightings, as on a side branch of the way, so that the others are loops through it.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import LANDMARK, NO_PREDECESSOR, WORLD, FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key


def mark_landmarks(graph: FactorGraph, ids: Indices, i: Indices, j: Indices) -> None:
    """
    Find the landmarks of a graph that is being read, and let the odometry lead past them.

    Parameters
    ----------
    graph : its keyframes, each the successor of the one before of its robot
    ids : (n,) vertex ids, ascending
    i, j : (m,) keyframes that the edges of the file join, i may be `WORLD`

    """
    landmark = find_landmarks(graph.predecessor, ids, i, j)
    if not landmark.any():
        return
    robot, before = graph.robot.copy(), np.full(len(ids), NO_PREDECESSOR)
    for number in np.unique(robot).tolist():
        own = np.flatnonzero((robot == number) & ~landmark)
        before[own[1:]] = own[:-1]
    robot[landmark] = LANDMARK
    graph.follow(np.arange(len(ids)), before, robot)


def find_landmarks(predecessor: Indices, ids: Indices, i: Indices, j: Indices) -> Mask:
    """
    Return which vertices are landmarks, (n,) bool.

    Those that edges join to poses of the robot, but none to the vertices before or after them. The
    id of the first or last of them may be next to a pose that sees it, so that its edge looks like
    odometry. A landmark has no edge of its own, only edges that lead to it, two or more; and

    - its id is no nearer to the poses than to the landmarks, or jumps further than any other; or
    - the edge from the vertex after it points back, where odometry points onward; or
    - the vertices before and after it are joined by an edge that leads past it.

    Parameters
    ----------
    predecessor : (n,) the vertex before each of the same robot, -1: there is none
    ids : (n,) vertex ids, ascending
    i, j : (m,) ends of the edges, i may be `WORLD`

    """
    n = len(ids)
    i, j = i[i != WORLD], j[i != WORLD]
    edges = np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
    pairs = np.unique(pair_key(i, j, n))
    before = predecessor
    after = np.full(n, NO_PREDECESSOR)
    after[before[before >= 0]] = np.flatnonzero(before >= 0)

    def joined(a: Indices, b: Indices) -> Mask:
        return np.asarray((a >= 0) & (b >= 0) & np.isin(pair_key(a, b, n), pairs))

    k = np.arange(n)
    behind, ahead = joined(before, k), joined(k, after)
    alone = ~behind & ~ahead & (edges > 0)
    # Where two such vertices see each other, the file is none of a robot that keeps its odometry.
    sees = alone[i] & alone[j]
    alone[i[sees]] = alone[j[sees]] = False
    only_seen = (np.bincount(i, minlength=n) == 0) & (edges >= 2) & ~alone
    landmark = alone | (only_seen & (behind | ahead) & joined(before, after))
    # Ids of landmarks may be anything: their differences are beyond 64 bits.
    value = ids.astype(float)
    step = np.where(before >= 0, value - value[before], 0.0)
    forward = np.zeros(n, bool)
    onward = i == before[j]
    forward[j[onward]] = True
    for vertex in np.flatnonzero(only_seen & (behind != ahead)).tolist():
        if behind[vertex]:
            pose, other, jump = before[vertex], after[vertex], step[vertex]
            usual = step[_run(vertex, before, behind)].max(initial=0.0)
            points_back = False
        else:
            pose, other, jump = after[vertex], before[vertex], step[after[vertex]]
            usual = np.inf
            points_back = bool(ahead[pose] and forward[after[pose]])
        near = other >= 0 and alone[other] and abs(value[vertex] - value[other]) <= jump
        far = 0.0 < usual < jump and not (other >= 0 and alone[other])
        landmark[vertex] = near or far or points_back
    poses = ~landmark & (edges > 0)
    return landmark & poses.any()


def _run(vertex: int, before: Indices, behind: Mask) -> Indices:
    """Return the vertices before one that odometry leads to it from, but for the first, (k,)."""
    run = []
    k = int(before[vertex])
    while behind[k]:
        run.append(k)
        k = int(before[k])
    return np.array(run, np.int64)


def first_sightings(graph: FactorGraph) -> Indices:
    """Return the first sighting of each landmark that has one, rows (l,); see `sightings`."""
    rows, landmark, _ = sightings(graph)
    return rows[np.unique(landmark, return_index=True)[1]]


def sightings(graph: FactorGraph) -> tuple[Indices, Indices, Indices]:
    """
    Return the sightings of landmarks: rows (k,), landmarks (k,), and whence they are seen, (k,).

    They are ordered by landmark and then by keyframe. Of several from one keyframe, the first.
    """
    factors, landmark = graph.between, graph.is_landmark
    sees = ~factors.is_absolute & (landmark[factors.i] != landmark[factors.j])
    rows = np.flatnonzero(sees)
    turned = landmark[factors.i[rows]]
    seen = np.where(turned, factors.i[rows], factors.j[rows])
    keyframe = np.where(turned, factors.j[rows], factors.i[rows])
    _, first = np.unique(seen * graph.n_poses + keyframe, return_index=True)
    return rows[first], seen[first], keyframe[first]


def along_the_way(graph: FactorGraph, placing: Indices) -> tuple[FactorGraph, Indices]:
    """
    Return the graph where each landmark follows the keyframe of a sighting, and stands behind it.

    Then indices are in the order of the way. Also the index there of each pose of the graph, (n,).

    placing : (l,) rows of the sightings that place a landmark, see `sightings`
    """
    landmark, n = graph.is_landmark, graph.n_poses
    factors = graph.between
    i, j = factors.i[placing], factors.j[placing]
    seen, keyframe = np.where(landmark[i], (i, j), (j, i))
    stands = np.where(landmark, n, np.arange(n))
    stands[seen] = keyframe
    order = np.lexsort((np.arange(n), landmark, stands))
    number = np.argsort(order)
    before = graph.predecessor.copy()
    before[seen] = keyframe
    before = np.where(before == NO_PREDECESSOR, NO_PREDECESSOR, number[before])[order]
    way = FactorGraph(graph.manifold, n)
    way.follow(np.arange(n), before, graph.robot[order])
    world = factors.is_absolute
    way.append_between(np.where(world, WORLD, number[factors.i]), number[factors.j],
                       factors.measurement, factors.sqrt_information, factors.trusted,
                       factors.struck)
    return way, number


def by_first_sightings(graph: FactorGraph) -> tuple[FactorGraph, Indices]:
    """Return `along_the_way` with landmarks placed by their first sightings; none: the graph."""
    if not graph.is_landmark.any():
        return graph, np.arange(graph.n_poses)
    return along_the_way(graph, first_sightings(graph))
