# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Graphs of several drives or robots -> one graph; nothing is solved here.

In: a `Part` for each input, and loops between them: a file of them, and edges of one input to the
vertices of another. Out: a record of all keyframes and factors, each input's odometry its own.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import (
    LANDMARK,
    NO_PREDECESSOR,
    WORLD,
    FactorGraph,
    component_labels,
)
from l1slam_ros.core.names import QUATERNION
from l1slam_ros.fleet.numbering import numbered
from l1slam_ros.fleet.scanning import Found
from l1slam_ros.io.files import TextLines, counted, quoted, read_lines
from l1slam_ros.io.formats import named
from l1slam_ros.io.graphs.graph_file import GraphRecord, roots_of
from l1slam_ros.io.graphs.robots import robots_of
from l1slam_ros.io.graphs.rows import Rows, made_definite, rows_of
from l1slam_ros.io.graphs.tags import TAGS

# Of the larger extent of all parts: so far are drawn apart what nothing joins.
_BESIDE = 0.1


class Part(NamedTuple):
    """
    One input.

    path : of it; record : its graph; beyond : its edges to vertices that it does not have, if any.
    """

    path: Path
    record: GraphRecord
    beyond: Rows | None = None


@dataclass(frozen=True)
class Merged:
    """
    All inputs as one graph.

    record : with ids that no two inputs share; of_input : (n,) the number of the input that each
    keyframe is of, from 0.
    """

    record: GraphRecord
    of_input: Indices


def merged(parts: Sequence[Part], loops: Path | None, found: Found | None = None,
           rotation_information: str = QUATERNION, information: float | None = None) -> Merged:
    """
    Return one graph of all parts.

    Parameters
    ----------
    parts : one or more
    loops : a file of edges between them, whose vertices are `NUMBER:ID`, the number of the part,
        from 1, and the vertex in it
    found : loops that a front end found
    rotation_information : of that file, see `GraphRecord`
    information : of its edges without one, see `read_input`

    Raises
    ------
    FileError : parts of the plane and of space, or a loop that names a vertex that is not there.

    """
    manifold = parts[0].record.graph.manifold
    for part in parts:
        if part.record.graph.manifold is not manifold:
            raise FileError(part.path, f'is of {part.record.graph.manifold.NAME}; expected '
                            f'{manifold.NAME}, as {parts[0].path}')
    with named(parts[0].path):
        new = numbered([part.record.ids for part in parts])
    ids = np.concatenate(new)
    order = np.argsort(ids)
    index = np.argsort(order)
    of_input = np.repeat(np.arange(len(parts)), [len(part) for part in new])
    own = np.split(index, np.cumsum([len(part) for part in new])[:-1])
    graph = _keyframes(parts, ids[order], of_input[order], own)
    for part, place in zip(parts, own, strict=True):
        factors = part.record.graph.between
        graph.append_between(
            np.where(factors.is_absolute, WORLD, place[factors.i]), place[factors.j],
            factors.measurement, factors.sqrt_information, factors.trusted, factors.struck)
    said = [f'{part.path}: {sentence}' for part in parts for sentence in part.record.skipped]
    said += _renamed(parts, new)
    for number, part in enumerate(parts):
        if part.beyond is not None and len(part.beyond):
            said += _append(graph, part.path, part.beyond,
                            _ends(parts, own, number, part.beyond))
    if found is not None:
        i, j = (np.array([own[number][vertex] for number, vertex in zip(
            found.inputs[:, end], found.ids[:, end], strict=True)], np.int64) for end in (0, 1))
        graph.append_between(i, j, found.measurement, found.roots)
        said += found.said
    if loops is not None:
        said += _append(graph, loops, *_listed(
            parts, own, loops, rotation_information, information))
    stamps = [part.record.stamps for part in parts]
    known = [stamp for stamp in stamps if stamp is not None]
    return Merged(GraphRecord(
        graph, None, ids[order], np.concatenate(known)[order] if len(known) == len(parts)
        else None, tuple(said), '; '.join(filter(None, (part.record.damage for part in parts))),
        rotation_information), of_input[order])


def _keyframes(parts: Sequence[Part], ids: Indices, of_input: Indices,
               own: list[Indices]) -> FactorGraph:
    """Return a graph of all keyframes; symbols of one letter are of one robot."""
    graph = FactorGraph(parts[0].record.graph.manifold)
    letters = robots_of(ids)
    robot = np.where(letters > 0, letters, -1 - of_input)
    for run in np.split(robot, np.flatnonzero(np.diff(robot)) + 1):
        graph.add_poses(len(run), int(run[0]))
    for part, place in zip(parts, own, strict=True):
        before = part.record.graph.predecessor
        follows = before != NO_PREDECESSOR
        graph.follow(place[follows], place[before[follows]])
        graph.follow(place[1:][~follows[1:]], NO_PREDECESSOR)
    landmark = np.concatenate([place[part.record.graph.is_landmark]
                               for part, place in zip(parts, own, strict=True)])
    if len(landmark):
        robot = graph.robot.copy()
        robot[landmark] = LANDMARK
        graph.follow(landmark, NO_PREDECESSOR, robot)
    return graph


def _renamed(parts: Sequence[Part], new: list[Indices]) -> list[str]:
    """Return a sentence on each part whose vertices have other ids now."""
    return [f'{part.path}: its vertices {part.record.ids[0]} to {part.record.ids[-1]} are '
            f'{ids[0]} to {ids[-1]} in the map' for part, ids in zip(parts, new, strict=True)
            if (part.record.ids != ids).any()]


