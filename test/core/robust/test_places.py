# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A place is measured in metres along the way, and has one vote."""

import numpy as np
import pytest
from lies import careful_world
from problems import chain_of, graph_of, measure, straight

from l1slam_ros.core.robust.places import beside_refused, first_told, mates, places


def corridor(step, pairs, off):
    """Return a drive along a line with loops that are wrong by so much [m], and its chain."""
    n = 1 + max(max(pair) for pair in pairs)
    poses = straight(n, step)
    graph = graph_of(poses, chain_of(n), 0.0, np.eye(3))
    measure(graph, poses, *np.array(pairs).T, np.outer(off, [0.0, 1.0, 0.0]), np.eye(3))
    return graph, poses


@pytest.mark.parametrize('step, apart, same', [(0.1, 20, True), (0.1, 30, False), (2.0, 5, True),
                                               (2.0, 6, False)])
def test_near_is_within_metres_or_within_ordinary_steps(step, apart, same):
    """5 m in sum where keyframes are dense, ten steps where they are far apart."""
    pairs = [(0, 300), (apart, 300 + apart)]
    graph, chain = corridor(step, pairs, np.zeros(2))
    place, _ = places(graph, chain)
    assert (place[-1] == place[-2]) == same


def test_a_run_is_one_place_and_what_claims_something_else_is_another():
    pairs = [(k, 200 + k) for k in range(50)] + [(25, 226)]
    off = np.concatenate((np.full(50, 3.0), [30.0]))
    graph, chain = corridor(1.0, pairs, off)
    place = places(graph, chain)[0][-51:]
    assert len(set(place[:50].tolist())) == 1 and place[50] not in place[:50]


def test_the_same_told_twice_is_told_first_and_another_measurement_is_not():
    pairs = [(0, 9), (0, 9), (9, 0), (0, 9), (0, 9), (0, 8)]
    graph = graph_of(straight(10, 1.0), chain_of(10), 0.0, np.eye(3))
    turn = [0.0, 0.0, 3.1415926]
    for pair, Z in zip(pairs, [[9, 0, 0], [9, 0, 2e-4], [-9, 0, 0], [9, 0, 0.00021], turn, turn],
                       strict=True):
        graph.add_between(*np.array([pair]).T, np.array([Z], float), np.eye(3)[None])
    graph.add_between([0], [9], np.array([[0.0, 0.0, -3.1415926]]), np.eye(3)[None])
    first = first_told(graph, np.arange(9, 16))
    assert first.tolist() == [*range(9), 9, 10, 9, 10, 13, 14, 13]


def test_every_loop_of_a_world_has_a_place():
    world = careful_world(200, 400)
    place, ends = places(world.graph, world.odometry)
    assert place.shape == (len(world.graph.between),) and np.isfinite(ends).all()


def test_what_is_true_beside_refused_ones_has_to_be_the_surer_the_rarer_that_was():
    """Of a hundred pairs in a row, each loop's neighbours the two or so next to it."""
    ends = np.column_stack((np.arange(100) * 0.9, np.zeros(100)))
    pairs = mates(np.zeros(100, int), ends)
    refused = np.arange(100) < 10
    refused[5] = False
    against = beside_refused(pairs, refused, np.arange(100) >= 10)
    assert np.flatnonzero(against > 0).tolist() == [*range(4), 5, *range(7, 9)]
    # Of the nine that are refused six stand beside such, of the ninety true ones none.
    assert against[5] == pytest.approx(np.log(7 / 10 * 91))
    assert not beside_refused(mates(np.arange(100), ends), refused, ~refused).any()
