# SPDX-License-Identifier: Apache-2.0
"""
What lies beside a graph because no graph format has a place for it.

    <path>.stamps.txt   `id seconds`, one line for each vertex
    <path>.truth.txt    `id x y theta`, true poses; see `trajectory`
    <path>.false.txt    `i j`, the vertex ids of each edge known to be a false loop
"""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.manifold import Indices
from l1slam_ros.io.files import (
    parse_rows,
    quoted,
    read_lines,
    stamp_from_text,
    stamp_text,
    write_lines,
)


def stamps_path(path: str | os.PathLike[str]) -> Path:
    """Return the name of the file with the stamps of a graph."""
    return _beside(path, 'stamps')


def truth_path(path: str | os.PathLike[str]) -> Path:
    """Return the name of the file with the true poses of a graph or a bag."""
    return _beside(path, 'truth')


def false_loops_path(path: str | os.PathLike[str]) -> Path:
    """Return the name of the file with the false loops of a graph or a bag."""
    return _beside(path, 'false')


def write_stamps(path: Path, ids: Indices, stamps: Indices) -> None:
    """
    Write the stamp [ns] of each vertex: ids, stamps (n,).

    Raises
    ------
    FileError : the file cannot be written.

    """
    write_lines(path, (f'{k} {stamp_text(stamp)}' for k, stamp
                       in zip(ids.tolist(), stamps.tolist(), strict=True)))


def read_stamps(path: Path, ids: Indices) -> Indices | None:
    """
    Return the stamps [ns] of the vertices `ids` (n,), or None where there is no such file.

    Raises
    ------
    FileError : the file is damaged, or is not about these vertices.

    """
    if not path.exists():
        return None
    lines = read_lines(path)
    stamp_of = {}
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        try:
            name, stamp = text.split()
            stamp_of[int(name)] = stamp_from_text(stamp)
        except ValueError as error:
            raise FileError(path, f'{quoted(text)}; expected a vertex id and seconds',
                            number) from error
    if len(lines.texts) != len(ids) or stamp_of.keys() != set(ids.tolist()):
        raise FileError(path, f'{len(lines.texts)} stamps that are not those of the {len(ids)} '
                        'vertices; expected one for each, or no such file')
    return np.array([stamp_of[k] for k in ids.tolist()], np.int64)


def false_loop_lines(pairs: Indices) -> Iterable[str]:
    """Return the lines of a file of false loops: pairs (k, 2) of vertex ids."""
    return (f'{i} {j}' for i, j in pairs.tolist())


def read_false_loops(path: Path) -> Indices:
    """
    Return the vertex ids i, j of each false loop, (k, 2); none where there is no such file.

    Raises
    ------
    FileError : naming the line, when the file is damaged.

    """
    if not path.exists():
        return np.zeros((0, 2), np.int64)
    return parse_rows(path, 'false loop', read_lines(path), ids=2, values=0)[0]


def _beside(path: str | os.PathLike[str], what: str) -> Path:
    return Path(f'{os.fspath(path)}.{what}.txt')
