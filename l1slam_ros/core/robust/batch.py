# SPDX-License-Identifier: Apache-2.0
"""
Maps that survive lies: which loops to believe, by growing outward from the odometry.

In: a graph, of which nothing is believed but the odometry and the trusted loops. Out: the loops
that are believed, and the L2 map of these. No loop is factored before it is believed, so none
bends what it is judged by. Each round

1. predicts every undecided loop with its covariance (`innovation`),
2. accepts those that hardly can be false (`gating`), the share of false ones being what the loops
   themselves say it is; where there is none, pairs of loops that vouch for each other: a group of
   loops that may be one mistake has one vote; where there is none either, asks whether an odometry
   factor lies (`slips`),
3. solves for all that is accepted, and drops the loops that all others speak against.

The noise of odometry and of loops is measured on the way: files are often off by a constant. In
the last rounds factors may be as noisy as they say, so that none is refused for being worse than
its like. What fits where it stands, but could as well be chance, stays suspect. Source: ours,
defended by `test_batch.py`.
"""

from collections.abc import Callable, Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust.gating import DOUBT
from l1slam_ros.core.robust.innovation import chi2_quantile
from l1slam_ros.core.robust.judgement import INCONSISTENT, MOSTLY_REFUSED, Doubt, Judgement
from l1slam_ros.core.robust.pairwise_consistency import accord, weakest_steps
from l1slam_ros.core.robust.rounds import REFUSED, Growth, solve
from l1slam_ros.core.robust.slips import VOTES, without_slip
from l1slam_ros.core.solvers.block_cholesky import cholesky_of

# Every round accepts a loop, hence there is an end; this one is for the patience of people.
_MOST_ROUNDS = 200
# Of fewer loops most may well be refused.
_HANDFUL = 5


# From the round and the loops accepted so far.
Report = Callable[[int, int], None]


def robust_solve(
    graph: FactorGraph, report: Report = lambda round_, accepted: None,
    check: Callable[[], None] = lambda: None,
) -> tuple[Judgement, Array]:
    """
    Return which loops to believe, from the graph alone, and the L2 map (n, p) of these.

    Parameters
    ----------
    report : called with the round and the loops accepted so far
    check : called before long steps, raises where the work shall stop

    Raises
    ------
    GraphError : the odometry has a gap.

    """
    first = growth = Growth(graph, check)
    first.begin()
    for number, growth in enumerate(rounds(first, without_slip), 1):
        report(number, int(np.count_nonzero(growth.accepted & growth.is_loop)))
    square, suspect = outlook(growth)
    return Judgement(growth.accepted, suspect, np.sqrt(square), growth.variance, growth.slips(),
                     _contradiction(growth)), growth.poses


def rounds(growth: Growth, repaired: Callable[[Growth], Growth | None]) -> Iterator[Growth]:
    """
    Yield the state after each round, until there is nothing more to believe.

    repaired : asked for another state where nothing more can be believed; None: there is none.
    """
    for _ in range(_MOST_ROUNDS):
        news = growth.believable(growth.undecided())
        growth.accepted[news] = True
        if not len(news):
            if growth.takes_at_their_word:
                break
            other = repaired(growth)
            if other is None:
                growth.take_at_their_word()
            else:
                growth = other
        growth.settle()
        yield growth


def _contradiction(growth: Growth) -> Doubt | None:
    """Return a doubt where refused loops of several places agree: they may be right."""
    camp, chance = accord(growth)
    if len(growth.heads(camp)) < VOTES or chance > DOUBT:
        return None
    steps = weakest_steps(growth, camp)
    first, last = int(steps[0]), int(steps[-1])
    # What is trusted is right, whatever else speaks against it.
    if (growth.trusted & (growth.low <= last) & (growth.high > first)).any():
        return None
    return Doubt(INCONSISTENT, len(camp), first, last + 1)


def mostly_refused(graph: FactorGraph, accepted: Mask) -> Doubt | None:
    """Return a doubt where more than half of a handful of loops or more are not accepted."""
    factors = graph.between
    is_loop = ~factors.is_odometry
    left_out = factors.pairs[is_loop & ~accepted]
    loops = np.count_nonzero(is_loop)
    if loops < _HANDFUL or 2 * len(left_out) <= loops:
        return None
    return Doubt(MOSTLY_REFUSED, len(left_out), int(left_out.min()), int(left_out.max()))


def outlook(growth: Growth) -> tuple[Array, Mask]:
    """
    Return how well each factor fits: a square (m,) of sigmas, and the loops that are suspect.

    The square is that of the residual, and of what is not accepted, of the innovation. Suspect,
    (m,) bool, is a loop that fits and yet was not accepted.
    """
    accepted, square = growth.accepted, np.zeros(len(growth.factors))
    square[accepted] = (growth.posterior.residual**2).sum(axis=1)
    # While nothing ties the map to the world, nothing is known of what names it.
    square[~accepted] = np.nan
    outside = np.flatnonzero(~accepted & growth.may_be_predicted)
    square[outside] = growth.innovations(outside).square
    far = square >= growth.gate(growth.factors.freedom)
    return square, ~accepted & ~far & growth.is_loop


def reconsidered(graph: FactorGraph, poses: Array, accepted: Mask) -> Mask:
    """
    Return which factors to keep at a finished map of the accepted ones, (m,) bool.

    All loops are tested alike, in the units that they state; where the accepted ones are noisier
    than that, in theirs. To be repeated, with the map of what it returns, until nothing changes.
    """
    factors, k = graph.between, graph.manifold.TANGENT_SIZE
    square = (whitened_residual(graph, poses).reshape(-1, k) ** 2).sum(axis=1)
    is_loop, freedom = ~factors.is_odometry, factors.freedom
    believed = accepted & is_loop & ~factors.is_absolute
    scale = max(1.0, float(square[believed].sum()) / max(float(freedom[believed].sum()), 1.0))
    fits = square < np.where(factors.is_absolute, 1.0, scale) * chi2_quantile(1 - REFUSED, freedom)
    return np.where(is_loop, fits | factors.trusted, accepted)


def minimise_accepted(graph: FactorGraph, poses: Array, accepted: Mask,
                      check: Callable[[], None] = lambda: None) -> Array:
    """Return the L2 map (n, p) of the accepted factors, in the units that they state."""
    part = graph.subset(accepted)
    return solve(part, poses, cholesky_of(part), lambda *_: check())
