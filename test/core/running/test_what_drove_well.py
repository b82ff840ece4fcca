# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""While a robot drives: what came well is not given up for a map that is more likely wrong."""

import pytest
from problems import EVERY

from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.keeper.schedule import Moment, Work
from l1slam_ros.core.running.keeper.work import carry_out
from l1slam_ros.io.graphs.graph_file import read_graph_file
from l1slam_ros.paper.updates import Drive, first_of


@pytest.fixture(scope='module')
def graph(datasets):
    """The first keyframes of Bicocca: a run of eleven lies, and hardly a true loop."""
    graph = read_graph_file(datasets / 'real' / 'bicocca25b_0.150.g2o').graph
    known = (graph.between.pairs < 1600).all(axis=1)
    return first_of(graph, 1600, known.nonzero()[0])


def driven(graph):
    """Return a back end that has heard of a graph and was not updated."""
    backend = Backend(EVERY)
    for sample, loops in Drive.of(graph).messages:
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)
    backend._keeper.take_what_has_come(0.0)
    return backend


@pytest.mark.parametrize(('idle', 'quiet', 'taken'), [
    (False, 0.0, False), (True, 0.5, False), (True, 2.5, True)])
def test_a_run_of_lies_that_comes_first_bends_no_map_before_the_robot_stands(
        graph, idle, quiet, taken):
    """By its own word the map of the lies is 36 m off, and it is 8 m from that of the odometry."""
    backend = driven(graph)
    carry_out(backend._keeper, Work.JUDGE_ANEW, Moment(0.0, idle, quiet=quiet), lambda: None)
    state = backend._keeper.state
    assert (state.pending is not None) is taken and state.judged.held is not taken
    assert state.all_judged(17) and state.all_judged_anew(17) is taken
