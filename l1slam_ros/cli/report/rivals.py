# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The maps that a doubtful graph may have instead: each doubt decided the other way, solved again.

    one place alone holds the map, or joins two parts     its loops are struck out
    refused loops agree on another map                    they are vouched for
    the map is weak                                       every loop is believed
    a step may have slipped                               it is left out, or believed
    the odometry may drift                                it is corrected, and loops judged anew
    another norm has another map                          that of least squares
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.names import SAME
from l1slam_ros.core.robust.batch_map import Outcome, SolveOptions, solve
from l1slam_ros.core.robust.judgement import (
    DRIFTS,
    NORM,
    OTHER_MAP,
    SLIP,
    UNCONFIRMED,
    WEAK,
    Doubt,
    Judgement,
)
from l1slam_ros.core.robust.odometry.drift import straightened
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.sentences import doubted_rows

# More of them are hard to tell apart, and each is a solve.
_MOST = 3


@dataclass(frozen=True)
class Rival:
    """
    Another map: what was decided otherwise; the doubt's number; graph solved; what came out.

    used : (m,) bool, the factors of the graph of the file that the one solved is of
    """

    name: str
    doubt: int
    graph: FactorGraph
    outcome: Outcome
    used: Mask


@dataclass(frozen=True)
class _Plan:
    name: str
    doubt: int
    graph: FactorGraph
    asked: SolveOptions
    used: Mask | None = None


def rival_maps(record: GraphRecord, outcome: Outcome, asked: SolveOptions,
               begin: Callable[[str], None] = lambda name: None) -> list[Rival]:
    """
    Return at most three other maps of a graph, in the order of the doubts they belong to.

    begin : called with the name of each before it is solved. What cannot be solved is no rival.
    """
    rivals = []
    if outcome.judgement is not None:
        for plan in islice(_plans(record, outcome.judgement, asked), _MOST):
            begin(plan.name)
            try:
                found = solve(plan.graph, record.poses, plan.asked, ids=record.ids)
            except GraphError:
                continue
            every = np.ones(len(record.graph.between), bool)
            rivals.append(Rival(plan.name, plan.doubt, plan.graph, found,
                                every if plan.used is None else plan.used))
    return rivals


def _plans(record: GraphRecord, judgement: Judgement, asked: SolveOptions) -> Iterator[_Plan]:
    """Yield what to solve for each doubt, where it has a rival."""
    graph = record.graph
    believing = replace(asked, start='seed', robust=False)
    for number, doubt in enumerate(judgement.doubts):
        rows = doubted_rows(doubt, graph.between)
        loops = counted(len(rows), 'loop')
        if doubt.kind == UNCONFIRMED and len(rows):
            yield _Plan(f'{loops} struck out', number, _told(graph, rows, False), asked)
        elif doubt.kind == OTHER_MAP and len(rows):
            yield _Plan(f'{loops} vouched for', number, _told(graph, rows, True), asked)
        elif doubt.kind == WEAK and len(rows) <= graph.n_poses:
            # Of many more a graph fills in, and nobody would take them all for true.
            yield _Plan('every loop believed', number, judgement.corrected(graph), believing)
        elif doubt.kind == SLIP:
            yield from _of_step(record, judgement, doubt, number, believing)
        elif doubt.kind == DRIFTS:
            drift = judgement.drift - float(doubt.detail)
            yield _Plan(f'each metre turned by {drift:+.2g} rad', number,
                        straightened(graph, drift), asked)
        elif doubt.kind == NORM:
            yield _Plan('least squares', number, graph, replace(asked, norm='l2', loop_norm=SAME))


def _told(graph: FactorGraph, rows: Indices, trusted: bool) -> FactorGraph:
    told = graph.copy()
    told.say(rows, trusted)
    return told


def _of_step(record: GraphRecord, judgement: Judgement, doubt: Doubt, number: int,
             believing: SolveOptions) -> Iterator[_Plan]:
    """Yield the map of the accepted factors without a step, or with it if it was left out."""
    factors = record.graph.between
    believed = judgement.accepted.copy()
    ends = np.sort(factors.pairs, axis=1) == (doubt.first, doubt.last)
    rows = np.flatnonzero(factors.is_odometry & ends.all(axis=1))
    if len(rows):
        believed[rows] = not believed[rows[0]]
        step = f'{record.ids[doubt.first]} - {record.ids[doubt.last]}'
        word = 'with' if believed[rows[0]] else 'without'
        yield _Plan(f'{word} the step {step}', number,
                    judgement.corrected(record.graph).subset(
                        believed, judgement.noise[believed]), believing, believed)
