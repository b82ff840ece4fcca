# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The files beside a graph file, for data that graph formats have no place for.

    <path>.stamps.txt    `id seconds`, one line for each vertex; or `seconds` alone, in their order
    <path>.trusted.txt   `i j`, the vertex ids of each loop that is never doubted
    <path>.struck.txt    `i j`, of each loop that a person struck out. Loops between vertices that
                         are in both files are judged: one of them is true, another false
    <path>.truth.txt     `id x y theta`, true poses; see `trajectory`
    <path>.false.txt     `i j`, the vertex ids of each edge known to be a false loop
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.io.files import (
    NANOSECONDS,
    formatted,
    put_lines,
    quoted,
    read_lines,
    replacing,
    reported,
    stamp_from_text,
)
from l1slam_ros.io.graphs.parsing import parse_rows
from l1slam_ros.io.ours import marked

# What may be beside an input; and of that, what is written, or else removed, beside a graph.
BESIDE = ('stamps', 'trusted', 'struck', 'truth', 'false')
WRITTEN_BESIDE = BESIDE[:3]


def beside(path: str | os.PathLike[str], what: str) -> Path:
    """Return the name of a file beside a graph or a bag; what : of `BESIDE`."""
    return Path(f'{os.fspath(path)}.{what}.txt')


def write_beside(path: str | os.PathLike[str], ids: Indices, stamps: Indices | None,
                 factors: BetweenFactors) -> None:
    """
    Write the stamps, and the trusted and struck-out loops, beside a graph.

    ids, stamps : (n,) vertex ids and stamps [ns]; factors : of the graph. A file without content
    is not written, and an old one is removed. Odometry is always trusted and not listed.

    Raises
    ------
    FileError : one of them cannot be written or removed.

    """
    stamp_lines = [] if stamps is None else formatted(
        '%d %d.%09d', np.column_stack((ids, *np.divmod(stamps, NANOSECONDS))))
    pairs = ids[factors.pairs]
    trusted = pair_lines(pairs[factors.trusted & ~factors.is_odometry])
    with (_replaced(beside(path, 'stamps'), stamp_lines),
          _replaced(beside(path, 'trusted'), trusted),
          _replaced(beside(path, 'struck'), pair_lines(pairs[factors.struck]))):
        pass  # all are on the disk before any takes its place


@contextmanager
def _replaced(path: Path, lines: list[str]) -> Iterator[None]:
    """Replace a file by these lines when the block succeeds; without lines remove it."""
    if lines:
        with replacing(path) as temporary:
            put_lines(temporary, marked(lines))
            yield
        return
    yield
    with reported(path, 'removed'):
        path.unlink(missing_ok=True)


def read_stamps(path: str | os.PathLike[str], ids: Indices) -> Indices | None:
    """
    Return the stamps [ns], (n,), of the vertices `ids` (n,); None without a file of stamps.

    Raises
    ------
    FileError : the file is malformed, or has other vertices.

    """
    side = beside(path, 'stamps')
    if not side.exists():
        return None
    lines = read_lines(side)
    in_order = bool(lines.texts) and len(lines.texts[0].split()) == 1
    stamp_of = {}
    for k, (number, text) in enumerate(zip(lines.numbers, lines.texts, strict=True)):
        try:
            name, stamp = (ids[k % len(ids)], text) if in_order else text.split()
            stamp_of[int(name)] = stamp_from_text(stamp.strip())
        except ValueError as error:
            raise FileError(side, f'{quoted(text)}; expected '
                            f'{"seconds" if in_order else "a vertex id and seconds"}',
                            number) from error
    if len(lines.texts) != len(ids) or stamp_of.keys() != set(ids.tolist()):
        raise FileError(side, f'{len(lines.texts)} stamps do not match the {len(ids)} vertices; '
                        'expected one for each, or no such file')
    return np.array([stamp_of[k] for k in ids.tolist()], np.int64)


def named_loops(path: str | os.PathLike[str], what: str, ids: Indices,
                factors: BetweenFactors) -> Mask:
    """
    Return which factors of a graph are loops that a file beside it names, (m,) bool.

    A line names all loops between its two vertices, in either direction. what : `trusted`,
    `struck` or `false`; ids : (n,) vertex ids of the keyframes.

    Raises
    ------
    FileError : naming the line, if the file is malformed, names vertices without an edge, or
        strikes out odometry.

    """
    named, numbers = read_pairs(path, what)
    if not len(named):
        return np.zeros(len(factors), bool)
    edges, chosen = _numbered(ids, factors, named)
    # Odometry cannot be struck out; to ignore such a line would be misleading.
    kind, known = ('loop', edges[~factors.is_odometry]) if what == 'struck' else ('edge', edges)
    unknown = ~np.isin(chosen, known)
    if unknown.any():
        k = int(np.argmax(unknown))
        raise FileError(beside(path, what), f'no {kind} between {named[k, 0]} and {named[k, 1]} '
                        f'in {path}; expected its {what} loops, or no such file', numbers[k])
    return np.asarray(np.isin(edges, chosen) & ~factors.is_odometry)


def loops_between(ids: Indices, factors: BetweenFactors, named: Indices) -> Mask:
    """Return which factors are loops between pairs of vertices `named` (k, 2), (m,) bool."""
    if not len(named):
        return np.zeros(len(factors), bool)
    edges, chosen = _numbered(ids, factors, named)
    return np.asarray(np.isin(edges, chosen) & ~factors.is_odometry)


def _numbered(ids: Indices, factors: BetweenFactors,
              named: Indices) -> tuple[Indices, Indices]:
    """Return a number for the vertices of each factor (m,), and of each pair of ids (k,)."""
    # Ids have up to 64 bits, so pairs of them are numbered.
    both = np.sort(np.concatenate((ids[factors.pairs], named)), axis=1)
    number = np.unique(both, axis=0, return_inverse=True)[1].ravel()  # NumPy 2.0: (m, 1)
    return number[:len(factors)], number[len(factors):]


def read_pairs(path: str | os.PathLike[str], what: str) -> tuple[Indices, list[int]]:
    """
    Return the vertex ids (k, 2) in a file beside a graph or a bag, and their line numbers.

    Both are empty if there is no such file.

    Raises
    ------
    FileError : naming the line, if the file is malformed.

    """
    side = beside(path, what)
    if not side.exists():
        return np.zeros((0, 2), np.int64), []
    lines = read_lines(side)
    return parse_rows(side, f'{what} loop', lines, ids=2, values=0)[0], lines.numbers


def pair_lines(pairs: Indices) -> list[str]:
    """Return the lines of a file of loops: pairs (k, 2) of vertex ids."""
    return [f'{i} {j}' for i, j in pairs.tolist()]
