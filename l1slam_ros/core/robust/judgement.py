# SPDX-License-Identifier: Apache-2.0
"""What is believed of the factors of a graph, by the batch solve and by a running back end."""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph

# Most loops are refused; all that are accepted are of one place; refused loops of several places
# agree on another map; an odometry factor may have slipped, and it was not believed.
MOSTLY_REFUSED, ONE_PLACE, OTHER_MAP, SLIP = (
    'mostly refused', 'one place', 'another map', 'a slip suspected')


@dataclass(frozen=True)
class Doubt:
    """
    One reason why a map is not to be relied on.

    kind : one of the above; loops : how many it is about; first, last : the keyframes between
    which they lie.
    """

    kind: str
    loops: int
    first: int
    last: int


@dataclass(frozen=True)
class Judgement:
    """
    What is believed of the first m between factors of a graph.

    accepted, suspect : (m,) bool, suspect is a loop that fits but could as well be chance, a loop
    that is neither is rejected; sigmas : (m,) how far off each factor is, in units of its noise,
    as stated or larger if it was found so: the length of the residual, and where it is not
    accepted, of that over the uncertainty of the map, NaN before a loop was looked at; variance :
    (2,) of odometry and of loops as it was found, in units of what they state; slips : (k,) the
    odometry factors that slipped, not accepted; doubts : reasons not to rely on the map; settled :
    no more is to be found out from the factors that are there.
    """

    accepted: Mask
    suspect: Mask
    sigmas: Array
    variance: Array
    slips: Indices
    doubts: tuple[Doubt, ...] = ()
    settled: bool = True

    @property
    def doubt(self) -> Doubt | None:
        """The first reason not to rely on the map; None where all is well."""
        return self.doubts[0] if self.doubts else None

    @staticmethod
    def nothing() -> 'Judgement':
        """Return the judgement before there are factors."""
        none = np.zeros(0, bool)
        return Judgement(none, none, np.zeros(0), np.ones(2), np.zeros(0, np.int64))

    def extended(self, graph: FactorGraph, robust: bool) -> 'Judgement':
        """
        Return the judgement of all factors that the graph has by now.

        Of the new ones, odometry and what is trusted is believed; a loop is suspect until it was
        looked at, or where no loop is to be doubted, believed too.
        """
        factors, known = graph.between, len(self.accepted)
        if known == len(factors):
            return self
        sure = (factors.is_odometry | factors.trusted)[known:]
        new_loops = not sure.all()
        accepted = np.concatenate((self.accepted, sure | (not robust)))
        if not robust:
            accepted = np.ones(len(accepted), bool)
        suspect = np.concatenate((self.suspect, ~sure)) & ~accepted
        sigmas = np.concatenate((self.sigmas, np.full(len(factors) - known, np.nan)))
        return replace(
            self, accepted=accepted, suspect=suspect, sigmas=sigmas,
            settled=not robust or (self.settled and not new_loops))
