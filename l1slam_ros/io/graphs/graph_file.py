# SPDX-License-Identifier: Apache-2.0
"""
Pose graphs as text: g2o (`.g2o`) and TORO (`.graph`), read and written by one table, `tags`.

Stamps and trust in loops, which neither format knows, live beside the graph: see `side_files`.
"""

import os
from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, NoiseError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask, square_root_information
from l1slam_ros.core.graph.factor_graph import BetweenFactors, FactorGraph
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.io.files import (
    LARGEST,
    TextLines,
    first_failure,
    formatted,
    parse_rows,
    put_lines,
    quoted,
    read_lines,
    refuse_quaternions,
    replacing,
    settled,
)
from l1slam_ros.io.graphs.side_files import read_stamps, read_trusted, write_beside
from l1slam_ros.io.graphs.tags import FORMAT_OF_SUFFIX, TAGS
from l1slam_ros.io.graphs.tags_left_out import SENSORS, TAGS_LEFT_OUT
from l1slam_ros.io.wording import counted


@dataclass(frozen=True)
class GraphRecord:
    """
    A graph and what its file says besides.

    graph : the factors, in the order of the file; poses : (n, p) the stored start, None when
    the file has none; ids : (n,) vertex ids, ascending: keyframe k is vertex ids[k];
    stamps : (n,) [ns] or None; skipped : a sentence on each kind of line that was not used;
    damage : a sentence where only a part of the input could be read, else empty;
    rotation_information : what the rotation block in a g2o file of it is of, of `names`.
    """

    graph: FactorGraph
    poses: Array | None
    ids: Indices
    stamps: Indices | None = None
    skipped: tuple[str, ...] = ()
    damage: str = ''
    rotation_information: str = QUATERNION


# So many lines are named in one sentence.
_NAMED = 3


@dataclass(frozen=True)
class _Rows:
    """
    The lines of one kind, in the order of the file.

    lines : (m,) line numbers; ids : (m, 1 or 2); pose : (m, p); information : (m, d, d) as in the
    file; units : (m, d) of it, see `Tag.units`.
    """

    lines: Indices
    ids: Indices
    pose: Array
    information: Array
    units: Array

    def __len__(self) -> int:
        return len(self.lines)

    def subset(self, chosen: Indices | Mask) -> '_Rows':
        return _Rows(self.lines[chosen], self.ids[chosen], self.pose[chosen],
                     self.information[chosen], self.units[chosen])

    @property
    def scaled(self) -> Array:
        """The information in the units of the residual, (m, d, d)."""
        return self.units[:, :, None] * self.information * self.units[:, None, :]


def read_graph_file(path: str | os.PathLike[str],
                    rotation_information: str = QUATERNION) -> GraphRecord:
    """
    Read a g2o or TORO file, and beside it the stamps and which loops are trusted.

    Vertices may stand anywhere and in any order, or not at all: then they are those the edges
    name, and `poses` is None. Whether the graph is connected is not looked at.

    Raises
    ------
    FileError : naming the line, when the file is no such graph or those beside it are of another.

    """
    groups = _group(path)
    manifold = _manifold(path, groups)
    edges, priors = (_rows(path, groups, kind, manifold, rotation_information)
                     for kind in ('between', 'prior'))
    edges, skipped = _without_circles(edges)
    if not len(edges):
        raise FileError(path, f'no edges; expected {_expected("between")} lines')
    vertices = _vertices(path, groups, manifold)
    ids = vertices.ids[:, 0] if len(vertices) else np.unique(edges.ids)
    graph = FactorGraph(manifold)
    graph.add_poses(len(ids))
    _add_edges(path, graph, ids, edges)
    _add_priors(path, graph, ids, priors)
    return GraphRecord(graph, vertices.pose if len(vertices) else None, ids,
                       read_stamps(path, ids), (*skipped, *_skipped(groups, ids)),
                       rotation_information=rotation_information)


def read_vertices(path: str | os.PathLike[str], manifold: Manifold) -> tuple[Indices, Array]:
    """
    Return the ids (n,), ascending, and the poses (n, p), of this manifold, of a graph's vertices.

    Raises
    ------
    FileError : the file has none, or is no graph.

    """
    groups = _group(path)
    found = _manifold(path, groups)
    vertices = _vertices(path, groups, found)
    if not len(vertices):
        raise FileError(path, f'no vertices; expected {_expected("vertex")} lines')
    poses = vertices.pose
    return vertices.ids[:, 0], poses if found is manifold else manifold.from_pose3(
        found.to_pose3(poses))


def write_graph_file(path: str | os.PathLike[str], record: GraphRecord) -> None:
    """
    Write a graph with its own ids, every number such that it reads back the same.

    TORO for the suffix `.graph`, else g2o. Stamps and trusted loops, if any, go to side files;
    those of a former graph of this name are removed with that graph.

    Raises
    ------
    FileError : the file cannot be written, or its format has no place for a part of the graph.

    """
    path = Path(path)
    lines = _text(path, record)
    with replacing(path) as temporary:
        put_lines(temporary, lines)
        # Before the graph takes its place: it must never meet the stamps or the trust of another.
        write_beside(path, record.ids, record.stamps, record.graph.between)


