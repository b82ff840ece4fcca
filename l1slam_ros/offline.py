# SPDX-License-Identifier: Apache-2.0
"""The core without ROS: any input file -> graph -> solution -> any output file."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.choice import AUTO, Choice, choose, minimise_by
from l1slam_ros.core.cholesky import cholesky_of
from l1slam_ros.core.errors import FileError, GraphError, InconsistentError
from l1slam_ros.core.graph import FactorGraph, component_labels
from l1slam_ros.core.growth import GrowthOptions
from l1slam_ros.core.initial import odometry_poses, tree_poses
from l1slam_ros.core.inspection import odometry_gaps
from l1slam_ros.core.l2 import LeastSquaresOptions, huber_cost, minimise_huber, minimise_l2
from l1slam_ros.core.linearise import whitened_residual
from l1slam_ros.core.manifold import Array, Indices
from l1slam_ros.core.metrics import absolute_trajectory_error
from l1slam_ros.core.optimality import l1_cost, l2_cost
from l1slam_ros.core.optimiser import OptimiserOptions, Report, Solution
from l1slam_ros.core.robust_map import RobustMap, minimise_robustly
from l1slam_ros.core.seed import seed_poses
from l1slam_ros.graph_from_bag import DEFAULT_TOPICS, Topics, graph_from_bag
from l1slam_ros.io.bag import BAG_SUFFIXES
from l1slam_ros.io.files import require_folder
from l1slam_ros.io.graph_bag import write_graph_bag
from l1slam_ros.io.graph_file import GraphRecord, read_graph_file, write_graph_file
from l1slam_ros.io.trajectory import invented_stamps, read_reference, write_tum

GRAPH_SUFFIXES = ('.g2o', '.graph')
# [ns] Stamps that far apart are of one pose: trajectory files print them as rounded floats.
_SAME_STAMP = 1_000_000
NORMS = ('l1', 'l2', 'huber')
STARTS = ('seed', 'file', 'odometry')


def read_input(
    path: Path, options: GrowthOptions | None = None, topics: Topics = DEFAULT_TOPICS
) -> GraphRecord:
    """
    Read a graph file or grow a graph from a bag.

    Parameters
    ----------
    path : .g2o, .graph, .mcap, .db3, .bag (ROS 1) or a rosbag2 directory
    options : what makes keyframes of a bag's messages; None: what the bag's note says, or the
        node's defaults
    topics : where in a bag to look

    Raises
    ------
    FileError : it cannot be read, or there is no graph in it.

    """
    if not path.exists():
        raise FileError(path, 'no such file or directory')
    if is_bag(path):
        return graph_from_bag(path, options, topics)
    if path.suffix in GRAPH_SUFFIXES:
        return read_graph_file(path)
    raise FileError(path, f'unknown kind of file; expected {", ".join(GRAPH_SUFFIXES)}, '
                    f'{", ".join(BAG_SUFFIXES)} or a rosbag2 directory')


def is_bag(path: Path) -> bool:
    """Tell whether an input is taken for a bag."""
    return path.is_dir() or path.suffix in BAG_SUFFIXES


def stored_poses(record: GraphRecord) -> Array:
    """
    Return the stored start, (n, p); where none is stored, the odometry chain.

    Where that has gaps, the poses along a breadth-first tree from the first keyframe.

    Raises
    ------
    GraphError : none is stored, and the graph is not connected.

    """
    if record.poses is not None:
        return record.poses
    require_connected(record)
    if len(odometry_gaps(record.graph)):
        return tree_poses(record.graph, 0)
    return odometry_poses(record.graph)


def with_poses(record: GraphRecord) -> GraphRecord:
    """Return the record with `stored_poses`; as it is where there are none to be had."""
    try:
        return replace(record, poses=stored_poses(record))
    except GraphError:
        return record


@dataclass(frozen=True)
class Wish:
    """
    How a graph is to be solved.

    start : of `STARTS`; norm : of `NORMS`; solver : of `choice.SOLVERS`, for L1; robust : refuse
    loops that cannot be believed.
    """

    start: str = 'seed'
    norm: str = 'l1'
    solver: str = AUTO
    robust: bool = False
    options: OptimiserOptions = OptimiserOptions()
    least_squares: LeastSquaresOptions = LeastSquaresOptions()


@dataclass(frozen=True)
class Outcome:
    """
    What `solve` did; costs are of the norm that was asked for, seed_cost None without one.

    solver : what found the solution, by its name; reason : a clause that says why it; judgement :
    of a robust solve, whose costs count the accepted factors.
    """

    solution: Solution
    solver: str
    reason: str
    initial_cost: float
    seed_cost: float | None
    seconds: float
    judgement: RobustMap | None = None


def solve(record: GraphRecord, wish: Wish, report: Report) -> Outcome:
    """
    Solve a graph; seconds: solving alone.

    Raises
    ------
    GraphError : the graph is not connected, has no such start, or numbers beyond all measure.
    InconsistentError : see `robust_solve`.

    """
    require_start(record, wish)
    graph, judgement, seed = record.graph, None, None
    initial = odometry_poses(graph) if wish.start == 'odometry' else stored_poses(record)
    minimiser = _Minimiser(wish, report)
    began = time.perf_counter()
    if wish.robust:
        judgement = _robust_map(record, minimiser)
        solution, seed = judgement.solution, judgement.seed
        graph = graph.subset(judgement.accepted)
    else:
        choice = minimiser.choose(graph)
        seed = seed_poses(graph, choice.cholesky) if wish.start == 'seed' else None
        solution = minimiser.minimise_by(choice, graph, initial if seed is None else seed)
    seconds = time.perf_counter() - began
    cost = cost_function(graph, wish)
    seed_cost = None if seed is None else cost(seed)
    if not np.isfinite([cost(initial), seed_cost or 0.0, solution.cost]).all():
        raise GraphError('the cost leaves double precision: measurements and information of the '
                         'graph are too large, or too different from each other')
    return Outcome(solution, minimiser.solver, minimiser.reason, cost(initial), seed_cost, seconds,
                   judgement)


class _Minimiser:
    """Minimises the norm that was wished for; solver, reason : what did it last, and why."""

    def __init__(self, wish: Wish, report: Report):
        self._wish, self._report = wish, report
        self.solver = self.reason = ''

    def choose(self, graph: FactorGraph) -> Choice:
        """Return what the graph is solved by."""
        if self._wish.norm == 'l1':
            return choose(self._wish.solver, graph)
        return Choice(cholesky_of(graph), 'gauss-newton', f'the norm is {self._wish.norm}')

    def minimise(self, graph: FactorGraph, poses: Array) -> Solution:
        """Return the solution from poses (n, p)."""
        return self.minimise_by(self.choose(graph), graph, poses)

    def minimise_by(self, choice: Choice, graph: FactorGraph, poses: Array) -> Solution:
        """Return the solution by what was chosen."""
        wish, self.solver, self.reason = self._wish, choice.solver, choice.reason
        if wish.norm == 'l1':
            solution, self.solver = minimise_by(choice, graph, poses, wish.options, self._report)
            if self.solver != choice.solver:
                self.reason = f'the {choice.solver} method did not converge'
            return solution
        assert choice.cholesky is not None
        minimise_norm = minimise_l2 if wish.norm == 'l2' else minimise_huber
        return minimise_norm(graph, poses, wish.least_squares, choice.cholesky, self._report)


def _robust_map(record: GraphRecord, minimiser: _Minimiser) -> RobustMap:
    try:
        return minimise_robustly(record.graph, minimiser.minimise)
    except InconsistentError as error:
        first, last = record.ids[[error.first, error.last]].tolist()
        raise InconsistentError(error.loops, first, last) from None


def cost_function(graph: FactorGraph, wish: Wish) -> Callable[[Array], float]:
    """Return what is to be minimised, as a function of the poses."""
    size, delta = graph.manifold.TANGENT_SIZE, wish.least_squares.huber_delta
    of_residual: dict[str, Callable[[Array], float]] = {
        'l1': l1_cost,
        'l2': l2_cost,
        'huber': lambda r: huber_cost(r, size, delta),
    }
    return lambda poses: of_residual[wish.norm](whitened_residual(graph, poses))


def require_start(record: GraphRecord, wish: Wish) -> None:
    """
    Refuse, before any work is done, a graph that cannot be solved as wished.

    Raises
    ------
    GraphError : the graph is not connected, or has no such start.

    """
    require_connected(record)
    if wish.start == 'file' and record.poses is None:
        raise GraphError('the input stores no poses to start from; expected --start seed or '
                         'odometry')
    gaps = odometry_gaps(record.graph)
    if len(gaps) and (wish.start == 'odometry' or wish.robust):
        remedy = 'expected a graph without gaps' if wish.robust else 'expected --start seed'
        raise GraphError(f'no edge between the consecutive vertices {record.ids[gaps[0]]} and '
                         f'{record.ids[gaps[0] + 1]}, so no chain of odometry to start from; '
                         f'{remedy}')


def require_connected(record: GraphRecord) -> None:
    """
    Refuse a graph of several parts.

    Raises
    ------
    GraphError : naming a vertex of the loose part.

    """
    labels = component_labels(record.graph)
    loose = np.flatnonzero(labels != labels[0])
    if len(loose):
        others = f' and {len(loose) - 1} more have' if len(loose) > 1 else ' has'
        raise GraphError(f'the graph is not connected: vertex {record.ids[loose[0]]}{others} no '
                         f'path to vertex {record.ids[0]}; `l1slam info` lists the parts')


def matching_rows(record: GraphRecord, reference_path: Path) -> tuple[Indices, Array]:
    """
    Return which keyframes (k,) a reference file has poses of, and these poses (k, p).

    Raises
    ------
    FileError : the reference cannot be read, or shares fewer than two poses.

    """
    reference = read_reference(reference_path, record.graph.manifold)
    keys = stamps_of(record) if reference.stamped else record.ids
    after = np.clip(np.searchsorted(reference.keys, keys), 1, len(reference.keys) - 1)
    nearer_before = keys - reference.keys[after - 1] <= reference.keys[after] - keys
    nearest = np.where(nearer_before, after - 1, after)
    apart = np.abs(reference.keys[nearest] - keys)
    ours = np.flatnonzero(apart <= (_SAME_STAMP if reference.stamped else 0))
    theirs = nearest[ours]
    if len(ours) < 2:
        raise FileError(reference_path, f'shares {len(ours)} poses with the graph, '
                        'expected 2 or more')
    return ours, reference.poses[theirs]


def position_error(record: GraphRecord, poses: Array, rows: Indices, reference: Array) -> float:
    """Return the RMSE of the positions [m] after rigid alignment; rows as of `matching_rows`."""
    positions = record.graph.manifold.positions
    return absolute_trajectory_error(positions(poses)[rows], positions(reference))


def stamps_of(record: GraphRecord) -> Indices:
    """Return the stamps of the keyframes, (n,) [ns], invented where the input has none."""
    return record.stamps if record.stamps is not None else invented_stamps(record.graph.n_poses)


def check_output(path: Path) -> None:
    """Refuse, before any work is done, an output whose suffix names no format."""
    if path.suffix not in (*GRAPH_SUFFIXES, '.tum', ''):
        raise FileError(path, f'unknown suffix; expected {", ".join(GRAPH_SUFFIXES)}, .tum, or '
                        'none for a bag directory')
    require_folder(path)


def check_graph_output(path: Path) -> None:
    """Refuse, as `check_output`, an output that does not hold a graph."""
    check_output(path)
    if path.suffix == '.tum':
        raise FileError(path, 'a trajectory has no edges; expected '
                        f'{", ".join(GRAPH_SUFFIXES)}, or no suffix for a bag directory')


def write_output(path: Path, record: GraphRecord) -> None:
    """
    Write a graph with its poses, in the format that the suffix names; none: a bag.

    Raises
    ------
    FileError : an unknown suffix, or the file cannot be written.
    GraphError : the format has no place for a part of the graph.

    """
    check_output(path)
    if path.suffix in GRAPH_SUFFIXES:
        write_graph_file(path, record)
    elif path.suffix == '.tum':
        write_tum(path, stamps_of(record), stored_poses(record), record.graph.manifold)
    else:
        write_graph_bag(path, record)
