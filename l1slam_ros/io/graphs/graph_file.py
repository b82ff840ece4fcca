# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading pose graphs in g2o and TORO (`.graph`, `.toro`) format, and writing g2o; see `tags`.

Neither format has a place for stamps and for loops that a person vouched for or struck out: see
`side_files`, and for saved maps `remarks`.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, NoiseError
from l1slam_ros.core.geometry import se3
from l1slam_ros.core.geometry.manifold import Array, Indices, Manifold
from l1slam_ros.core.geometry.noise import Mask, distinct, square_root_information
from l1slam_ros.core.graph.factor_graph import WORLD, BetweenFactors, FactorGraph
from l1slam_ros.core.graph.landmarks import mark_landmarks
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.core.robust.odometry.drift import correction, straightened
from l1slam_ros.io.files import (
    LARGEST,
    TextLines,
    first_failure,
    formatted,
    invented_stamps,
    put_lines,
    quoted,
    replacing,
    rounded,
)
from l1slam_ros.io.graphs.anchors import anchors_of, fixed_in
from l1slam_ros.io.graphs.left_out import MEASURED, STRUCK, commented, in_place, nothing_left_out
from l1slam_ros.io.graphs.robot_log import RobotLog
from l1slam_ros.io.graphs.robots import keyframes_of
from l1slam_ros.io.graphs.rows import (
    Rows,
    expected_tags,
    in_order_of_file,
    lines_by_tag,
    made_definite,
    manifold_of,
    not_used,
    refuse_unknown_ties,
    rows_of,
    turning_too_far,
    vertices_of,
    with_equivalents,
    without_circles,
)
from l1slam_ros.io.graphs.side_files import loops_between, named_loops, read_stamps, write_beside
from l1slam_ros.io.graphs.tags import FACTORS, NO_OFFSET, TAGS
from l1slam_ros.io.ours import MARK
from l1slam_ros.io.remarks import Remarks, wrong_contents


@dataclass(frozen=True)
class GraphRecord:
    """
    A graph together with what else its file holds.

    graph : the factors, in the order of the file; poses : (n, p) the stored poses, or None;
    ids : (n,) vertex ids, ascending: keyframe k is vertex ids[k]; stamps : (n,) [ns] or None;
    skipped : a sentence for each kind of line that was not used, or was changed;
    damage : a sentence if only a part of the input could be read, else empty;
    rotation_information : whether the rotation block of the information in a 3D g2o file is that
    of the quaternion's vector part or of the angle, of `names`;
    remarks : the state of a saved map; left_out : (m,) for each factor why the map does not use
    it, a word of `left_out`, or empty; comments : comment lines of other programs, each with the
    number of factors before it;
    drift : of the odometry of the map [rad/m], see `Judgement`: corrected odometry is written;
    log : further content of a log of several robots.
    """

    graph: FactorGraph
    poses: Array | None
    ids: Indices
    stamps: Indices | None = None
    skipped: tuple[str, ...] = ()
    damage: str = ''
    rotation_information: str = QUATERNION
    remarks: Remarks = None
    left_out: np.ndarray | None = None
    comments: tuple[tuple[int, str], ...] = ()
    drift: float = 0.0
    log: RobotLog | None = None

    @property
    def times(self) -> Indices:
        """The stamps [ns], (n,), invented where there are none."""
        return invented_stamps(self.graph.n_poses) if self.stamps is None else self.stamps

    @property
    def believed(self) -> FactorGraph:
        """The factors that the stored map is made of: odometry corrected, nothing left out."""
        return straightened(self.graph, self.drift).subset(left_out_words(self) == '')


def read_graph_file(path: str | os.PathLike[str], rotation_information: str = QUATERNION,
                    information: float | None = None) -> GraphRecord:
    """
    Read a g2o or TORO file, with the stamps and the vouched-for and struck-out loops beside it.

    Vertices may be in any order. Without vertex lines, the vertices are those of the edges, and
    `poses` is None. The graph need not be connected.

    information : the entries on the diagonal of the information of factors without one

    Raises
    ------
    FileError : naming the line, if the file is malformed, or a file beside it does not match it.

    """
    record, beyond = read_one_of_several(path, rotation_information, information)
    if len(beyond):
        _index(path, record.ids, beyond)
    return record


