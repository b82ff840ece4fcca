# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Slips of which each alone explains little; those that are found one by one: `test_slips.py`."""

import numpy as np
import pytest
from lies import careful_world, slipped, spoilt
from problems import chain_of, graph_of

from l1slam_ros.core.robust.batch import robust_solve


@pytest.fixture(scope='module')
def way_and_back():
    """Return a way about two corners and back again, with 25 loops from the one to the other."""
    rng = np.random.default_rng(0)
    heading = np.repeat([0.0, np.pi / 2, 0.0], 50)
    out = np.cumsum(np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    back = out[::-1] + rng.normal(0, 0.2, out.shape)
    truth = np.column_stack((np.concatenate((out, back)),
                             np.concatenate((heading, heading[::-1] + np.pi))))
    first = np.sort(rng.choice(len(out) - 10, 25, replace=False))
    pairs = np.concatenate((chain_of(len(truth)), np.stack((first, len(truth) - 1 - first), 1)))
    sure = np.diag([400.0, 400.0, 4e4])
    noise = rng.standard_normal((len(pairs), 3)) / np.sqrt(np.diag(sure))
    return graph_of(truth, pairs, noise, sure)


@pytest.mark.parametrize('steps', [
    [60, 130, 200],  # none was found: each alone leaves a motion as no robot moves
    [110, 140, 250]])  # the last was cut on the way out, where the same loops span it
def test_slips_that_no_loop_tells_apart_from_others(way_and_back, steps):
    graph = slipped(way_and_back, steps, [0.0, 0.0, np.pi / 2])
    judgement, _ = robust_solve(graph)
    assert graph.between.i[judgement.slips].tolist() == steps and not judgement.doubts


def test_slips_of_which_each_explains_little():
    """Two of the three left the loops across the third in a map that was off as far."""
    world = spoilt(careful_world(300, 389, 3), 'random', 30)
    graph = slipped(world.graph, steps := [90, 150, 220], [0.0, 0.0, 1.5])
    judgement, _ = robust_solve(graph)
    assert graph.between.i[judgement.slips].tolist() == steps and not judgement.doubts
