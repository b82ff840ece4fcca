# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a solver of a whole pose graph is to the measurements: ours and the peers alike."""

from collections.abc import Callable
from dataclasses import dataclass

from measuring import Answer
from solvers.cases import Case

from l1slam_ros.core.geometry.manifold import Array

# A whole solve ends when the cost fell by less than this part of itself: gtsam's own default.
SAME_TOLERANCE = 1e-5
MOST_ITERATIONS = 100


@dataclass(frozen=True)
class GraphSolver:
    """
    A solver by its name.

    prepare : case, poses (n, p) to start from -> a function that solves once and returns the poses
    with the time. A peer's graph is built by `prepare`, so it is not counted.
    """

    name: str
    prepare: Callable[[Case, Array], Callable[[], Answer]]
