# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The lines of a graph file as arrays; errors name the malformed line."""

import math
import os
from dataclasses import dataclass, fields, replace

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import LEAST_EIGENVALUE, Mask, distinct, nearest_definite
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.io.files import (
    TextLines,
    counted,
    quoted,
    read_lines,
)
from l1slam_ros.io.graphs.left_out import restored
from l1slam_ros.io.graphs.parsing import parse_rows, refuse_quaternions
from l1slam_ros.io.graphs.tags import OFFSET, TAGS, TAGS_LEFT_OUT
from l1slam_ros.io.remarks import Remarks

# Number of lines that one sentence names.
_NAMED = 3
_MATRICES = 'information matrices'


@dataclass(frozen=True)
class Rows:
    """
    Lines of some kinds, in the order of the file.

    lines : (m,) line numbers; ids : (m, 2) vertex ids, the same id twice for a line with one id;
    alone : (m,) bool, the lines with one id; pose : (m, p); information : (m, d, d) as in the
    file; units : (m, d) of the information, see `Tag.units`.
    """

    lines: Indices
    ids: Indices
    alone: Mask
    pose: Array
    information: Array
    units: Array

    def __len__(self) -> int:
        return len(self.lines)

    def chosen(self, rows: Indices | Mask) -> 'Rows':
        """Return some of the lines, in the order of `rows`."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        if np.array_equal(rows, np.arange(len(self))):
            return self  # as mostly: a copy of all takes longer than to find that out
        return Rows(*(getattr(self, column.name)[rows] for column in fields(self)))

    @property
    def scaled(self) -> Array:
        """The information in the units of the residual, (m, d, d)."""
        return self.units[:, :, None] * self.information * self.units[:, None, :]


@dataclass(frozen=True)
class GraphLines:
    """
    The lines of a graph file.

    groups : tag -> its lines, without the tag; all tags are known; left_out : line number -> why
    the map does not use the factor on this line, and the factor's place; remarks : the state of a
    saved map; comments : numbers and texts.
    """

    groups: dict[str, TextLines]
    left_out: dict[int, tuple[str, int]]
    remarks: Remarks
    comments: tuple[tuple[int, str], ...]


def lines_by_tag(path: str | os.PathLike[str]) -> GraphLines:
    """Read a graph file; return its lines by their tags."""
    lines, left_out = restored(read_lines(path))
    groups: dict[str, TextLines] = {}
    texts, begin = lines.texts, 0
    while begin < len(texts):
        tag, *behind = texts[begin].split(None, 1)
        group = groups.setdefault(tag, TextLines([], []))
        end = begin + _alike(texts, begin, f'{tag} ')
        if end > begin:
            group.texts.extend(text[len(tag) + 1:].lstrip() for text in texts[begin:end])
        else:  # other whitespace beside the tag
            end = begin + 1
            group.texts.append(''.join(behind))
        group.numbers.extend(lines.numbers[begin:end])
        begin = end
    if not groups:
        raise FileError(path, f'the file is empty; expected {expected_tags("between")} lines')
    known = TAGS.keys() | TAGS_LEFT_OUT.keys() | {'FIX'}
    for tag, group in groups.items():
        if tag not in known and not tag.startswith('PARAMS_'):
            usual = [name for name in TAGS if TAGS[name].kind in ('vertex', 'between')]
            raise FileError(path, f'unknown tag {quoted(tag)}; expected {", ".join(usual)}',
                            group.numbers[0])
    return GraphLines(groups, left_out, lines.remarks, lines.comments)


def _alike(texts: list[str], begin: int, start: str) -> int:
    """Return how many lines from `begin` on start alike, one after the other."""
    return next((k for k in range(len(texts) - begin) if not texts[begin + k].startswith(start)),
                len(texts) - begin)


def expected_tags(kind: str) -> str:
    """Return the tags of one kind in words."""
    *most, last = (name for name, tag in TAGS.items() if tag.kind == kind)
    return f'{", ".join(most)} or {last}'


def manifold_of(path: object, groups: dict[str, TextLines]) -> Manifold:
    """Return the manifold of the poses of a file; raise if there are two."""
    found = sorted((lines.numbers[0], name) for name, lines in groups.items() if name in TAGS)
    for line, name in found[1:]:
        if TAGS[name].manifold is not TAGS[found[0][1]].manifold:
            raise FileError(path, f'{name}: a line of {TAGS[name].manifold.NAME} beside '
                            f'{found[0][1]} at line {found[0][0]}; expected all poses in the '
                            'plane, or all in space', line)
    return TAGS[found[0][1]].manifold if found else se2


def rows_of(path: object, groups: dict[str, TextLines], manifold: Manifold, kinds: tuple[str, ...],
          rotation_information: str = QUATERNION) -> Rows:
    """Return the lines of some kinds (vertex, edge, ...), whichever tags they have."""
    offsets = _offsets(path, groups)
    parts = [_parse(path, name, groups.get(name, TextLines([], [])), rotation_information, offsets)
             for name, tag in TAGS.items() if tag.kind in kinds and tag.manifold is manifold]
    filled = [part for part in parts if len(part)] or parts[:1]
    both = filled[0] if len(filled) == 1 else Rows(
        *(np.concatenate([getattr(part, column.name) for part in filled])
          for column in fields(Rows)))
    return both.chosen(np.argsort(both.lines))


def _parse(path: object, name: str, lines: TextLines, rotation_information: str,
           offsets: Indices) -> Rows:
    tag = TAGS[name]
    p = tag.values
    d = tag.manifold.TANGENT_SIZE
    ids, values = parse_rows(path, name, lines, tag.ids, p + len(tag.information))
    m = len(ids)
    if tag.has_quaternion:
        refuse_quaternions(path, values[:, 3:p], lines.numbers)
    moved = np.isin(ids[:, tag.vertices:], offsets).any(axis=1)
    if tag.vertices == 1 and moved.any():
        k = int(np.argmax(moved))
        raise FileError(path, f'{name}: the pose is that of a sensor with the offset {OFFSET} '
                        f'{ids[k, 1]}; expected a pose of the robot', lines.numbers[k])
    pose = tag.manifold.identity(m)
    information = np.zeros((m, d, d))
    read = tag.read(values[:, :p])
    pose[:, :read.shape[1]] = read
    for k, (row, column) in enumerate(tag.information):
        information[:, row, column] = information[:, column, row] = values[:, p + k]
    return Rows(np.array(lines.numbers, np.int64),
                 np.repeat(ids[:, :tag.vertices], 2 // tag.vertices, axis=1),
                 np.full(m, tag.vertices == 1), pose, information,
                 np.broadcast_to(tag.units(rotation_information), (m, d)))


def _offsets(path: object, groups: dict[str, TextLines]) -> Indices:
    """Return the numbers of the offsets that are not the identity, (k,)."""
    ids, values = parse_rows(path, OFFSET, groups.get(OFFSET, TextLines([], [])), 1, 7)
    return ids[(values[:, :6] != 0).any(axis=1), 0]


def vertices_of(path: object, groups: dict[str, TextLines], manifold: Manifold) -> Rows:
    """Return the vertices in ascending order of their ids."""
    rows = rows_of(path, groups, manifold, ('vertex',))
    rows = rows.chosen(np.argsort(rows.ids[:, 0], kind='stable'))
    ids, lines = rows.ids, rows.lines
    again = np.flatnonzero(ids[1:, 0] == ids[:-1, 0]) + 1
    if len(again):
        k = again[np.argmin(lines[again])]
        raise FileError(path, f'vertex {ids[k, 0]} comes twice, first at line {lines[k - 1]}; '
                        'expected each once', int(lines[k]))
    return rows


def without_circles(edges: Rows) -> tuple[Rows, list[str]]:
    """Return the edges without those from a vertex to itself, and a sentence on these, if any."""
    circle = (edges.ids[:, 0] == edges.ids[:, 1]) & ~edges.alone
    if not circle.any():
        return edges, []
    lines = edges.lines[circle].tolist()
    names = [str(number) for number in lines[:_NAMED]] + ['...'] * (len(lines) > _NAMED)
    sentence = (f'{counted(len(lines), "edge")} from a vertex to itself not used: '
                f'{"line" if len(lines) == 1 else "lines"} {", ".join(names)}')
    return edges.chosen(~circle), [sentence]


def turning_too_far(edges: Rows, manifold: Manifold) -> list[str]:
    """Return a sentence if edges in the plane turn by more than a full turn, as in degrees."""
    turns = abs(edges.pose[:, 2]) if manifold is se2 else np.zeros(len(edges))
    count = int(np.count_nonzero(turns > 2 * math.pi))
    if not count:
        return []
    most = int(np.argmax(turns))
    return [f'{count:,} of {counted(len(edges), "edge")} turn{"s" * (count == 1)} by more than '
            f'2 pi, the most by {turns[most]:.4g} at line {edges.lines[most]:,}: all angles are '
            'read as radians; are these degrees?']


def made_definite(edges: Rows) -> tuple[Rows, list[str]]:
    """
    Return the edges with positive definite information, and a sentence if some had other.

    An indefinite matrix is replaced by `nearest_definite`, in the units of the residual; a matrix
    that cannot be made definite stays.
    """
    place, which = distinct(edges.scaled)
    nearest, least = nearest_definite(edges.scaled[place])
    least = least[which]
    changed = np.flatnonzero(np.isfinite(least))
    if not len(changed):
        return edges, []
    information = edges.information.copy()
    units = edges.units[changed]
    information[changed] = nearest[which[changed]] / (units[:, :, None] * units[:, None, :])
    worst = changed[np.argmin(least[changed])]
    sentence = (f'{len(changed):,} of {counted(len(edges), "information matrix", _MATRICES)} not '
                f'positive definite, the worst at line {edges.lines[worst]:,}: its smallest '
                f'eigenvalue is {least[worst]:.2g} times its largest; each is replaced by the '
                'nearest matrix whose eigenvalues are at least '
                f'{LEAST_EIGENVALUE:g} times its largest')
    return replace(edges, information=information), [sentence]
