# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `l1slam info` says: the numbers of a graph or bag, and a sentence on what looks wrong."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.parts import connected_parts, odometry_gaps
from l1slam_ros.core.names import ANGLE, QUATERNION
from l1slam_ros.core.robust import inspection
from l1slam_ros.core.robust.places import first_told
from l1slam_ros.io.files import NANOSECONDS, counted, stamp_text
from l1slam_ros.io.graphs.graph_file import GraphRecord, left_out_words
from l1slam_ros.io.graphs.robots import robot_names, robots_of
from l1slam_ros.io.sentences import WITHOUT, offset_sentence

# A reading of the rotations' information fits where their errors are as large as it says, to this
# logarithm: half of what it is to the other reading.
_FITS = math.log(2) / 2
# So many examples are named in one sentence, and so many characters of a note.
_NAMED, _LONGEST = 3, 20


def bag_numbers(path: Path) -> list[tuple[str, str]]:
    """Return what is worth knowing of a bag, whatever its topics."""
    from l1slam_ros.io.bags.reader import bag_summary

    summary = bag_summary(path)
    # A list of numbers may be as long as the bag.
    note = ', '.join(f'{key} {value if len(value) <= _LONGEST else value[:_LONGEST] + " ..."}'
                     for key, value in sorted(summary.note.items()))
    return [
        ('duration', f'{summary.duration / NANOSECONDS:,.1f} s from {stamp_text(summary.start)}'),
        ('note', note or 'none of l1slam: keyframes and covariances by the options of the node'),
        *(('topic', f'{topic.name}: {topic.count:,} of {topic.msgtype}')
          for topic in summary.topics)]


def numbers(record: GraphRecord) -> list[tuple[str, str]]:
    """Return what is worth knowing of a graph: names and values, without a judgement."""
    graph, ids = record.graph, record.ids
    factors = graph.between
    absolute = int(factors.is_absolute.sum())
    is_loop = ~factors.is_odometry & ~factors.is_absolute
    believed = record.believed
    parallel = int(is_loop[inspection.parallel_factors(graph)].sum())
    beside = f', {parallel:,} of them beside another edge' if parallel else ''
    left_out = left_out_words(record) != ''
    without = (_counted_out(is_loop & left_out & ~factors.struck, 'left out by the map'),
               _counted_out(is_loop & factors.struck, 'struck out'))
    length = inspection.step_lengths(graph).sum()
    rows = [
        ('poses', f'{graph.n_poses:,} in {graph.manifold.NAME}, ids {ids[0]} to {ids[-1]}'),
        ('odometry', f'{int(factors.is_odometry.sum()):,}, {length:,.1f} m'),
        ('loops', f'{int(is_loop.sum()):,}{beside}{"".join(without)}'),
        ('components', f'{len(connected_parts(believed)):,}')]
    landmarks = int(graph.is_landmark.sum())
    if landmarks:
        rows.insert(1, ('landmarks', f'{landmarks:,} of the poses; each edge to one is a loop'))
    names = robot_names(ids)
    if len(names) > 1:
        rows.insert(1, ('robots', f'{len(names)}: {", ".join(names)}'))
    if absolute:
        rows.insert(-1, ('absolute', f'{absolute:,}'))
    if record.log is not None and record.log.false is not None:
        between = is_loop & (graph.robot[factors.i] != graph.robot[factors.j])
        false = record.log.false
        rows.insert(-1, ('known false', f'{int((false & ~between).sum()):,} within a robot, '
                         f'{int((false & between).sum()):,} of {int(between.sum()):,} between '
                         'robots, as the file says'))
    if record.stamps is not None:
        rows.append(('time', f'{(record.stamps[-1] - record.stamps[0]) / NANOSECONDS:,.1f} s'))
    if record.poses is not None:
        cost = inspection.cost_at(believed, record.poses)
        some = WITHOUT if (left_out & ~factors.struck).any() else ''
        rows.append(('l1 cost', f'{cost:.6g} at the stored poses{some}'))
    return rows


def _counted_out(some: Mask, how: str) -> str:
    """Return a clause on how many loops of (m,) bool are out of the map, empty for none."""
    return f', {int(some.sum()):,} of them {how}' if some.any() else ''


def complaints(record: GraphRecord) -> list[str]:
    """Return a sentence on each thing that looks wrong with a graph but for what is left out."""
    believed = replace(record, graph=record.believed)
    given = replace(record, graph=record.graph.without_struck())
    checks: tuple[tuple[Callable[[GraphRecord], Iterator[str]], GraphRecord], ...] = (
        (_on_ids, given), (_on_parts, believed), (_on_gaps, given), (_on_repetitions, given),
        (_on_steps, given), (_on_noise, believed))
    return [sentence for check, of in checks for sentence in check(of)]


def _on_ids(record: GraphRecord) -> Iterator[str]:
    # A difference of two ids may be beyond 64 bits.
    same_robot = np.diff(robots_of(record.ids)) == 0
    jumps = np.flatnonzero((record.ids[1:] != record.ids[:-1] + 1) & same_robot)
    if len(jumps):
        pairs = [f'{record.ids[k]} to {record.ids[k + 1]}' for k in jumps[:_NAMED]]
        yield f'vertex ids are not consecutive: {_listed("jump", pairs, len(jumps))}'


