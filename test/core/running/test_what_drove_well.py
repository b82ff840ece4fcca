# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""While a robot drives: what came well is not given up for a map that is more likely wrong."""

import time

import pytest
from lies import careful_world
from problems import EVERY

from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.running.backend import Backend
from l1slam_ros.core.running.keeper import work
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


@pytest.fixture(scope='module')
def world():
    return careful_world(200, 400)


def add(backend, messages):
    """Let a back end hear of keyframes and of the loops that end there."""
    for sample, loops in messages:
        backend.add_odometry(sample)
        for loop in loops:
            backend.add_loop(loop)


@pytest.mark.parametrize(('idle', 'quiet', 'taken'), [
    (False, 0.0, False), (True, 0.5, False), (True, 2.5, True)])
def test_a_run_of_lies_that_comes_first_bends_no_map_before_the_robot_stands(
        graph, idle, quiet, taken):
    """By its own word the map of the lies is 36 m off, and it is 8 m from that of the odometry."""
    backend = Backend(EVERY)
    add(backend, Drive.of(graph).messages)
    backend._keeper.take_what_has_come(0.0)
    carry_out(backend._keeper, Work.JUDGE_ANEW, Moment(0.0, idle, quiet=quiet), lambda: None)
    state = backend._keeper.state
    assert (state.pending is not None) is taken and state.judged.held is not taken
    assert state.all_judged(17) and state.all_judged_anew(17) is taken


def test_judging_anew_for_long_makes_way_for_the_loops_that_came(world, monkeypatch):
    monkeypatch.setattr(work, '_LONGEST', 0.0)
    drive = list(Drive.of(world.graph).messages)
    backend, rest = Backend(EVERY), iter(drive[150:])
    add(backend, drive[:150])
    keeper = backend._keeper
    keeper.take_what_has_come(0.0)
    judged, begun = len(backend.snapshot().loop_rows), time.monotonic()

    def drives_on():
        add(backend, [next(rest)])
        keeper.take_what_has_come(0.0)

    with pytest.raises(Interrupted):
        carry_out(keeper, Work.JUDGE_ANEW, Moment(0.0, False), drives_on)
    state, _, size = keeper.look()
    assert size.loops > judged and state.judged.loops == 0 and state.pending is None
    assert begun < state.judged.anew_ended < time.monotonic()
    # What comes next is quick, and is done; at rest all is done again.
    carry_out(keeper, Work.JUDGE, Moment(0.0, False), lambda: None)
    assert keeper.state.all_judged(size.loops)
    assert not keeper.state.all_judged_anew(size.loops)