def _group(path: str | os.PathLike[str]) -> dict[str, TextLines]:
    """Return the lines of each tag, without the tag; every tag is known."""
    lines = read_lines(path)
    groups: dict[str, TextLines] = defaultdict(lambda: TextLines([], []))
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        tag, *rest = text.split(None, 1)
        group = groups[tag]
        group.numbers.append(number)
        group.texts.append(rest[0] if rest else '')
    if not groups:
        raise FileError(path, f'the file is empty; expected {_expected("between")} lines')
    for tag, group in groups.items():
        _refuse_unknown(path, tag, group.numbers[0])
    return groups


def _refuse_unknown(path: object, tag: str, line: int) -> None:
    if tag in TAGS or tag in TAGS_LEFT_OUT or tag == 'FIX' or tag.startswith('PARAMS_'):
        return
    raise FileError(path, f'unknown tag {quoted(tag)}; expected {", ".join(TAGS)}', line)


def _expected(kind: str) -> str:
    *most, last = (name for name, tag in TAGS.items() if tag.kind == kind)
    return f'{", ".join(most)} or {last}'


def _manifold(path: object, groups: dict[str, TextLines]) -> Manifold:
    """Return what the poses of a file are of; there must be but one."""
    found = sorted((lines.numbers[0], name) for name, lines in groups.items() if name in TAGS)
    for line, name in found[1:]:
        if TAGS[name].manifold is not TAGS[found[0][1]].manifold:
            raise FileError(path, f'{name}: a line of {TAGS[name].manifold.NAME} beside '
                            f'{found[0][1]} at line {found[0][0]}; expected all poses in the '
                            'plane, or all in space', line)
    return TAGS[found[0][1]].manifold if found else se2


def _rows(path: object, groups: dict[str, TextLines], kind: str, manifold: Manifold,
          rotation_information: str = QUATERNION) -> _Rows:
    """Return the lines of one kind, whatever their tags."""
    parts = [_parse(path, name, groups.get(name, TextLines([], [])), rotation_information)
             for name, tag in TAGS.items() if (tag.kind, tag.manifold) == (kind, manifold)]
    if not parts:
        p, d = manifold.POSE_SIZE, manifold.TANGENT_SIZE
        return _Rows(np.empty(0, np.int64), np.empty((0, 1), np.int64), np.empty((0, p)),
                     np.empty((0, d, d)), np.empty((0, d)))
    together = _Rows(*(np.concatenate([getattr(part, column.name) for part in parts])
                       for column in fields(_Rows)))
    return together.subset(np.argsort(together.lines))


def _parse(path: object, name: str, lines: TextLines, rotation_information: str) -> _Rows:
    tag = TAGS[name]
    p, d = tag.pose, tag.manifold.TANGENT_SIZE
    ids, values = parse_rows(path, name, lines, tag.ids, p + len(tag.information))
    if tag.has_quaternion:
        refuse_quaternions(path, values[:, p - 4:p], lines.numbers)
    information = np.zeros((len(ids), d, d))
    for k, (row, column) in enumerate(tag.information):
        information[:, row, column] = information[:, column, row] = values[:, p + k]
    return _Rows(np.array(lines.numbers, np.int64), ids, tag.read(values[:, :p]), information,
                 np.tile(tag.units(rotation_information), (len(ids), 1)))


def _vertices(path: object, groups: dict[str, TextLines], manifold: Manifold) -> _Rows:
    """Return the vertices in ascending order of their ids."""
    rows = _rows(path, groups, 'vertex', manifold)
    order = np.argsort(rows.ids[:, 0], kind='stable')
    ids, lines = rows.ids[order], rows.lines[order]
    again = np.flatnonzero(ids[1:, 0] == ids[:-1, 0]) + 1
    if len(again):
        k = again[np.argmin(lines[again])]
        raise FileError(path, f'vertex {ids[k, 0]} stands twice, before at line {lines[k - 1]}; '
                        'expected each once', int(lines[k]))
    return rows.subset(order)


def _without_circles(edges: _Rows) -> tuple[_Rows, list[str]]:
    """Return the edges but for those from a vertex to itself, and a sentence on these, if any."""
    circle = edges.ids[:, 0] == edges.ids[:, 1]
    if not circle.any():
        return edges, []
    lines = edges.lines[circle].tolist()
    names = [str(number) for number in lines[:_NAMED]] + ['...'] * (len(lines) > _NAMED)
    sentence = (f'{counted(len(lines), "edge")} from a vertex to itself not used: '
                f'{"line" if len(lines) == 1 else "lines"} {", ".join(names)}')
    return edges.subset(~circle), [sentence]


