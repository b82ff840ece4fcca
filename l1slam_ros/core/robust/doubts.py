# SPDX-License-Identifier: Apache-2.0
"""
Why a map is not to be relied on.

In: the end of a robust solve. Out: the reasons, each with the keyframes where a person may look.
What a person can do: vouch for a loop, strike one out, or state the noise as it is.
"""

from collections.abc import Iterator

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.robust.judgement import (
    MOSTLY_REFUSED,
    ONE_PLACE,
    OTHER_MAP,
    SLIP,
    Doubt,
)
from l1slam_ros.core.robust.pairwise_consistency import strongest_group
from l1slam_ros.core.robust.rounds import Growth
from l1slam_ros.core.robust.slips import SPANNING, jumping, refused, weakest_steps

# Of fewer loops most may well be refused, and be of one place.
_HANDFUL = 5
# Refused loops that agree count if their places are so many for each accepted one across.
_AGAINST = 0.25


def doubts(growth: Growth) -> tuple[Doubt, ...]:
    """Return the reasons to doubt a map in which nothing more can be accepted; none: ()."""
    loops = growth.is_loop[: growth.size]
    left_out = np.flatnonzero(loops & ~growth.accepted[: growth.size])
    accepted = np.flatnonzero(loops & growth.accepted[: growth.size])
    reasons = []
    if len(left_out) + len(accepted) >= _HANDFUL and len(left_out) > len(accepted):
        reasons.append(_doubt(growth, MOSTLY_REFUSED, left_out))
    if len(accepted) >= _HANDFUL and len(np.unique(growth.place[accepted])) == 1 and not (
            growth.trusted[accepted].any()):
        reasons.append(_doubt(growth, ONE_PLACE, accepted))
    reasons += _other_map(growth)
    reasons += [_doubt(growth, SLIP, rows) for rows in (*growth.suspected, *_ambiguous(growth))]
    return tuple(reasons)


def _other_map(growth: Growth) -> list[Doubt]:
    """Return a doubt where refused loops of several places agree: they may be right."""
    group = strongest_group(growth, refused(growth))
    if len(group.places) < SPANNING:
        return []
    steps = growth.low[weakest_steps(growth, group)]
    across = (growth.is_loop & growth.accepted & (growth.low <= steps.min(initial=0))
              & (growth.high > steps.max(initial=0)))
    # What is trusted is right, whatever else speaks against it.
    places = len(np.unique(growth.place[across]))
    if (growth.trusted & across).any() or len(group.places) < _AGAINST * places:
        return []
    return [_doubt(growth, OTHER_MAP, group.rows)]


def _ambiguous(growth: Growth) -> Iterator[Indices]:
    """Yield the loops across each slip that has a rival: a jump, and no loop ends in between."""
    loops = np.flatnonzero(growth.is_loop & growth.accepted)
    ends = np.unique((growth.low[loops], growth.high[loops]))
    jumps = growth.low[jumping(growth)]
    for slip in growth.low[np.flatnonzero(growth.cut[: growth.size])]:
        place = np.searchsorted(ends, slip, side='right')
        if (np.searchsorted(ends, jumps, side='right') == place).any():
            yield loops[(growth.low[loops] <= slip) & (growth.high[loops] > slip)]


def _doubt(growth: Growth, kind: str, rows: Indices) -> Doubt:
    low, high = np.maximum(growth.low[rows], 0), growth.high[rows]
    return Doubt(kind, len(rows), int(low.min()), int(high.max()))
