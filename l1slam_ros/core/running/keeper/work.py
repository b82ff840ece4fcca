# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The work that runs behind updates, each piece from its snapshot to the adoption of its result.

In: the keeper of a map. Out: a better map, or a judgement, given back to the keeper. No lock is
held while it is computed.
"""

import time
from dataclasses import replace

import numpy as np

from l1slam_ros.core.bordered.front import Front, Look
from l1slam_ros.core.errors import Interrupted
from l1slam_ros.core.geometry.alignment import absolute_trajectory_error
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.robust.batch import doubts_of_norm, judge, robust_solve
from l1slam_ros.core.robust.inspection import OFF_SCALE
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.running.improve import Check, front_of, improve, one_round
from l1slam_ros.core.running.keeper.keeper import Keeper
from l1slam_ros.core.running.keeper.schedule import Moment, Work, is_late
from l1slam_ros.core.running.keeper.workers import until
from l1slam_ros.core.running.problem import Problem, as_numbered, as_one, by_robot
from l1slam_ros.core.running.snapshot import Snapshot

# [s] Time for which a map is improved, whatever the budget; and by what factor a round may take
# longer by the clock.
_LEAST_ROUND = 0.1
_PATIENCE = 4
# [s] While a robot drives, all loops are judged from the graph alone for no longer if others came.
_LONGEST = 10.0
# Factors that a new front takes before it looks whether to stop.
_AT_ONCE = 16


def carry_out(keeper: Keeper, piece: Work, moment: Moment, check: Check) -> None:
    """Do a piece of work that was due at `moment`; check : raises if it is to stop."""
    if piece in (Work.ROUND, Work.EXACT):
        make_map(keeper, piece is Work.EXACT, moment.budget, check)
    elif piece is Work.NORM:
        compare_norms(keeper, check)
    else:
        judge_all(keeper, piece is Work.JUDGE_ANEW, moment, check)


def make_map(keeper: Keeper, exact: bool, budget: float, check: Check) -> None:
    """Lower the cost of the map (exact : to the optimum), factor it, let its front catch up."""
    now = keeper.snapshot()
    solver = keeper.solver
    whole = now.problem()
    pending = now.state.pending
    looked = now.looked
    del now  # holds the factors of a front that may be replaced meanwhile
    problem = as_one(whole)
    if pending is None:
        # A map of fewer factors than are accepted by then would be out of date.
        check = until(lambda: keeper.state.pending is not None, check)
    if exact:
        check = until(lambda: is_late(keeper.state), check)
    else:
        solver = one_round(solver, problem.is_sparse)
    improvement = improve(problem, solver, _PATIENCE * max(budget, _LEAST_ROUND), check, exact)
    check()
    front = front_of(problem, improvement.poses, looked, check)
    looks = [] if front is None else _caught_up(
        keeper, front, whole, pending is not None, check)
    check()
    keeper.adopt(improvement.of_all(whole), front, pending, looks)


def _caught_up(keeper: Keeper, front: Front, whole: Problem, again: bool,
               check: Check) -> list[Look]:
    """
    Let a new front take what came while it was made; return what it says of that.

    What came during one pass is left to the next one, as long as that is less than it was: what is
    left at the end is left to an update, for which a caller waits. whole : the problem that the
    front's map solves; again : see `FactorTable.for_new_front`

    Raises
    ------
    Interrupted : another map has begun.

    """
    looks = list[Look]()
    left = np.inf
    while not front.closed:
        state, factors, _ = keeper.look()
        if state.began != whole.map:
            raise Interrupted
        what = state.table.for_new_front(factors, whole.judgement.accepted, again)
        before, left = left, len(what) - front.rows
        if not 0 < left < before:
            break
        while not front.closed and front.rows < len(what):
            check()
            looks += front.take(factors, what[front.rows:front.rows + _AT_ONCE])
    return looks


def judge_all(keeper: Keeper, anew: bool, moment: Moment, check: Check) -> None:
    """
    Judge all loops; anew : from the graph alone.

    That ends early when idle, where the graph grows, and while driving, where new loops wait for
    too long: after seconds of searching for a slip or a drift, it would be of old evidence.
    """
    now, grown = keeper.begin_judgement()
    late = time.monotonic() + _LONGEST

    def is_out_of_date() -> bool:
        if moment.idle:
            return keeper.revisions.grown != grown
        return time.monotonic() > late and keeper.look()[2].loops > len(now.loop_rows)

    whole = now.problem()
    turned, order = by_robot(whole)
    problem = as_one(turned)
    graph = problem.graph
    known = problem.judgement
    poses = problem.poses
    try:
        judgement, l2_poses = (
            robust_solve(graph, check=until(is_out_of_date, check), known=(known, poses)) if anew
            else judge(graph, poses, known, check))
    except Interrupted:
        if anew and not moment.idle:
            keeper.change(now.map, lambda state, _: state.given_up(time.monotonic()))
        raise
    check()
    judgement = judgement.of_all(turned.graph)
    if anew:
        judgement = judgement.with_parts(turned.graph)
    take_judgement(keeper, now, *as_numbered(order, judgement, l2_poses), anew, moment.stands)


def compare_norms(keeper: Keeper, check: Check) -> None:
    """Record a doubt if another norm gives a clearly different map."""
    now = keeper.snapshot()
    turned, order = by_robot(now.problem())
    problem = as_one(turned)
    found = doubts_of_norm(problem.graph, problem.judgement, problem.poses, check)
    doubts = replace(problem.judgement, doubts=found).renumbered(order).doubts
    keeper.change(now.map, lambda state, _: state.doubted(now.state, doubts))


def take_judgement(keeper: Keeper, of: Snapshot, judgement: Judgement, poses: Array,
                   anew: bool, stands: bool) -> None:
    """
    Hand in the judgement of a snapshot and its L2 map (n, p).

    anew : from the graph alone; stands : the robot does not drive, see `_may_only_harm`
    """
    held = not stands and _may_only_harm(of, judgement, poses)
    keeper.change(of.map, lambda state, factors: state.judged_by(
        judgement, poses, len(of.loop_rows), anew, held, factors, time.monotonic()))


def _may_only_harm(of: Snapshot, judgement: Judgement, poses: Array) -> bool:
    """
    Return whether a robot drives better by the map that there is than by another one, (n, p).

    That one takes the odometry for noisier than it says, and expects a larger error of itself than
    the two are apart. What comes soon tells more: of Bicocca's first loops a run of lies makes a
    map that is 8 m off, where odometry is .5 m off.
    """
    positions = of.graph.manifold.positions(poses)
    noisier = judgement.variance_meant[0] > OFF_SCALE
    return bool(noisier) and judgement.expected_error > absolute_trajectory_error(
        positions, of.graph.manifold.positions(of.poses))