def _add_edges(path: str | os.PathLike[str], graph: FactorGraph, ids: Indices,
               edges: _Rows) -> None:
    i, j = _index(path, ids, edges).T
    doubted = BetweenFactors(i, j, edges.pose, _roots(path, edges), np.zeros(len(edges), bool))
    graph.add_between(i, j, edges.pose, edges.scaled, read_trusted(path, ids, doubted))


def _add_priors(path: object, graph: FactorGraph, ids: Indices, priors: _Rows) -> None:
    index = _index(path, ids, priors)
    _roots(path, priors)
    graph.add_prior(index[:, 0], priors.pose, priors.scaled)


def _index(path: object, ids: Indices, rows: _Rows) -> Indices:
    """Return the keyframe index of every id of the rows, of the same shape."""
    index = np.minimum(np.searchsorted(ids, rows.ids), len(ids) - 1)
    unknown = ids[index] != rows.ids
    if unknown.any():
        k = int(np.argmax(unknown.any(axis=1)))
        name = rows.ids[k][unknown[k]][0]
        raise FileError(path, f'vertex {name} is unknown; expected one of the {len(ids)} vertices '
                        f'of this file, {ids[0]} to {ids[-1]}', int(rows.lines[k]))
    return index


def _roots(path: object, rows: _Rows) -> Array:
    """Return the square roots of the information, (m, d, d); each must have one."""
    def works(part: slice) -> bool:
        try:
            square_root_information(rows.scaled[part])
        except NoiseError:
            return False
        return True

    try:
        return square_root_information(rows.scaled)
    except NoiseError as error:
        k = first_failure(len(rows), works)
        entries = ' '.join(f'{v:g}' for v in rows.information[k].ravel())
        raise FileError(path, f'information [{entries}]; expected a positive definite matrix',
                        int(rows.lines[k])) from error


def _skipped(groups: dict[str, TextLines], ids: Indices) -> tuple[str, ...]:
    """Return a sentence on each tag that is known and not used."""
    sentences = []
    fixed = ' '.join(groups['FIX'].texts).split() if 'FIX' in groups else []
    if set(fixed) - {str(ids[0])}:
        sentences.append(f'FIX {quoted(" ".join(fixed))} is not used: the first vertex, {ids[0]}, '
                         'is the one held fixed')
    for tag, group in groups.items():
        if tag not in TAGS and tag != 'FIX':
            lines = counted(len(group.texts), f'{quoted(tag)} line is', f'{quoted(tag)} lines are')
            sentences.append(f'{lines} not used: '
                             f'{TAGS_LEFT_OUT.get(tag, SENSORS)}')
    return tuple(sentences)


def _text(path: Path, record: GraphRecord) -> list[str]:
    """Return the lines of the file, many to a string."""
    graph, ids = record.graph, record.ids
    none = np.empty((0, graph.manifold.TANGENT_SIZE, graph.manifold.TANGENT_SIZE))
    lines = []
    if record.poses is not None:
        lines += _lines(path, record, 'vertex', ids[:, None], record.poses, none)
    if len(graph.prior):
        lines += _lines(path, record, 'prior', ids[graph.prior.i][:, None],
                        graph.prior.measurement, graph.prior.sqrt_information)
    pairs = ids[graph.between.pairs]
    return lines + _lines(path, record, 'between', pairs, graph.between.measurement,
                          graph.between.sqrt_information)


def _lines(path: Path, record: GraphRecord, kind: str, ids: Indices, pose: Array,
           roots: Array) -> list[str]:
    """Return the lines of one kind: ids (m, k), pose (m, p), roots (m, d, d) of information."""
    file_format = FORMAT_OF_SUFFIX.get(path.suffix.lower(), 'g2o')
    manifold = record.graph.manifold
    names = [name for name, tag in TAGS.items() if (tag.file_format, tag.kind, tag.manifold)
             == (file_format, kind, manifold)]
    if not names:
        raise FileError(path, f'{file_format} has no line for a {kind} of {manifold.NAME}; '
                        'expected another suffix')
    tag = TAGS[names[0]]
    values = tag.write(pose)
    if tag.information:
        rows, columns = np.array(tag.information).T
        roots = roots / tag.units(record.rotation_information)
        information = settled(roots.transpose(0, 2, 1) @ roots)
        values = np.concatenate((values, information[:, rows, columns]), axis=1)
    readable = (np.abs(values) <= LARGEST).all(axis=1)
    if not readable.all():
        k = int(np.argmin(readable))
        line = ' '.join((names[0], *map(str, ids[k]), 'would be', *(f'{v:g}' for v in values[k])))
        raise FileError(path, f'{line}; expected numbers to {LARGEST:g}; nothing written')
    # %r: the fewest digits, 17 at most, that read back as the very same number.
    return formatted(f'{names[0]}{" %d" * ids.shape[1]}{" %r" * values.shape[1]}', ids, values)
