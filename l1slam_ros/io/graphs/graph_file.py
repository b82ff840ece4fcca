# SPDX-License-Identifier: Apache-2.0
"""
Pose graphs as text: g2o (`.g2o`) and TORO (`.graph`), read and written by one table of tags.

A line is a tag, one or two vertex ids, a pose, and the upper triangle of an information matrix:

    VERTEX_SE2 id x y theta                                VERTEX2 id x y theta
    EDGE_SE2 i j x y theta xx xy xt yy yt tt               EDGE2 i j x y theta xx xy yy tt xt yt
    EDGE_PRIOR_SE2 id x y theta xx xy xt yy yt tt          EDGE_PRIOR_SE2_XY id x y xx xy yy

Priors are absolute factors; rows and columns of zeros in the information say nothing.
**TORO orders the information otherwise** (forward, sideways, rotation: `ff fs ss rr fr sr`).
Stamps and trust in loops, which neither format knows, live beside the graph: see `side_files`.
"""

import os
from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, NoiseError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask, square_root_information
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.io.files import (
    LARGEST,
    TextLines,
    first_failure,
    formatted,
    parse_rows,
    put_lines,
    quoted,
    read_lines,
    replacing,
    settled,
)
from l1slam_ros.io.graphs.side_files import read_stamps, read_trusted, write_beside
from l1slam_ros.io.graphs.tags import FACTORS, SENSORS, TAGS, TAGS_3D, TAGS_LEFT_OUT
from l1slam_ros.io.wording import counted


@dataclass(frozen=True)
class GraphRecord:
    """
    A graph and what its file says besides.

    graph : the factors, in the order of the file; poses : (n, p) the stored start, None when
    the file has none; ids : (n,) vertex ids, ascending: keyframe k is vertex ids[k];
    stamps : (n,) [ns] or None; skipped : a sentence on each kind of line that was not used;
    damage : a sentence where only a part of the input could be read, else empty.
    """

    graph: FactorGraph
    poses: Array | None
    ids: Indices
    stamps: Indices | None = None
    skipped: tuple[str, ...] = ()
    damage: str = ''


_NAMES = {'vertex': 'a vertex', 'between': 'an edge', 'absolute': 'an absolute pose',
          'position': 'an absolute pose'}
_FORMAT_OF_SUFFIX = {'.graph': 'toro'}
# So many lines are named in one sentence.
_NAMED = 3


@dataclass(frozen=True)
class _Rows:
    """
    The lines of some kinds, in the order of the file.

    lines : (m,) line numbers; ids : (m, 2), the same twice where a line has but one; alone : (m,)
    bool, where it has; pose : (m, p); information : (m, d, d).
    """

    lines: Indices
    ids: Indices
    alone: Mask
    pose: Array
    information: Array

    def __len__(self) -> int:
        return len(self.lines)

    def chosen(self, rows: Indices | Mask) -> '_Rows':
        """Return some of the lines, in the order of `rows`."""
        return _Rows(*(getattr(self, column.name)[rows] for column in fields(self)))


def read_graph_file(path: str | os.PathLike[str]) -> GraphRecord:
    """
    Read a g2o or TORO file, and beside it the stamps and which loops are trusted.

    Vertices may stand anywhere and in any order, or not at all: then they are those the edges
    name, and `poses` is None. Whether the graph is connected is not looked at.

    Raises
    ------
    FileError : naming the line, when the file is no such graph or those beside it are of another.

    """
    groups = _group(path)
    edges, skipped = _without_circles(_rows(path, groups, *FACTORS))
    if edges.alone.all():
        raise FileError(path, f'no edges; expected {_expected("between")} lines')
    vertices = _vertices(path, groups)
    ids = vertices.ids[:, 0] if len(vertices) else np.unique(edges.ids)
    graph = FactorGraph(se2)
    graph.add_poses(len(ids))
    _add_edges(path, graph, ids, edges)
    return GraphRecord(graph, vertices.pose if len(vertices) else None, ids,
                       read_stamps(path, ids), (*skipped, *_skipped(groups, ids)))


def read_vertices(path: str | os.PathLike[str]) -> tuple[Indices, Array]:
    """
    Return the ids (n,), ascending, and the poses (n, p) of the vertices of a graph file.

    Raises
    ------
    FileError : the file has none, or is no graph.

    """
    vertices = _vertices(path, _group(path))
    if not len(vertices):
        raise FileError(path, f'no vertices; expected {_expected("vertex")} lines')
    return vertices.ids[:, 0], vertices.pose


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
    if tag in TAGS_3D or 'SE3' in tag or 'SIM3' in tag:
        raise FileError(path, f'{quoted(tag)}: 3D graphs are not supported yet; expected a graph '
                        f'in the plane ({_expected("between")} lines)', line)
    raise FileError(path, f'unknown tag {quoted(tag)}; expected {", ".join(TAGS)}', line)


def _expected(kind: str) -> str:
    return ' or '.join(name for name, tag in TAGS.items() if tag.kind == kind)


def _rows(path: object, groups: dict[str, TextLines], *kinds: str) -> _Rows:
    """Return the lines of some kinds, whatever their tags."""
    parts = [_parse(path, name, groups.get(name, TextLines([], [])))
             for name, tag in TAGS.items() if tag.kind in kinds]
    both = _Rows(*(np.concatenate([getattr(part, column.name) for part in parts])
                   for column in fields(_Rows)))
    return both.chosen(np.argsort(both.lines))


