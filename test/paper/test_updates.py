# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A growing map, measured: the back end gets the graph, the peer its turn, the batch its sizes."""

import numpy as np

from l1slam_ros.core.graph.factor_graph import turned
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper.updates import Drive, measure_growth, run_updates


def peer(k):
    """Take 2 ms each, and have no time left after 50."""
    return [0.002] if k < 50 else []


def test_the_back_end_gets_all_of_the_graph_and_the_peer_its_turns():
    graph = simulate_world(80, 160, WorldOptions(), np.random.default_rng(3)).graph
    backward = ~graph.between.is_odometry & (np.arange(160) % 2 == 0)
    told = []
    drive = Drive.of(turned(graph, backward))
    found = run_updates(drive, peer, 1e4, 4, advance=lambda: told.append(1))
    assert len(found.ours) == len(told) == 80 and min(found.ours) > 0
    assert found.peer == [0.002] * 50
    assert [now.graph.n_poses for now in found.on_the_way] == [20, 40, 60, 80]
    kept = found.at_rest.graph.between
    np.testing.assert_array_equal(kept.pairs, graph.between.pairs)
    np.testing.assert_allclose(kept.measurement, graph.between.measurement, atol=1e-9)
    np.testing.assert_allclose(kept.sqrt_information, graph.between.sqrt_information, atol=1e-9)


def test_updates_keep_to_their_rate_and_the_batch_is_solved_on_the_way():
    updates, batch = measure_growth(60, 200.0, np.random.default_rng(0))
    sizes = [now.graph.n_poses for now in updates.on_the_way]
    assert updates.elapsed >= 60 / 200
    assert sizes[-1] == 60 and (np.diff(sizes) > 0).all()
    assert len(batch) == len(sizes) and (batch > 0).all()