def read_one_of_several(path: str | os.PathLike[str], rotation_information: str = QUATERNION,
                        information: float | None = None) -> tuple[GraphRecord, Rows]:
    """
    Read a graph as `read_graph_file` does, and its edges to vertices of other files.

    Raises
    ------
    FileError : naming the line, if the file is malformed, or a file beside it does not match it.

    """
    lines = lines_by_tag(path)
    groups, remarks = lines.groups, lines.remarks
    manifold = manifold_of(path, groups)
    edges, circles = without_circles(
        rows_of(path, groups, manifold, FACTORS, rotation_information, information))
    edges, reordered = in_order_of_file(edges, groups)
    edges, indefinite = made_definite(edges)
    if edges.alone.all():
        raise FileError(path, f'no edges; expected {expected_tags("between")} lines')
    edges, vouched, equivalents = with_equivalents(path, groups, edges)
    said = *circles, *reordered, *indefinite, *turning_too_far(edges, manifold), *equivalents
    vertices = vertices_of(path, groups, manifold)
    ids = vertices.ids[:, 0] if len(vertices) else np.unique(edges.ids)
    refuse_unknown_ties(path, groups, ids)
    anchors = anchors_of(groups, ids, edges)
    if len(anchors):
        kept = ~np.isin(ids, anchors)
        ids, vertices = ids[kept], vertices.chosen(kept) if len(vertices) else vertices
        edges = edges.chosen(np.flatnonzero(np.isin(edges.ids, anchors).sum(axis=1) == 0))
    graph = keyframes_of(ids, manifold)
    inside: Mask = np.isin(edges.ids, ids).all(axis=1) | edges.alone
    edges, beyond = edges.chosen(inside), edges.chosen(~inside)
    order, left_out, as_measured = in_place(edges.lines, lines.left_out)
    stand, corrected, edges = edges.lines[order], edges.pose[order], edges.chosen(as_measured)
    _add_edges(path, graph, ids, edges, remarks, left_out == STRUCK, vouched)
    changed = np.flatnonzero(order != as_measured)
    used = np.flatnonzero(left_out == '')
    ends = np.concatenate(([0], used + 1))
    before = ends[np.searchsorted(
        stand[used], [number for number, _ in lines.comments])].tolist()
    record = GraphRecord(
        graph, vertices.pose if len(vertices) else None, ids, _stamps(path, ids, remarks),
        (*said, *_skipped(groups, ids, anchors)),
        rotation_information=rotation_information, remarks=remarks, left_out=left_out,
        comments=tuple(zip(before, (text for _, text in lines.comments), strict=True)),
        drift=correction(graph.between, changed, corrected[changed]))
    return record, beyond


def read_vertices(path: str | os.PathLike[str],
                  manifold: Manifold) -> tuple[Indices, Array, Indices | None]:
    """
    Return of a graph's vertices ids (n,), ascending, poses (n, p), and stamps (n,) [ns], if any.

    manifold : the poses are wanted on it, whatever they are of in the file

    Raises
    ------
    FileError : the file has none, or is no graph.

    """
    lines = lines_by_tag(path)
    groups, remarks = lines.groups, lines.remarks
    found = manifold_of(path, groups)
    vertices = vertices_of(path, groups, found)
    if not len(vertices):
        raise FileError(path, f'no vertices; expected {expected_tags("vertex")} lines')
    ids, poses = vertices.ids[:, 0], vertices.pose
    if found is not manifold:
        poses = manifold.from_pose3(found.to_pose3(poses))
    return ids, poses, _stamps(path, ids, remarks)


