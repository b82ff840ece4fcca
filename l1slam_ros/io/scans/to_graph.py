# SPDX-License-Identifier: Apache-2.0
"""
Scans -> a graph: the front end finds odometry and loops, the judgement says where it is.

In: scans in order, each with the robot's pose by the wheels. Out: the graph, to be judged and
solved as any other. The same scans make the same graph: nothing here goes by the clock.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.errors import GraphError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.geometry.noise import root_of_inverse
from l1slam_ros.core.graph.factor_graph import FactorGraph, component_labels
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.robust.innovation import sample_posterior
from l1slam_ros.core.scans.front_end import FrontEndOptions, ScanFrontEnd
from l1slam_ros.core.scans.odometry import Step
from l1slam_ros.core.scans.points import Mount, Points, Scan
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.io.files import counted
from l1slam_ros.io.graphs.graph_file import GraphRecord

# The map is made anew for each loop while there are few, later for so much more of them.
_MORE_LOOPS = 0.1


@dataclass(frozen=True)
class ScanMap:
    """The graph that scans make, and what each of its keyframes saw."""

    record: GraphRecord
    points: list[Points]


def map_scans(scans: Iterable[tuple[Scan, Array]], mount: Mount,
              report: Callable[[int, int], None] = lambda scans, loops: None,
              options: FrontEndOptions = FrontEndOptions()) -> ScanMap:  # noqa: B008
    """
    Return the graph that scans make, and the points of its keyframes.

    Parameters
    ----------
    scans : each with the robot's pose by the wheels at its stamp, (3,); stamps rise
    mount : where the laser is on the robot
    report : told how many scans and loops there were, with each keyframe
    options : of the front end

    """
    front_end = ScanFrontEnd(options, mount)
    graph, mapped, loops, said = FactorGraph(se2), 0, 0, list[str]()
    for count, (scan, wheels) in enumerate(scans, 1):
        step = front_end.add(scan, wheels)
        if step.said:
            said.append(step.said)
        if step.keyframe is None:
            continue
        _append(graph, front_end, step)
        for loop in front_end.loops():
            loops += 1
            graph.append_between(
                np.array([loop.i]), np.array([loop.j]), loop.measurement[None],
                root_of_inverse(loop.covariance[None]))
        if loops > (1 + _MORE_LOOPS) * mapped:
            mapped = loops
            front_end.place(*_mapped(graph))
        report(count, loops)
    stamps = np.array([keyframe.stamp for keyframe in front_end.keyframes], np.int64)
    sentences = [f'{sentence} ({counted(said.count(sentence), "time")})'
                 for sentence in dict.fromkeys(said)]
    return ScanMap(GraphRecord(graph, None, np.arange(graph.n_poses), stamps, tuple(sentences)),
                   [keyframe.points for keyframe in front_end.keyframes])


def _append(graph: FactorGraph, front_end: ScanFrontEnd, step: Step) -> None:
    """Append the newest keyframe, and its odometry where it goes on from the one before."""
    keyframes = front_end.keyframes
    if len(keyframes) < 2 or keyframes[-1].part != keyframes[-2].part:
        graph.add_poses(1)
        return
    motion = se2.between(keyframes[-2].pose[None], keyframes[-1].pose[None])
    graph.append_step(motion, root_of_inverse(step.covariance[None]))


def _mapped(graph: FactorGraph) -> tuple[Array, Array]:
    """Return the map, and how certain it is; see `ScanFrontEnd.place`."""
    judgement, poses = robust_solve(graph)
    part = judgement.believed(graph)
    unknown = np.full((len(poses), 2), np.inf)
    if component_labels(part).max() > 0:
        return poses, unknown
    try:
        samples = sample_posterior(part, poses, cholesky_of(part)).samples[:-1]
    except GraphError:
        return poses, unknown
    scale = float(np.sqrt(judgement.found_variance(graph).max()))
    steps = scale * np.concatenate((np.zeros_like(samples[:1]), samples))
    steps[:, :2] = se2.rotation(poses) @ steps[:, :2]
    square = ((steps - steps[-1:]) ** 2).mean(axis=2)
    return poses, np.sqrt(np.column_stack((square[:, :2].sum(axis=1), square[:, 2])))
