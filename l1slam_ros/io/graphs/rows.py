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
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import (
    LEAST_EIGENVALUE,
    LEAST_VARIANCE,
    Mask,
    distinct,
    nearest_definite,
)
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.io.bounded import open_regular
from l1slam_ros.io.files import (
    TextLines,
    counted,
    quoted,
    read_lines,
    reported,
)
from l1slam_ros.io.graphs.left_out import restored
from l1slam_ros.io.graphs.parsing import parse_rows, refuse_quaternions
from l1slam_ros.io.graphs.tags import (
    EQUIVALENT,
    OFFSET,
    OTHER_ORDER,
    SENSORS,
    TAGS,
    TAGS_LEFT_OUT,
    UNKNOWN,
    Tag,
)
from l1slam_ros.io.remarks import Remarks

# Number of lines that one sentence names.
_NAMED = 3
_MATRICES = 'information matrices'
# A tag of another program, and how many of them one sentence names.
_TAG = re.compile('[A-Za-z][A-Za-z0-9_:]*')
_TAGS_NAMED = 10
_BEGIN = 2**16  # [bytes]
# The begin of a line that may tie two vertices, as edges do.
_TWO_IDS = re.compile(r'(-?[0-9]{1,18})\s+(-?[0-9]{1,18})(?=\s|$)')


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

    groups : tag -> its lines, without the tag; no unknown tag is of an edge; left_out : line
    number -> why the map does not use the factor on this line, and the factor's place; remarks :
    the state of a saved map; comments : numbers and texts.
    """

    groups: dict[str, TextLines]
    left_out: dict[int, tuple[str, int]]
    remarks: Remarks
    comments: tuple[tuple[int, str], ...]


def begins_as_graph(path: Path) -> bool:
    """
    Tell whether one of the first lines of a file has a tag.

    Raises
    ------
    FileError : it cannot be read, or is no regular file.

    """
    with reported(path, 'read'), open_regular(path) as file:
        begin = file.read(_BEGIN)
    return any(line.split(None, 1)[:1] == [tag.encode()]
               for line in begin.splitlines() for tag in TAGS)


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
    is_graph = bool(groups.keys() & TAGS.keys())
    for tag, group in groups.items():
        if not (_is_known(tag) or (is_graph and _may_be_left_out(tag))):
            raise _unknown(path, tag, group.numbers[0])
    return GraphLines(groups, left_out, lines.remarks, lines.comments)


def _unknown(path: object, tag: str, line: int) -> FileError:
    usual = [name for name in TAGS if TAGS[name].kind in ('vertex', 'between')]
    return FileError(path, f'unknown tag {quoted(tag)}; expected {", ".join(usual)}', line)


def _is_known(tag: str) -> bool:
    return (tag in TAGS or tag in TAGS_LEFT_OUT or tag in ('FIX', EQUIVALENT)
            or tag.startswith('PARAMS_'))


def _may_be_left_out(tag: str) -> bool:
    """Tell whether an unknown tag ties no poses: it is no edge, and no misspelt known tag."""
    return bool(_TAG.fullmatch(tag)) and 'EDGE' not in tag.upper() and not _is_known(tag.upper())


def refuse_unknown_ties(path: object, groups: dict[str, TextLines], ids: Indices) -> None:
    """Raise for a line of an unknown tag that begins with two of the vertices `ids`, (n,)."""
    for tag, group in groups.items():
        if _is_known(tag) or tag.startswith('VERTEX'):
            continue
        ends = [(number, found) for number, text in zip(group.numbers, group.texts, strict=True)
                if (found := _TWO_IDS.match(text))]
        both = np.array([found.groups() for _, found in ends], np.int64).reshape(-1, 2)
        tied = np.isin(both, ids).all(axis=1) & (both[:, 0] != both[:, 1])
        if tied.any():
            raise _unknown(path, tag, ends[int(np.argmax(tied))][0])


def not_used(groups: dict[str, TextLines]) -> list[str]:
    """Return a sentence that counts the lines that are not used by their tags, if any."""
    of_reason: dict[str, list[str]] = {}
    count = 0
    for tag, group in groups.items():
        if tag in TAGS or tag in ('FIX', OFFSET, EQUIVALENT):
            continue
        count += len(group.texts)
        reason = SENSORS if tag.startswith('PARAMS_') else TAGS_LEFT_OUT.get(tag, UNKNOWN)
        of_reason.setdefault(reason, []).append(f'{len(group.texts):,} {quoted(tag)}')
    parts = [f'{", ".join(tags[:_TAGS_NAMED])}{", ..." * (len(tags) > _TAGS_NAMED)} ({reason})'
             for reason, tags in of_reason.items()]
    return [f'{counted(count, "line")} not used: {"; ".join(parts)}'] if parts else []


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
          rotation_information: str = QUATERNION, information: float | None = None) -> Rows:
    """
    Return the lines of some kinds (vertex, edge, ...), whichever tags they have.

    information : the entries on the diagonal of the information where a line has none

    Raises
    ------
    FileError : naming the first malformed line.

    """
    offsets = _offsets(path, groups)
    parts = [_parse(path, name, groups.get(name, TextLines([], [])), rotation_information, offsets,
                    information)
             for name, tag in TAGS.items() if tag.kind in kinds and tag.manifold is manifold]
    filled = [part for part in parts if len(part)] or parts[:1]
    both = filled[0] if len(filled) == 1 else Rows(
        *(np.concatenate([getattr(part, column.name) for part in filled])
          for column in fields(Rows)))
    return both.chosen(np.argsort(both.lines))


def _parse(path: object, name: str, lines: TextLines, rotation_information: str,
           offsets: Indices, stated: float | None) -> Rows:
    tag = TAGS[name]
    p = tag.values
    d = tag.manifold.TANGENT_SIZE
    size = p + len(tag.information)
    try:
        ids, values = parse_rows(path, name, lines, tag.ids, size)
    except FileError:
        lines = _with_information(path, name, tag, lines, stated)
        ids, values = parse_rows(path, name, lines, tag.ids, size)
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


def _with_information(path: object, name: str, tag: Tag, lines: TextLines,
                      stated: float | None) -> TextLines:
    """Return the lines with a multiple of the identity as information where they have none."""
    short = tag.ids + tag.values
    texts = [text.split('#', 1)[0] for text in lines.texts]
    without = [k for k, text in enumerate(texts) if len(text.split()) == short]
    if not without or not tag.information:
        return lines
    if stated is None:
        raise FileError(path, f'{name}: {counted(short, "field")}, the information is missing; '
                        f'expected {tag.ids} whole and {tag.values + len(tag.information)} finite '
                        'numbers, or the option `--information X`', lines.numbers[without[0]])
    end = ' '.join(repr(stated) if row == column else '0' for row, column in tag.information)
    for k in without:
        texts[k] = f'{texts[k]} {end}'
    return replace(lines, texts=texts)


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


def with_equivalents(path: object, groups: dict[str, TextLines],
                     edges: Rows) -> tuple[Rows, Indices, list[str]]:
    """
    Return the edges with one of the zero pose between equivalent vertices that have none.

    And the ids (k, 2) of the equivalent vertices, and a sentence if there are any.
    """
    lines = groups.get(EQUIVALENT, TextLines([], []))
    pairs = parse_rows(path, EQUIVALENT, lines, ids=2, values=0)[0]
    if not len(pairs):
        return edges, pairs, []
    joined = {tuple(pair) for pair in np.sort(edges.ids, axis=1).tolist()}
    alone = np.zeros(len(pairs), bool)
    for k, pair in enumerate(map(tuple, np.sort(pairs, axis=1).tolist())):
        alone[k] = pair not in joined and pair[0] != pair[1]
        joined.add(pair)
    count = int(alone.sum())
    said = [f'{counted(len(pairs), f"{EQUIVALENT} line")}: the loops between these vertices are '
            'vouched for']
    if not count:
        return edges, pairs, said
    said[0] += f'; {counted(count, "pair")} without an edge tied to each other'
    d = edges.units.shape[1]
    pose = np.zeros((count, edges.pose.shape[1]))
    pose[:, d:] = 1.0  # of a quaternion
    ties = Rows(np.array(lines.numbers, np.int64)[alone], pairs[alone], np.zeros(count, bool),
                pose, np.tile(np.eye(d) / LEAST_VARIANCE, (count, 1, 1)), np.ones((count, d)))
    both = Rows(*(np.concatenate([getattr(edges, column.name), getattr(ties, column.name)])
                  for column in fields(Rows)))
    return both.chosen(np.argsort(both.lines, kind='stable')), pairs, said


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


def in_order_of_file(edges: Rows, groups: dict[str, TextLines]) -> tuple[Rows, list[str]]:
    """
    Return the edges with their information in the order of the file, and a sentence if it differs.

    Some programs write g2o's order under TORO's tags. The order is one of the whole file: the
    other one is taken where most matrices are indefinite in that of the tags, and definite in it.
    """
    orders = {name: TAGS[name].information for name in groups
              if name in TAGS and TAGS[name].information in OTHER_ORDER}
    indefinite = _count_indefinite(edges) if orders else 0
    if 2 * indefinite <= len(edges):
        return edges, []
    information = edges.information.copy()
    for name, order in orders.items():
        rows = np.flatnonzero(np.isin(edges.lines, groups[name].numbers))
        for (row, column), (was_row, was_column) in zip(OTHER_ORDER[order], order, strict=True):
            information[rows, row, column] = information[rows, column, row] = (
                edges.information[rows, was_row, was_column])
    other = replace(edges, information=information)
    if 2 * _count_indefinite(other) > len(edges):
        return edges, []
    whose = 'g2o' if 'EDGE2' in orders else 'TORO'
    return other, [f'{indefinite:,} of {counted(len(edges), "information matrix", _MATRICES)} not '
                   f'positive definite in the order of the tags: all are read in that of {whose}']


def _count_indefinite(edges: Rows) -> int:
    place, which = distinct(edges.scaled)
    return int(np.isfinite(nearest_definite(edges.scaled[place])[1])[which].sum())


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
