# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Ids of the vertices of several graphs, made such that no two share one.

In: the ids of each graph. Out: the same where nothing collides. Else, graph by graph: symbols of
GTSAM get the next free letter, and other numbers are shifted by a multiple of a power of ten, so
that a person still reads the old one in the new one.
"""

import string
from collections.abc import Sequence

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.io.graphs.robots import robots_of

# A symbol has a character in its highest byte.
_INDEX_BITS = 56
_LETTERS = [ord(letter) for letter in string.ascii_lowercase + string.ascii_uppercase]
_DISTINCT = ('vertex ids cannot be made distinct; expected ids from 0 on, or symbols of GTSAM')


def numbered(graphs: Sequence[Indices]) -> list[Indices]:
    """
    Return the ids of each graph such that no two share one; the first keeps its own.

    Raises
    ------
    GraphError : there are more robots than letters, or ids too large to be shifted.

    """
    step = _step(graphs)
    taken = np.zeros(0, np.int64)
    found = list[Indices]()
    letters = {int(code) for ids in graphs for code in np.unique(robots_of(ids))}
    for number, ids in enumerate(graphs):
        new = ids.copy()
        if np.isin(ids, taken).any():
            robots = robots_of(ids)
            for code in np.unique(robots).tolist():
                of_robot = robots == code
                if not np.isin(ids[of_robot], taken).any():
                    continue
                if code:
                    free = _free(letters)
                    letters.add(free)
                    new[of_robot] += (free - code) << _INDEX_BITS
                elif (number * step + int(ids[of_robot].max())) >> _INDEX_BITS:
                    raise GraphError(_DISTINCT)
                else:
                    new[of_robot] += number * step
        if np.isin(new, taken).any() or (np.diff(np.sort(new)) == 0).any():
            raise GraphError(_DISTINCT)
        taken = np.concatenate((taken, new))
        found.append(new)
    return found


def _step(graphs: Sequence[Indices]) -> int:
    """Return the least power of ten beyond all ids that are no symbols."""
    largest = max((int(ids[robots_of(ids) == 0].max(initial=0)) for ids in graphs), default=0)
    return int(10 ** len(str(largest)))


def _free(letters: set[int]) -> int:
    for code in _LETTERS:
        if code not in letters:
            return code
    raise GraphError(f'more than {len(_LETTERS)} robots; expected one letter for each')
