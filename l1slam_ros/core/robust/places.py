# SPDX-License-Identifier: Apache-2.0
"""
Places: loops that may be one mistake, and how often neighbours among the refused are.

In: a graph. Out: the number of the place of each loop. Two loops that join the same two stretches
of the way and claim nearly the same are linked; a place is what links tie together (single
linkage). Near is measured along the way in metres, never in keyframes.
"""

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.factor_graph import FactorGraph, ends_in_time
from l1slam_ros.core.graph.linear_system import with_world

# Linked are loops whose ends lie within so many metres along the way, in sum, or within the length
# of so many ordinary steps, where keyframes are far apart; and what they claim, too.
_NEAR, _NEAR_STEPS = 5.0, 10
# Claims are told apart to this part of it, so that a robot that stands has few different ones.
_GRAIN = 0.1


def places(graph: FactorGraph, chain: Array) -> tuple[Indices, Array]:
    """
    Return of each factor the number of its place, (m,), and where it joins the way, (m, 2).

    The latter are the sum and the difference of its ends' distances along the way, in units of
    what is near: so two factors are as far apart as the larger difference of the two numbers.

    chain : (n, p) poses along the odometry
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    manifold, (low, high, Z) = graph.manifold, ends_in_time(graph)
    positions = manifold.positions(chain)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    # The world is where the way begins, as WORLD finds it: last.
    way = np.concatenate(([0.0], np.cumsum(steps), [0.0]))
    near = max(_NEAR, _NEAR_STEPS * float(np.median(steps)) if len(steps) else 0.0)
    ends = np.stack((way[high] + way[low], way[high] - way[low]), axis=1) / near
    claimed = manifold.compose(with_world(manifold, chain)[low], Z)
    claim = manifold.positions(claimed) - positions[high]
    cells, cell = np.unique(np.round(np.hstack((ends, claim / near)) / _GRAIN), axis=0,
                            return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1 / _GRAIN, p=np.inf, output_type='ndarray')
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells),) * 2)
    place: Indices = connected_components(links, directed=False)[1].astype(np.int64)
    return place[cell.ravel()], ends


def neighbours_agree(place: Indices, ends: Array) -> float:
    """
    Return how often the nearest other loop within reach is of the same place, at least.

    place, ends : of the loops that are asked, see `places`. Where few have neighbours the answer
    is near 1: nothing is known of how lies come here.
    """
    from scipy.spatial import cKDTree

    if len(place) < 2:
        return 1.0
    distance, index = cKDTree(ends).query(ends, 2, p=np.inf)
    near = distance[:, 1] < 1
    other = np.where(index[:, 0] == np.arange(len(place)), index[:, 1], index[:, 0])
    agree = np.count_nonzero(near & (place[other] == place))
    return float((agree + 1) / (np.count_nonzero(near) + 1))
