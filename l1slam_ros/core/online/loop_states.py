# SPDX-License-Identifier: Apache-2.0
"""What has become of each loop closure."""

from dataclasses import dataclass

from l1slam_ros.core.geometry.manifold import Array, Indices

# What can become of a loop; `LoopStates.state` counts in this order.
LOOP_STATES = ('waiting', 'suspect', 'accepted', 'rejected', 'expired')
WAITING, SUSPECT, ACCEPTED, REJECTED, EXPIRED = range(len(LOOP_STATES))


@dataclass(frozen=True)
class LoopStates:
    """
    What has become of the loops.

    rows : (k,) the between factors of the first k of them; stamps : (l, 2) [ns] reference and end;
    state : (l,) of `LOOP_STATES`; sigmas : (l,), NaN where a loop was not looked at.
    """

    rows: Indices
    stamps: Indices
    state: Indices
    sigmas: Array