def write_graph_file(path: str | os.PathLike[str], record: GraphRecord) -> None:
    """
    Write a graph as g2o, with its own ids and with numbers that are read back exactly.

    Factors that were left out are written as comments, see `left_out`. Stamps, trusted and
    struck-out loops are written to side files; side files of a previous graph of this name are
    removed.

    Raises
    ------
    FileError : the file cannot be written, or holds a number too large to be read back.

    """
    path = Path(path)
    with replacing(path) as temporary:
        put_lines(temporary, [*graph_lines(path, record), MARK])
        # The side files first: a graph must never be read with the side files of another graph.
        write_beside(path, record.ids, record.stamps, record.graph.between)


def _stamps(path: str | os.PathLike[str], ids: Indices, remarks: Remarks) -> Indices | None:
    if not remarks:
        return read_stamps(path, ids)
    with wrong_contents(path):
        return np.array(remarks['stamps'], np.int64).reshape(ids.shape)


def _add_edges(path: str | os.PathLike[str], graph: FactorGraph, ids: Indices, edges: Rows,
               remarks: Remarks, struck_here: Mask, vouched: Indices) -> None:
    i, j = _index(path, ids, edges).T
    i, none = np.where(edges.alone, WORLD, i), np.zeros(len(edges), bool)
    if not remarks:  # all poses of a saved map are of robots
        mark_landmarks(graph, ids, i, j)
    roots = roots_of(path, edges)
    doubted = BetweenFactors(i, j, edges.pose, roots, none, none, graph.predecessor)
    if remarks:
        with wrong_contents(path):
            trusted, struck = (np.array(remarks[name], bool).reshape(len(edges))
                               for name in ('trusted', 'struck'))
    else:
        trusted, struck = (named_loops(path, name, ids, doubted)
                           for name in ('trusted', 'struck'))
    true = trusted | loops_between(ids, doubted, vouched)
    graph.append_between(i, j, edges.pose, roots, true & ~struck & ~struck_here,
                         (struck & ~trusted) | struck_here)


def _index(path: object, ids: Indices, rows: Rows) -> Indices:
    """Return the keyframe index of every id of the rows, of the same shape."""
    index = np.minimum(np.searchsorted(ids, rows.ids), len(ids) - 1)
    unknown = ids[index] != rows.ids
    if unknown.any():
        k = int(np.argmax(unknown.any(axis=1)))
        name = rows.ids[k][unknown[k]][0]
        raise FileError(path, f'vertex {name} is unknown; expected one of the {len(ids)} vertices '
                        f'of this file, {ids[0]} to {ids[-1]}', int(rows.lines[k]))
    return index


def roots_of(path: object, rows: Rows) -> Array:
    """Return the square roots of the information, (m, d, d); raise if a matrix has none."""
    def works(part: slice) -> bool:
        try:
            square_root_information(rows.scaled[part])
        except NoiseError:
            return False
        return True

    try:
        place, which = distinct(rows.scaled)
        return square_root_information(rows.scaled[place])[which]
    except NoiseError as error:
        k = first_failure(len(rows), works)
        entries = ' '.join(f'{v:g}' for v in rows.information[k].ravel())
        raise FileError(path, f'information [{entries}]; expected a positive definite matrix',
                        int(rows.lines[k])) from error


def _skipped(groups: dict[str, TextLines], ids: Indices,
             anchors: Indices) -> tuple[str, ...]:
    """Return a sentence for each kind of line that is not used."""
    sentences = [f'vertex {anchor} and its edge are not used: it is an anchor, and the first '
                 f'vertex, {ids[0]}, is the one held fixed' for anchor in anchors.tolist()]
    fixed = [name for name in fixed_in(groups) if name not in anchors.astype(str)]
    if set(fixed) - {str(ids[0])}:
        sentences.append(f'FIX {quoted(" ".join(fixed))} is not used: the first vertex, {ids[0]}, '
                         'is the one held fixed')
    return *sentences, *not_used(groups)


