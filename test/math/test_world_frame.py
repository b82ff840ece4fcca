# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Poses are moved as one to where their absolute factors say they are."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import add_absolute, chain_of, drive, graph_of

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.world_frame import placed

WHOLE = np.eye(3)
POSITION = np.diag([1.0, 1, 0])
HEADING = np.diag([0, 0, 1.0])


def moved(poses, motion):
    return se2.compose(np.broadcast_to(motion, poses.shape), poses)


@pytest.mark.parametrize('k, information, false', [
    ([4], WHOLE, []), ([4, 9], POSITION, []), ([1, 5, 9], POSITION, []), ([0, 3, 9], WHOLE, []),
    (range(0, 40, 4), POSITION, [1, 4, 8])])
def test_a_chain_comes_to_its_place_and_a_few_false_ones_do_not_matter(
        k, information, false, rng):
    truth, k = drive(40, rng), np.array(k)
    graph, measured = graph_of(truth, chain_of(40)), truth[k]
    measured[false, :2] += 100 * rng.standard_normal((len(false), 2))
    add_absolute(graph, k, measured, np.tile(information, (len(k), 1, 1)))
    assert_allclose(placed(graph, moved(truth, (30.0, -7.0, 2.0))), truth, atol=1e-9)


def test_what_nothing_says_stays(rng):
    truth = drive(10, rng)
    graph = graph_of(truth, chain_of(10))
    assert placed(graph, truth) is truth
    add_absolute(graph, np.array([4]), np.array([[5.0, 6, 1]]), HEADING[None])
    turned = placed(graph, truth)
    assert turned[4] == pytest.approx([*truth[4, :2], 1.0])
    add_absolute(graph, np.array([4]), np.array([[5.0, 6, 0]]), 1e6 * POSITION[None])
    assert placed(graph, turned)[4, :2] == pytest.approx([5.0, 6.0])


def test_each_part_by_itself(rng):
    truth, k = drive(12, rng), np.array([0, 3, 6, 9])
    graph = graph_of(truth, np.delete(chain_of(12), [4, 9], axis=0))
    add_absolute(graph, k, truth[k], np.tile(POSITION, (4, 1, 1)))
    poses = np.concatenate([moved(truth[part], motion) for part, motion in (
        (slice(0, 5), (3.0, 4, 1)), (slice(5, 10), (-9.0, 2, 3)), (slice(10, 12), (1.0, 1, 1)))])
    found = placed(graph, poses)
    assert_allclose(found[:10], truth[:10], atol=1e-9)
    assert_array_equal(found[10:], poses[10:])
