# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Trajectories as text: writing TUM files, and reading reference poses to compare with.

TUM: `stamp x y z qx qy qz qw`, stamps in seconds, exact to the nanosecond.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.io.bounded import unpacked_name
from l1slam_ros.io.files import (
    TextLines,
    counted,
    quoted,
    read_lines,
    stamp_from_text,
    stamp_text,
    write_lines,
)
from l1slam_ros.io.graphs.graph_file import read_vertices
from l1slam_ros.io.graphs.parsing import parse_rows, refuse_quaternions
from l1slam_ros.io.jrl.layout import JRL_SUFFIXES
from l1slam_ros.io.ours import marked

_TUM_COLUMNS = 8
_NAN = {'nan', '-nan'}


@dataclass(frozen=True)
class Reference:
    """
    Poses to compare with.

    keys : (n,) ascending, vertex ids, or stamps [ns] when `stamped`; poses : (n, p); skipped :
    sentences on what was not used.
    """

    keys: Indices
    poses: Array
    stamped: bool
    skipped: tuple[str, ...] = ()


def write_tum(path: str | os.PathLike[str], stamps: Indices, poses: Array,
              manifold: Manifold) -> None:
    """
    Write a TUM file: stamps (n,) [ns], poses (n, p).

    Raises
    ------
    FileError : the file cannot be written.

    """
    rows = manifold.to_pose3(poses).tolist()
    write_lines(path, marked(f'{stamp_text(stamp)} {" ".join(map(repr, row))}'
                             for stamp, row in zip(stamps.tolist(), rows, strict=True)))


def truth_lines(ids: Indices, poses: Array) -> Iterator[str]:
    """Yield lines of true poses, `id x y theta` (the columns of the manifold): (n,), (n, p)."""
    for k, row in zip(ids.tolist(), poses.tolist(), strict=True):
        yield f'{k} {" ".join(map(repr, row))}'


def read_reference(path: str | os.PathLike[str], manifold: Manifold = se2,
                   by_stamps: bool = False) -> Reference:
    """
    Read reference poses: TUM, vertices of a graph, `id x y theta`, or CSV `stamp, x, y, theta`.

    From a JRL file, its groundtruth is read. The first line of other files shows their format:
    with commas it is a CSV file, whose first column is a stamp. A line of names may be above the
    numbers. Poses with a NaN are left out.

    by_stamps : use the stamps beside a graph file, if there are any, instead of its ids

    Raises
    ------
    FileError : naming the line, if the file has none of these formats.

    """
    if Path(unpacked_name(path)).suffix in JRL_SUFFIXES:
        from l1slam_ros.io.jrl.reading import read_truth

        return Reference(*read_truth(Path(path), manifold), stamped=False)
    lines = read_lines(path)
    if not lines.texts:
        raise FileError(path, 'the file is empty; expected reference poses')
    number = lines.numbers[0]
    is_csv = ',' in lines.texts[0]
    in_words = not _is_number(lines.texts[0])
    if in_words and not is_csv and not (len(lines.texts) > 1 and _is_number(lines.texts[1])):
        return _read_vertices(path, manifold, by_stamps)
    lines, skipped = _of_numbers(TextLines(
        lines.numbers[in_words:], [text.replace(',', ' ') if is_csv else text
                                   for text in lines.texts[in_words:]]))
    if skipped and not lines.texts:
        raise FileError(path, f'{skipped[0]}; expected reference poses')
    fields = lines.texts[0].split() if lines.texts else []
    is_tum = len(fields) == _TUM_COLUMNS
    size = 1 + manifold.POSE_SIZE
    if not is_tum and len(fields) != size:
        others = f' or {size} (stamp and pose)' if is_csv else (
            f', {size} (id and pose) or a graph file')
        raise FileError(path, f'{counted(len(fields), "column")}; expected {_TUM_COLUMNS} (TUM)'
                        f'{others}', number)
    # Poses in space have as many numbers as TUM's; a stamp has a point there, an id has none.
    stamped = is_csv or (is_tum and (len(fields) != size or not fields[0].isdecimal()))
    rows = _whole_stamps(path, lines) if stamped else lines
    keys, poses = parse_rows(path, 'TUM pose' if is_tum else 'pose', rows, 1, len(fields) - 1)
    if is_tum:
        refuse_quaternions(path, poses[:, 3:], lines.numbers)
        poses = manifold.from_pose3(poses)
    return _sorted(path, lines, Reference(keys[:, 0], poses, stamped, skipped))


def _is_number(line: str) -> bool:
    """Tell whether the first field of a line is a number."""
    try:
        float(line.replace(',', ' ').split()[0])
    except (ValueError, IndexError):
        return False
    return True


def _of_numbers(lines: TextLines) -> tuple[TextLines, tuple[str, ...]]:
    """Return the lines without those that have a NaN, and a sentence that counts these."""
    sound = [k for k, text in enumerate(lines.texts)
             if _NAN.isdisjoint(text.lower().split())]
    lost = len(lines.texts) - len(sound)
    if not lost:
        return lines, ()
    return (TextLines([lines.numbers[k] for k in sound], [lines.texts[k] for k in sound]),
            (f'{counted(lost, "true pose")} of {len(lines.texts):,} left out: NaN',))


def _read_vertices(path: str | os.PathLike[str], manifold: Manifold, by_stamps: bool) -> Reference:
    ids, poses, stamps = read_vertices(path, manifold)
    if stamps is None or not by_stamps:
        return Reference(ids, poses, stamped=False)
    first = np.unique(stamps, return_index=True)[1]
    return Reference(stamps[first], poses[first], stamped=True)


def _whole_stamps(path: object, lines: TextLines) -> TextLines:
    """Return the lines with their stamps in nanoseconds: floats would lose the last digits."""
    texts = []
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        stamp, *rest = text.split(None, 1)
        try:
            texts.append(' '.join([str(stamp_from_text(stamp)), *rest]))
        except ValueError as error:
            raise FileError(path, f'stamp {quoted(stamp)}; expected seconds', number) from error
    return TextLines(lines.numbers, texts)


def _sorted(path: object, lines: TextLines, found: Reference) -> Reference:
    """Return the reference in ascending order of its keys; each may stand once."""
    order = np.argsort(found.keys, kind='stable')
    again = np.flatnonzero(np.diff(found.keys[order]) == 0) + 1
    if len(again):
        line = min(lines.numbers[k] for k in order[again])
        raise FileError(path, 'the same id or stamp a second time; expected each once', line)
    return replace(found, keys=found.keys[order], poses=found.poses[order])