def graph_lines(path: Path, record: GraphRecord) -> list[str]:
    """Return the lines of a graph file, many to a string."""
    graph, ids = record.graph, record.ids
    d = graph.manifold.TANGENT_SIZE
    lines = [] if record.poses is None else _lines(
        path, record, 'vertex', ids[:, None], record.poses, np.empty((0, d, d)))
    left_out = left_out_words(record)
    if graph.between.is_absolute.any() and graph.manifold is se3:
        lines.append(NO_OFFSET)
    texts = used_texts = _factor_lines(path, record, graph)
    used, beside = left_out == '', left_out
    if record.drift:
        used_texts = _factor_lines(path, record, straightened(graph, record.drift))
        beside = np.where(used & graph.between.is_odometry, MEASURED, left_out)
    comments = tuple((int(used[:before].sum()), text) for before, text in record.comments)
    return [*_among(comments, lines, used_texts[used].tolist()),
            *commented(texts.tolist(), beside)]


def _factor_lines(path: Path, record: GraphRecord, graph: FactorGraph) -> np.ndarray:
    """Return the line of each factor of a graph, (m,)."""
    factors = graph.between
    pairs = record.ids[graph.between.pairs]
    kinds = _kinds(graph)
    texts = np.empty(len(factors), object)
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        texts[rows] = '\n'.join(_lines(
            path, record, str(kind), pairs[rows], factors.measurement[rows],
            factors.sqrt_information[rows])).split('\n')
    return texts


def left_out_words(record: GraphRecord) -> np.ndarray:
    """Return for each factor why it is left out, (m,), loops struck out since included."""
    factors = record.graph.between
    words = nothing_left_out(len(factors)) if record.left_out is None else record.left_out.copy()
    words[words == STRUCK] = ''
    words[factors.struck] = STRUCK
    return words


def _among(comments: tuple[tuple[int, str], ...], head: list[str],
           lines: list[str]) -> list[str]:
    """Return head and lines with each comment at its place: behind as many lines as before."""
    texts: list[str] = [text for before, text in comments if before == 0]
    texts += head
    done = 0
    for before, text in comments:
        if before:
            texts += [*lines[done:before], text]
            done = before
    return texts + lines[done:]


def _kinds(graph: FactorGraph) -> np.ndarray:
    """Return the kind of line of each factor, (m,), of `FACTORS`."""
    factors, rest = graph.between, graph.manifold.identity(1)
    size = graph.manifold.positions(rest).shape[1]
    is_position = ((factors.measurement[:, size:] == rest[:, size:]).all(axis=1)
                   & ~factors.speaks[:, graph.manifold.ROTATION].any(axis=1))
    return np.where(~factors.is_absolute, 'between', np.where(is_position, 'position', 'absolute'))


def _lines(path: Path, record: GraphRecord, kind: str, ids: Indices, pose: Array,
           roots: Array) -> list[str]:
    """Return the lines of one kind: ids (m, 1 or 2), pose (m, p), roots of information."""
    name, tag = next((name, tag) for name, tag in TAGS.items()
                     if (tag.kind, tag.manifold) == (kind, record.graph.manifold))
    # An absolute pose in space has the number of an offset where others have the second id.
    ids = np.pad(ids[:, :tag.vertices], ((0, 0), (0, tag.ids - tag.vertices)))
    values = pose[:, :tag.values]
    place, which = distinct(roots)
    if tag.information:
        rows, columns = np.array(tag.information).T
        roots = roots[place] / tag.units(record.rotation_information)
        information = rounded(roots.transpose(0, 2, 1) @ roots)[:, rows, columns]
        values = np.concatenate((values, information[which]), axis=1)
    readable = (np.abs(values) <= LARGEST).all(axis=1)
    if not readable.all():
        k = int(np.argmin(readable))
        line = ' '.join((name, *map(str, ids[k]), 'would be', *(f'{v:g}' for v in values[k])))
        raise FileError(path, f'{line}; expected numbers up to {LARGEST:g}; nothing written')
    # %r: the fewest digits, 17 at most, that read back as the very same number.
    head = f'{name}{" %d" * ids.shape[1]}{" %r" * tag.values}'
    if not tag.information:
        return formatted(head, ids, values)
    said = '\n'.join(formatted(' %r' * len(tag.information), information)).split('\n')
    return formatted(f'{head}%s', ids, values[:, :tag.values], np.array(said, object)[which, None])
