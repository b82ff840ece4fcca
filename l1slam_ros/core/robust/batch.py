# SPDX-License-Identifier: Apache-2.0
"""
Maps that survive lies: which loops to accept, by growing outward from the odometry.

In: a graph, of which nothing is accepted but the odometry and the trusted loops. Out: the loops
that are accepted, and the L2 map of these.
"""

from collections.abc import Callable, Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.robust.doubts import doubts
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.core.robust.rounds import Growth
from l1slam_ros.core.robust.slips import join, without_slip

# Every round accepts a loop, hence there is an end; this one is for the patience of people.
_MOST_ROUNDS = 200

# From the round and the loops accepted so far.
Report = Callable[[int, int], None]


def robust_solve(
    graph: FactorGraph, report: Report = lambda round_, accepted: None,
    check: Callable[[], None] = lambda: None,
) -> tuple[Judgement, Array]:
    """
    Return which loops to accept, from the graph alone, and the L2 map (n, p) of these.

    Parameters
    ----------
    report : called with the round and the loops accepted so far
    check : called before long steps, raises where the work shall stop

    """
    first = growth = Growth(graph, check)
    first.begin()
    for number, growth in enumerate(rounds(first, without_slip), 1):
        report(number, int(np.count_nonzero(growth.accepted & growth.is_loop)))
    return judgement_of(growth, doubts(growth)), growth.poses


def rounds(growth: Growth, repaired: Callable[[Growth], Growth | None]) -> Iterator[Growth]:
    """
    Yield the state after each round, until there is nothing more to accept.

    repaired : asked for another state where nothing more can be accepted; None: there is none.
    """
    for _ in range(_MOST_ROUNDS):
        news = growth.believable(growth.undecided())
        growth.accepted[news] = True
        if len(news):
            growth.solve()
        elif not join(growth):
            if growth.takes_at_their_word:
                break
            other = repaired(growth)
            if other is None:
                growth.take_at_their_word()
                growth.solve()
            else:
                growth = other
        yield growth


def judgement_of(growth: Growth, doubts: tuple = (), settled: bool = True) -> Judgement:
    """Return what a state says of the factors that were given."""
    square, suspect = fits(growth)
    size, accepted = growth.size, growth.accepted & ~growth.cut
    return Judgement(accepted[:size], suspect[:size], np.sqrt(square[:size]), growth.variance,
                     np.flatnonzero(growth.cut[:size]), doubts, settled)


def fits(growth: Growth) -> tuple[Array, Mask]:
    """
    Return how well each factor fits: a square (m,) of sigmas, and the loops that are suspect.

    The square is that of the residual, and of what is not accepted, of the innovation. Suspect,
    (m,) bool, is a loop that fits and yet was not accepted.
    """
    accepted, square = growth.accepted & ~growth.cut, np.zeros(len(growth.factors))
    square[growth.accepted] = (growth.posterior.residual**2).sum(axis=1)
    outside = np.flatnonzero(~accepted)
    cut, growth.cut = growth.cut, np.zeros_like(growth.cut)
    square[outside] = growth.innovations(outside).square
    growth.cut = cut
    return square, ~accepted & (square < growth.gate(growth.factors.freedom)) & growth.is_loop