def _ends(parts: Sequence[Part], own: list[Indices], number: int, edges: Rows) -> Indices:
    """Return the keyframes (m, 2) of a part's edges to others; each must be of one part alone."""
    found = np.full(edges.ids.shape, -1)
    there = np.zeros(edges.ids.shape, np.int64)
    mine = _places(parts[number], own[number], edges.ids)
    for other, part in enumerate(parts):
        if other != number:
            place = _places(part, own[other], edges.ids)
            there += place >= 0
            found = np.where(place >= 0, place, found)
    wrong = (mine < 0) & (there != 1)
    if wrong.any():
        k = int(np.argmax(wrong.any(axis=1)))
        name = edges.ids[k][wrong[k]][0]
        count = there[k][wrong[k]][0]
        where = 'of no input' if not count else f'of {count} other inputs'
        raise FileError(parts[number].path, f'vertex {name} is {where}; expected a vertex of this '
                        'file, or of one of the others', int(edges.lines[k]))
    return np.where(mine >= 0, mine, found)


def _places(part: Part, own: Indices, ids: Indices) -> Indices:
    """Return the keyframes of the merged graph that some ids of a part are, -1: it has none."""
    known = part.record.ids
    at = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    return np.where(known[at] == ids, own[at], -1)


def _append(graph: FactorGraph, path: Path, edges: Rows, ends: Indices) -> list[str]:
    """Append edges between keyframes (m, 2); of those that stand there already, say how many."""
    edges, said = made_definite(edges)
    factors = graph.between
    known = {(*pair, *pose) for pair, pose in zip(
        factors.pairs.tolist(), factors.measurement.tolist(), strict=True)}
    fresh: Mask = np.array([(*pair, *pose) not in known for pair, pose in zip(
        ends.tolist(), edges.pose.tolist(), strict=True)], bool)
    i, j = ends[fresh].T
    graph.append_between(i, j, edges.pose[fresh], roots_of(path, edges.chosen(fresh)))
    if not fresh.all():
        said.append(f'{path}: {counted(int((~fresh).sum()), "edge")} to another input given '
                    'there, too: used once')
    return said


def _listed(parts: Sequence[Part], own: list[Indices], path: Path,
            rotation_information: str, information: float | None) -> tuple[Rows, Indices]:
    """Return the edges of a file of loops, and their keyframes (m, 2)."""
    manifold = parts[0].record.graph.manifold
    tags = [name for name, tag in TAGS.items() if (tag.kind, tag.manifold) == (
        'between', manifold)]
    groups: dict[str, TextLines] = defaultdict(lambda: TextLines([], []))
    ends: dict[int, tuple[int, int]] = {}
    lines = read_lines(path)
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        tag, *names = text.split(None, 3)
        if tag not in tags or len(names) < 3:
            raise FileError(path, f'{quoted(text)}; expected `{tags[0]} NUMBER:ID NUMBER:ID ...`',
                            number)
        ends[number] = (_end(parts, own, path, names[0], number),
                        _end(parts, own, path, names[1], number))
        groups[tag].numbers.append(number)
        groups[tag].texts.append(f'0 1 {names[2]}')
    if not ends:
        raise FileError(path, f'no loops; expected lines `{tags[0]} NUMBER:ID NUMBER:ID ...`')
    rows = rows_of(path, groups, manifold, ('between',), rotation_information, information)
    found = np.array([ends[number] for number in rows.lines.tolist()])
    if (found[:, 0] == found[:, 1]).any():
        k = int(np.argmax(found[:, 0] == found[:, 1]))
        raise FileError(path, 'a loop from a vertex to itself; expected two vertices',
                        int(rows.lines[k]))
    return rows, found


def _end(parts: Sequence[Part], own: list[Indices], path: Path, name: str, line: int) -> int:
    """Return the keyframe that a file of loops names."""
    number, _, vertex = name.partition(':')
    try:
        k = int(number)
        wanted = np.array([int(vertex)], np.int64)
    except (ValueError, OverflowError) as error:
        raise FileError(path, f'{quoted(name)}; expected NUMBER:ID, the number of an input and a '
                        'vertex of it, as 1:17', line) from error
    if not 1 <= k <= len(parts):
        raise FileError(path, f'{quoted(name)}: input {k}; expected 1 to {len(parts)}', line)
    place = int(_places(parts[k - 1], own[k - 1], wanted)[0])
    if place < 0:
        raise FileError(path, f'vertex {vertex} is not of {parts[k - 1].path}; expected one of '
                        f'its {len(own[k - 1]):,}', line)
    return place


def parts_beside(graph: FactorGraph, poses: Array) -> Array:
    """Return poses (n, p) such that parts that no factor joins lie beside each other, along x."""
    label = component_labels(graph)
    moved = poses.copy()
    along = graph.manifold.positions(poses)[:, 0]
    width = [along[label == part].max() - along[label == part].min()
             for part in range(label.max() + 1)]
    apart = _BESIDE * max(width)
    edge = along[label == 0].max()
    for part in range(1, label.max() + 1):
        rows = label == part
        moved[rows, 0] += edge + apart - along[rows].min()
        edge += apart + width[part]
    return moved


def apart_sentences(graph: FactorGraph, of_input: Indices, paths: Sequence[Path]) -> list[str]:
    """Return a sentence on each input that no factor of a graph joins to the first one."""
    label = component_labels(graph)
    with_first = np.isin(label, label[of_input == 0])
    return [f'{path}: nothing that is believed joins it to {paths[0]}; it is a part of its own, '
            'and lies beside it' for number, path in enumerate(paths)
            if number and not with_first[of_input == number].any()]
