# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The last map that a running back end has solved for."""

from dataclasses import dataclass, replace

import numpy as np

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.solvers.optimality import Status

# An update of a large map has time for one linearisation, and the test of convergence needs two.
# So the map is at rest when so many updates in a row lowered the cost by less than the tolerance.
_QUIET_UPDATES = 5


@dataclass(frozen=True)
class Optimised:
    """
    The last solution, for the keyframes and factors that existed when it began.

    poses : (k, p); dual : (rows,); cost, status : as the last map left them; quiet_updates : how
    many in a row hardly lowered the cost.
    """

    poses: Array
    dual: Array
    cost: float
    status: Status
    quiet_updates: int

    @staticmethod
    def nothing(poses: Array) -> 'Optimised':
        """Return the solution before the first update, with poses or without."""
        return Optimised(poses, np.zeros(0), 0.0, Status.OUT_OF_TIME, 0)

    @property
    def at_rest(self) -> bool:
        """Whether more updates of the same factors would hardly change the map."""
        return (self.status in (Status.CONVERGED, Status.STALLED)
                or self.quiet_updates >= _QUIET_UPDATES)

    def unfinished(self) -> 'Optimised':
        """Return the same solution, marked as not converged."""
        return replace(self, status=Status.OUT_OF_TIME)
