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
