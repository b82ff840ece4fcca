# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Factors that a map does not use: comments in its file, which this program reads as factors again.

    # rejected EDGE_SE2 ...   a loop or an absolute pose that was rejected
    # suspect EDGE_SE2 ...    a loop that nothing confirmed
    # slip EDGE_SE2 ...       odometry that was left out
    # struck EDGE_SE2 ...     a loop that a person struck out
    # measured EDGE_SE2 ...   the measured odometry, if the map uses corrected odometry

So another program that optimises the graph in the file gets the same map. These comments are
behind all edges, each with its number among the factors, because GTSAM reads no edge behind a
comment. In files of other programs all comments are ordinary comments.
"""

import re

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.robust.judgement import Judgement
from l1slam_ros.io.files import TextLines
from l1slam_ros.io.ours import MARK
from l1slam_ros.io.remarks import KEYWORD

REJECTED = 'rejected'
SUSPECT = 'suspect'
SLIP = 'slip'
STRUCK = 'struck'
MEASURED = 'measured'
_COMMENT = re.compile(f'# ({REJECTED}|{SUSPECT}|{SLIP}|{STRUCK}|{MEASURED}) '
                      '([A-Z].*?) # factor ([0-9]{1,9})')


def nothing_left_out(count: int) -> np.ndarray:
    """Return an empty word for each of `count` factors: all are used."""
    return np.full(count, '', object)


def left_out_by(judgement: Judgement | None, factors: BetweenFactors) -> np.ndarray:
    """Return for each factor why the map does not use it, (m,): a word from above, or empty."""
    words = nothing_left_out(len(factors))
    if judgement is not None:
        judged = words[:len(judgement.accepted)]  # a view: later factors are not judged yet
        judged[~judgement.accepted] = REJECTED
        judged[judgement.suspect] = SUSPECT
        judged[judgement.slips] = SLIP
    words[factors.struck] = STRUCK
    return words


def left_out_of(inliers: Mask, factors: BetweenFactors) -> np.ndarray:
    """Return these words, (m,), if only the accepted factors are known, (m,) bool."""
    words = np.where(inliers, '', np.where(factors.is_odometry, SLIP, REJECTED)).astype(object)
    words[factors.struck] = STRUCK
    return words


def commented(lines: list[str], words: np.ndarray) -> list[str]:
    """Return the lines of factors that were left out as comments."""
    return [f'# {words[k]} {lines[k]} # factor {k}' for k in np.flatnonzero(words != '').tolist()]


def restored(lines: TextLines) -> tuple[TextLines, dict[int, tuple[str, int]]]:
    """
    Return the lines of a file with the left-out ones as factors again, and their words and places.

    Those by the numbers of their lines; a place is the number among the factors.

    What remains of the comments is what others wrote.
    """
    is_ours = lines.remarks is not None or bool(lines.comments and lines.comments[-1][1] == MARK)
    if not is_ours:
        return lines, {}
    words = {}
    again = []
    comments = []
    for number, text in lines.comments:
        if found := _COMMENT.fullmatch(text):
            words[number] = found[1], int(found[3])
            again.append((number, found[2]))
        elif text != MARK and not text.startswith(KEYWORD):
            comments.append((number, text))
    numbers = lines.numbers
    texts = lines.texts
    if again:
        rows = sorted([*zip(numbers, texts, strict=True), *again], key=lambda row: row[0])
        numbers, texts = [number for number, _ in rows], [text for _, text in rows]
    return TextLines(numbers, texts, lines.remarks, tuple(comments)), words


def in_place(numbers: Indices, words: dict[int, tuple[str, int]]
             ) -> tuple[Indices, np.ndarray, Indices]:
    """
    Return the order (m,) of the factors before some were left out, and their words in that order.

    And the order (m,) of their measurements: of what was corrected, as it was measured.
    """
    if not words:
        all_of_them = np.arange(len(numbers))
        return all_of_them, nothing_left_out(len(numbers)), all_of_them
    found = [words.get(number, ('', -1)) for number in numbers.tolist()]
    said = np.array([word for word, _ in found], object)
    places = np.array([place for _, place in found], np.int64)
    measured = np.flatnonzero(said == MEASURED)
    rest = np.flatnonzero(said != MEASURED)
    order, said = _in_order(said[rest], places[rest])
    order = rest[order]
    as_measured = order.copy()
    there = places[measured] < len(order)
    as_measured[places[measured[there]]] = measured[there]
    return order, said, as_measured


def _in_order(said: np.ndarray, places: Indices) -> tuple[Indices, np.ndarray]:
    """Return the order of factors with these words, at these places or -1, and the words."""
    out = np.flatnonzero(places >= 0)
    order = np.arange(len(said))
    # A person may have taken lines away: then they stay where they are.
    if len(np.unique(places[out])) == len(out) and places.max(initial=-1) < len(said):
        others = np.delete(order, places[out])
        order[places[out]], order[others] = out, np.flatnonzero(places < 0)
    return order, said[order]
