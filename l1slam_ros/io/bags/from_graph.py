# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Writing a graph as the messages of a bag, from which exactly the same graph is read again.

    /odom            one nav_msgs/Odometry per keyframe: the odometry factors, chained
    /loop_closures   one geometry_msgs/PoseWithCovarianceStamped per other factor;
                     /trusted_loop_closures for those that are never doubted,
                     and again /false_loop_closures for those that are struck out
                     /rejected_loop_closures for those that the map does not use
    /absolute_poses  the same per absolute factor
    /ground_truth    geometry_msgs/PoseStamped, if the truth is known
    /scan            sensor_msgs/LaserScan, if a laser was simulated

Covariances are those of the factors, in the axes of the measured pose; that of an odometry message
is of the motion since the message before. A component that is not measured has an infinite
variance. Messages have the later pose seen from the earlier one: factors in the other direction
are inverted, and the note in the bag says which.

The note also names the factors that the map does not use, see `left_out`. Such loops have a topic
of their own, which only this program reads. Odometry that slipped and absolute poses stay on their
topics: a bag needs the odometry of every keyframe.
"""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import noise, se3
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph, turned
from l1slam_ros.core.graph.measurements import (
    FASTEST,
    LONGEST_PAUSE,
    SHORTEST_STEP,
    LoopClosure,
)
from l1slam_ros.core.graph.parts import odometry_gaps
from l1slam_ros.core.graph.recording import loops_of, recorded, steps_of
from l1slam_ros.io.bags.topics import (
    ABSOLUTE_TOPIC,
    FALSE_LOOP_TOPIC,
    LOOP_TOPIC,
    ODOMETRY_TOPIC,
    REJECTED_LOOP_TOPIC,
    SCAN_TOPIC,
    SCAN_TYPE,
    TRUSTED_LOOP_TOPIC,
    TRUTH_TOPIC,
)
from l1slam_ros.io.bags.writer import new_bag
from l1slam_ros.io.files import LAST_STAMP
from l1slam_ros.io.graphs.graph_file import GraphRecord, left_out_words
from l1slam_ros.io.graphs.left_out import REJECTED, SLIP, SUSPECT
from l1slam_ros.io.messages.conversion import reference_frame_id
from l1slam_ros.io.messages.serialisation import odometry_bytes, pose_bytes, scan_bytes

if TYPE_CHECKING:  # it takes the compiled core along
    from l1slam_ros.core.scans.points import Scan

# What `reader.read_note` returns for a graph.
GRAPH_NOTE = {'keyframes': 'every', 'covariance': 'increment'}
# In addition, if a reader would take some messages for errors: see `_note`.
VERBATIM_NOTE = {'messages': 'verbatim'}
# In addition, for poses in space.
SPACE_NOTE = {'dimension': '3'}
# In addition, the numbers of the factors that were inverted.
TURNED_STEPS, TURNED_LOOPS = 'turned_steps', 'turned_loops'
# In addition, the numbers, counted in the same way, of factors that the map does not use.
LEFT_OUT = {SLIP: 'slips', REJECTED: 'rejected_loops', SUSPECT: 'suspect_loops'}

_REFUSED = (REJECTED, SUSPECT)
_BASE_FRAME = 'base_link'
_ODOMETRY, _TRUTH = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped'
_LOOP = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def write_graph_bag(path: str | os.PathLike[str], record: GraphRecord,
                    truth: Array | None = None, scans: 'Sequence[Scan]' = ()) -> None:
    """
    Write a graph as the messages that a robot would have sent.

    Parameters
    ----------
    path : the bag's directory; a bag already there is replaced once the new one is complete
    record : its stamps, or invented ones; its stored poses and vertex ids have no place in a bag
    truth : (n, p) poses in the map frame, or None
    scans : of a laser at the robot's origin, one for each keyframe with its stamp, or none

    Raises
    ------
    GraphError : the graph has a part that messages cannot express exactly.
    FileError : the bag cannot be written, or something that is no bag is in its place.

    """
    stamps, backward = _stamps(record), _backward(record)
    _require_sayable(record)
    if truth is not None and len(truth) != len(stamps):
        raise GraphError(f'{len(truth)} true poses; expected {len(stamps)}, one for each vertex')
    graph = turned(record.graph, backward)
    factors, to_pose3 = graph.between, graph.manifold.to_pose3
    topics = {LOOP_TOPIC: True, ABSOLUTE_TOPIC: factors.is_absolute.any(),
              TRUSTED_LOOP_TOPIC: (factors.trusted & ~factors.is_odometry).any(),
              FALSE_LOOP_TOPIC: factors.struck.any()}
    words = left_out_words(record)
    topics[REJECTED_LOOP_TOPIC] = (np.isin(words, _REFUSED) & ~factors.is_absolute).any()
    note = _note(graph, stamps) | _turned_note(graph, backward) | _left_out_note(graph, words)
    in_order = iter(words[loops_of(graph)].tolist())
    # A simulated drive is recorded as a real one is: no two messages at one time.
    with new_bag(path, note, apart=truth is not None) as writer:
        writer.add_topic(ODOMETRY_TOPIC, _ODOMETRY)
        for topic in sorted(topic for topic, used in topics.items() if used):
            writer.add_topic(topic, _LOOP)
        if truth is not None:
            writer.add_topic(TRUTH_TOPIC, _TRUTH)
            true = to_pose3(truth)
        if scans:
            writer.add_topic(SCAN_TOPIC, SCAN_TYPE)
        for k, (sample, loops) in enumerate(recorded(graph, stamps)):
            stamp = sample.stamp
            writer.write(ODOMETRY_TOPIC, stamp, odometry_bytes(
                'odom', _BASE_FRAME, stamp, sample.pose3, sample.covariance))
            if truth is not None:
                writer.write(TRUTH_TOPIC, stamp, pose_bytes('map', stamp, true[k]))
            if scans:
                writer.write(SCAN_TOPIC, stamp, scan_bytes(_BASE_FRAME, scans[k]))
            for loop in loops:
                topic, frame = ABSOLUTE_TOPIC, 'map'
                # The loop itself was the message before.
                word = '' if loop.struck else next(in_order)
                if loop.reference_stamp is not None:
                    topic = _topic(loop, word)
                    frame = reference_frame_id(_BASE_FRAME, loop.reference_stamp)
                writer.write(topic, stamp, pose_bytes(frame, stamp, loop.pose3, loop.covariance))


def _topic(loop: LoopClosure, word: str) -> str:
    """Return the topic of a loop; word : why the map does not use it, or empty."""
    return (FALSE_LOOP_TOPIC if loop.struck else REJECTED_LOOP_TOPIC if word in _REFUSED else
            TRUSTED_LOOP_TOPIC if loop.trusted else LOOP_TOPIC)


def _note(graph: FactorGraph, stamps: list[int]) -> dict[str, str]:
    """
    Return the note on a graph that goes into the metadata of its bag.

    A graph may have equal loops, longer steps than robots take, years between its keyframes, and
    unusual variances. The note then says that each message is to be taken as it is.
    """
    factors = graph.between
    steps = steps_of(graph)
    loops = loops_of(graph)
    equal = np.concatenate((factors.pairs[loops], factors.measurement[loops]), axis=1)
    seconds = np.diff(stamps) * 1e-9
    manifold = graph.manifold
    metres, _ = manifold.motion(
        manifold.local(manifold.identity(len(steps)), factors.measurement[steps]))
    variances = np.where(factors.speaks, np.diagonal(
        noise.covariance_of(factors.sqrt_information), axis1=1, axis2=2), 1.0)
    meant = (len(np.unique(equal, axis=0)) < len(equal) or (seconds > LONGEST_PAUSE).any()
             or (metres > FASTEST * np.maximum(seconds, SHORTEST_STEP)).any()
             or variances.min(initial=1.0) < noise.LEAST_VARIANCE
             or variances[steps].max(initial=1.0) > noise.MOST_OF_ODOMETRY
             or variances.max(initial=1.0) > noise.MOST_VARIANCE)
    return (GRAPH_NOTE | (VERBATIM_NOTE if meant else {})
            | (SPACE_NOTE if manifold is se3 else {}))


def _require_sayable(record: GraphRecord) -> None:
    """Refuse a graph that messages cannot express exactly."""
    factors, ids = record.graph.between, record.ids
    rows, gaps = np.flatnonzero(factors.is_odometry), odometry_gaps(record.graph)
    if len(gaps):
        k = gaps[0]
        raise GraphError(f'no edge between the consecutive vertices {ids[k]} and {ids[k + 1]}; '
                         'a bag needs the odometry of every vertex')
    unsaid = np.minimum(factors.i, factors.j)[rows[~factors.speaks[rows].all(axis=1)]]
    if len(unsaid):
        raise GraphError(f'the odometry from vertex {ids[unsaid[0]]} does not measure all '
                         'components; a bag has no place for that')
    told = factors.j[factors.is_absolute & (factors.trusted | factors.struck)]
    if len(told):
        raise GraphError(f'the absolute pose of vertex {ids[told[0]]} is trusted or struck out; '
                         'a bag has no place for that')


def _backward(record: GraphRecord) -> Mask:
    """Return which factors lead from a later keyframe to an earlier one, (m,) bool."""
    factors, ids = record.graph.between, record.ids
    backward: Mask = factors.i > factors.j
    unsaid = np.flatnonzero(backward & ~factors.speaks.all(axis=1))
    if len(unsaid):
        i, j = ids[factors.pairs[unsaid[0]]]
        raise GraphError(f'the edge from vertex {i} back to {j} does not measure all components; '
                         'a bag has no place for that, as its edges lead from earlier to later')
    return backward


def _turned_note(graph: FactorGraph, backward: Mask) -> dict[str, str]:
    """Return the numbers of the odometry steps and loops that were inverted, for the note."""
    rows = {TURNED_STEPS: steps_of(graph), TURNED_LOOPS: loops_of(graph)}
    return {name: ' '.join(map(str, np.flatnonzero(backward[of]).tolist()))
            for name, of in rows.items() if backward[of].any()}


def _left_out_note(graph: FactorGraph, words: np.ndarray) -> dict[str, str]:
    """Return the numbers of the odometry steps and loops that are left out, for the note."""
    return {name: ' '.join(map(str, np.flatnonzero(said).tolist()))
            for word, name in LEFT_OUT.items()
            if (said := words[(steps_of if word == SLIP else loops_of)(graph)] == word).any()}


def _stamps(record: GraphRecord) -> list[int]:
    """Return the stamps [ns]; raise unless each is after the one before."""
    stamps = record.times
    if not len(stamps):
        raise GraphError('the graph has no vertices; expected one or more')
    bad = np.flatnonzero(np.diff(stamps, prepend=0) <= 0)
    if len(bad) or stamps[-1] > LAST_STAMP:
        k = bad[0] if len(bad) else -1
        raise GraphError(f'vertex {record.ids[k]} has the stamp {stamps[k]} ns; expected one '
                         'after 0, after that of the vertex before, and before the year 2038')
    return stamps.tolist()