def _parse(path: object, name: str, lines: TextLines) -> _Rows:
    tag = TAGS[name]
    p, d = tag.values, tag.manifold.TANGENT_SIZE
    ids, values = parse_rows(path, name, lines, tag.ids, p + len(tag.information))
    m = len(ids)
    pose, information = tag.manifold.identity(m), np.zeros((m, d, d))
    pose[:, :p] = values[:, :p]
    for k, (row, column) in enumerate(tag.information):
        information[:, row, column] = information[:, column, row] = values[:, p + k]
    return _Rows(np.array(lines.numbers, np.int64), np.repeat(ids, 2 // tag.ids, axis=1),
                 np.full(m, tag.ids == 1), pose, information)


def _vertices(path: object, groups: dict[str, TextLines]) -> _Rows:
    """Return the vertices in ascending order of their ids."""
    rows = _rows(path, groups, 'vertex')
    rows = rows.chosen(np.argsort(rows.ids[:, 0], kind='stable'))
    ids, lines = rows.ids, rows.lines
    again = np.flatnonzero(ids[1:, 0] == ids[:-1, 0]) + 1
    if len(again):
        k = again[np.argmin(lines[again])]
        raise FileError(path, f'vertex {ids[k, 0]} stands twice, before at line {lines[k - 1]}; '
                        'expected each once', int(lines[k]))
    return rows


def _without_circles(edges: _Rows) -> tuple[_Rows, list[str]]:
    """Return the edges but for those from a vertex to itself, and a sentence on these, if any."""
    circle = (edges.ids[:, 0] == edges.ids[:, 1]) & ~edges.alone
    if not circle.any():
        return edges, []
    lines = edges.lines[circle].tolist()
    names = [str(number) for number in lines[:_NAMED]] + ['...'] * (len(lines) > _NAMED)
    sentence = (f'{counted(len(lines), "edge")} from a vertex to itself not used: '
                f'{"line" if len(lines) == 1 else "lines"} {", ".join(names)}')
    return edges.chosen(~circle), [sentence]


def _add_edges(path: str | os.PathLike[str], graph: FactorGraph, ids: Indices,
               edges: _Rows) -> None:
    i, j = _index(path, ids, edges).T
    i = np.where(edges.alone, WORLD, i)
    doubted = BetweenFactors(i, j, edges.pose, _roots(path, edges), np.zeros(len(edges), bool))
    graph.add_between(i, j, edges.pose, edges.information, read_trusted(path, ids, doubted))


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
            square_root_information(rows.information[part])
        except NoiseError:
            return False
        return True

    try:
        return square_root_information(rows.information)
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
    d = graph.manifold.TANGENT_SIZE
    lines = [] if record.poses is None else _lines(
        path, graph, 'vertex', ids[:, None], record.poses, np.empty((0, d, d)))
    factors, pairs, kinds = graph.between, ids[graph.between.pairs], _kinds(graph)
    texts = np.empty(len(factors), object)
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        columns = slice(None) if kind == 'between' else slice(1)
        written = _lines(path, graph, str(kind), pairs[rows, columns], factors.measurement[rows],
                         factors.sqrt_information[rows])
        if len(rows) == len(factors):
            return lines + written
        texts[rows] = '\n'.join(written).split('\n')
    return lines + texts.tolist()


def _kinds(graph: FactorGraph) -> np.ndarray:
    """Return how each factor is to be written, (m,) of `FACTORS`."""
    factors, rest = graph.between, graph.manifold.identity(1)
    size = graph.manifold.positions(rest).shape[1]
    is_position = ((factors.measurement[:, size:] == rest[:, size:]).all(axis=1)
                   & ~factors.speaks[:, graph.manifold.ROTATION].any(axis=1))
    return np.where(~factors.is_absolute, 'between',
                    np.where(is_position, 'position', 'absolute'))


def _lines(path: Path, graph: FactorGraph, kind: str, ids: Indices, pose: Array,
           roots: Array) -> list[str]:
    """Return the lines of one kind: ids (m, k), pose (m, p), roots (m, d, d) of information."""
    file_format = _FORMAT_OF_SUFFIX.get(path.suffix.lower(), 'g2o')
    names = [name for name, tag in TAGS.items() if (tag.file_format, tag.kind, tag.manifold)
             == (file_format, kind, graph.manifold)]
    if not names:
        raise FileError(path, f'{file_format} has no line for {_NAMES[kind]} of '
                        f'{graph.manifold.NAME}; expected another suffix')
    tag = TAGS[names[0]]
    values = pose[:, :tag.values]
    if tag.information:
        rows, columns = np.array(tag.information).T
        information = settled(roots.transpose(0, 2, 1) @ roots)
        values = np.concatenate((values, information[:, rows, columns]), axis=1)
    readable = (np.abs(values) <= LARGEST).all(axis=1)
    if not readable.all():
        k = int(np.argmin(readable))
        line = ' '.join((names[0], *map(str, ids[k]), 'would be', *(f'{v:g}' for v in values[k])))
        raise FileError(path, f'{line}; expected numbers to {LARGEST:g}; nothing written')
    # %r: the fewest digits, 17 at most, that read back as the very same number.
    return formatted(f'{names[0]}{" %d" * ids.shape[1]}{" %r" * values.shape[1]}', ids, values)
