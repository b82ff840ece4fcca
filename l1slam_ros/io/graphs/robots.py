# SPDX-License-Identifier: Apache-2.0
"""Which robot a vertex is of, by its id, as the symbols of GTSAM have it."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices

# A symbol has a character in its highest byte, and an index below.
_INDEX_BITS = 56


def robots_of(ids: Indices) -> Indices:
    """Return the character code of the robot of each vertex id, (n,); 0: the id has no letter."""
    codes = ids >> _INDEX_BITS
    letters = ((codes >= ord('A')) & (codes <= ord('Z'))) | (
        (codes >= ord('a')) & (codes <= ord('z')))
    return np.where(letters, codes, 0)


def robot_names(ids: Indices) -> list[str]:
    """Return the letters of the robots of some vertex ids, in order; numbers have no name."""
    return [chr(code) for code in np.unique(robots_of(ids)).tolist() if code]