def _on_parts(record: GraphRecord) -> Iterator[str]:
    parts = connected_parts(record.graph)
    if len(parts) == 1:
        return
    lonely = [part[0] for part in parts if len(part) == 1]
    joined = [part for part in parts if len(part) > 1]
    if lonely:
        names = [str(record.ids[k]) for k in lonely[:_NAMED]]
        yield (f'no edge leads to {_listed("vertex", names, len(lonely), "vertices")}: place '
               'unknown')
    if len(joined) > 1:
        joined.sort(key=len, reverse=True)
        names = [f'{len(part):,} vertices between ids {record.ids[part[0]]} and '
                 f'{record.ids[part[-1]]}' for part in joined[:_NAMED]]
        yield (f'the graph is not connected: {_listed("part", names, len(joined))}; nothing says '
               'where one lies from another')


def _on_gaps(record: GraphRecord) -> Iterator[str]:
    gaps = odometry_gaps(record.graph)
    gaps = gaps[np.diff(robots_of(record.ids))[gaps] == 0]
    # No odometry leads to a landmark; past those, to the next pose. What is seen but once may as
    # well be a pose whose odometry is missing.
    factors, n = record.graph.between, record.graph.n_poses
    edges = np.bincount(factors.pairs[~factors.is_absolute].ravel(), minlength=n)
    robots = np.flatnonzero(~record.graph.is_landmark | (edges < 2))
    gaps = np.intersect1d(gaps + 1, robots[1:])
    before = robots[np.searchsorted(robots, gaps) - 1]
    if len(gaps):
        pairs = [f'{record.ids[a]} and {record.ids[b]}'
                 for a, b in zip(before[:_NAMED], gaps[:_NAMED], strict=True)]
        yield (f'the odometry has {_listed("gap", pairs, len(gaps))}, consecutive vertices '
               'without an edge')


def _on_repetitions(record: GraphRecord) -> Iterator[str]:
    first = first_told(record.graph, inspection.parallel_factors(record.graph))
    repeated = np.flatnonzero(first != np.arange(len(first)))
    if len(repeated):
        yield (f'{_listed("edge", _edges(record, repeated), len(repeated))}: given before with '
               'the same measurement, so counted twice')


def _on_steps(record: GraphRecord) -> Iterator[str]:
    long = inspection.long_steps(record.graph)
    if len(long.factors):
        longest = np.argsort(-long.lengths)[:_NAMED]
        steps = [f'{length:.4g} m from {edge}' for length, edge in zip(
            long.lengths[longest], _edges(record, long.factors[longest]), strict=True)]
        yield (f'odometry that jumps: {_listed("step", steps, len(long.factors))}; nine in ten '
               f'are no longer than {long.ordinary:.4g} m')


def _on_noise(record: GraphRecord) -> Iterator[str]:
    # Any seed does: the draws stand for thousands of measurements.
    try:
        scales = inspection.noise_scales(record.graph, np.random.default_rng(0))
    except L1SlamError as error:
        yield f'the noise cannot be judged: {error}'
        return
    yield from _on_rotations(record, scales.turns)
    yield from offset_sentence(record.graph.manifold, scales.offset)
    # Of too few factors nothing can be said.
    both = {'odometry': scales.odometry, 'loops': scales.loops}
    found = {name: scale for name, scale in both.items() if not math.isnan(scale)}
    if all(1 / inspection.OFF_SCALE <= scale <= inspection.OFF_SCALE for scale in found.values()):
        return
    most = max(found.values())
    reason = 'too large, or some loops are false' if most > inspection.OFF_SCALE else 'too small'
    times = ' and '.join(f'{scale:.2g} ({name})' for name, scale in found.items())
    yield (f'errors at the L2 map of vertices {record.ids[scales.first]} to '
           f'{record.ids[scales.last]} are {times} times what the information says; expected '
           f'about 1: the information is {reason}')


def _on_rotations(record: GraphRecord, turns: float) -> Iterator[str]:
    """Say that rotation information is of what it was not read as: twice as large, or half."""
    as_read = record.rotation_information
    other, times = (ANGLE, 2.0) if as_read == QUATERNION else (QUATERNION, 0.5)
    if record.graph.manifold.TANGENT_SIZE == 6 and abs(math.log(times * turns)) < _FITS:
        yield (f'errors of rotations are {turns:.2g} times as large, beside those of '
               f'translations, as information of the {as_read} says: it looks like one of the '
               f'{other}; expected --rotation-information {other}')


def _edges(record: GraphRecord, factors: Indices) -> list[str]:
    """Return the vertex ids of the first few factors, in words."""
    pairs = record.ids[record.graph.between.pairs[factors[:_NAMED]]]
    return [f'{i} to {j}' if i != j else f'the world to {j}' for i, j in pairs.tolist()]


def _listed(name: str, examples: list[str], count: int, plural: str = '') -> str:
    """Return e.g. `2 gaps (3 and 4, 8 and 9)`; of many, the first few and dots."""
    dots = ', ...' if count > len(examples) else ''
    return f'{counted(count, name, plural)} ({", ".join(examples)}{dots})'
