# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
One cell of the suite: a graph with lies, fed pose by pose, in a process of its own.

In: a folder of datasets, and what to measure. Out: `Row`, the cost of the updates, ours and
ISAM2's, and what the map was at checkpoints; that is worked out after the run.
"""

import multiprocessing
import resource
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from measuring import report_progress
from robust.cases import FalseCase, false_case
from robust.kinds import BICOCCA, CITY, INTEL, KINDS, LIES, MANHATTAN
from robust.places import Place, error_by_time, place, place_of
from robust.runs import within
from updates.in_space import SPACES
from updates.isam2 import isam2

from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.geometry.noise import Mask
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.batch_map import SolveOptions, solve
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.solve import AUTO, choose, minimise_by
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.paper.updates import Drive, Kept, first_of, run_updates

CHECKPOINTS = 20
# Simulated: keyframes and edges of the paper's Manhattan10k, and of a large sparse world.
WORLDS = {'world10k': (10_000, 64_000), 'world50k': (50_000, 80_000)}
GRAPHS = (INTEL, MANHATTAN, BICOCCA, CITY, *WORLDS, *SPACES)
CLEAN, RECORDED = 'clean', 'recorded'
# Of all loops that are false, by graph and kind, where it is not the usual share.
_SHARES = {(MANHATTAN, 'grouped'): (0.3, 0.5)}
_USUAL = (0.3,)
# Everything is called on so many keyframes before it is timed.
_WARM_UP = 200
# [s] A cell that takes more of the processor is given up.
_PATIENCE = 7200.0


@dataclass(frozen=True)
class Cell:
    """
    What is measured: a graph, a kind of lies, their share of all loops, so many first keyframes.

    poses : 0 for all; rate : keyframes per second; robust : loops are doubted.
    """

    graph: str
    kind: str
    share: float
    poses: int = 0
    rate: float = 200.0
    robust: bool = True


@dataclass(frozen=True)
class Row:
    """
    What came of a cell.

    commit : of the package; n, edges : of the graph; reached : keyframes per second; ours, peer :
    of `spread`; beside : ours, of the updates that the peer had time for, `peer_poses`; behind :
    [s] of our other threads; memory : the most that our process held then [MiB].

    At the checkpoints, after `keyframes` (c,), and last a second after the end: excess over the
    L1 optimum of what is believed [%]; position error [m] of the map, of the L1 map of all true
    loops so far, of the odometry; false loops that are believed, true ones that are not. false,
    true : loops in all; batch : error of the batch map [m]; differs : loops that only one of
    batch and running back end believes in the end.
    """

    cell: Cell
    commit: str
    n: int
    edges: int
    reached: float
    ours: dict[str, float]
    behind: float
    memory: float
    keyframes: list[int]
    peer: dict[str, float] | None = None
    peer_poses: int = 0
    beside: dict[str, float] | None = None
    excess: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    clean: list[float] = field(default_factory=list)
    odometry: list[float] = field(default_factory=list)
    kept: list[int] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    false: int = 0
    true: int = 0
    batch: float = 0.0
    differs: int = 0

    @staticmethod
    def of(fields: dict[str, Any]) -> 'Row':
        """Return the row that was recorded."""
        return Row(**fields | {'cell': Cell(**fields['cell'])})


def cells(graph: str, kinds: tuple[str, ...], shares: tuple[float, ...], **how: Any) -> list[Cell]:
    """Return the cells of a graph; shares : () for the usual ones; how : the rest of a cell."""
    found = []
    for kind in (RECORDED,) if graph == BICOCCA else (CLEAN, *LIES):
        if kind in kinds:
            of_kind = (shares or _SHARES.get((graph, kind), _USUAL)) if kind in LIES else (0.0,)
            found += [Cell(graph, kind, share, **how) for share in of_kind]
    return found


def commit() -> str:
    """Return the last commit of the package, with a plus where the checkout differs from it."""
    folder = Path(__file__).resolve().parents[2] / 'l1slam_ros'

    def git(*words: str) -> str:
        return subprocess.run(['git', *words, '--', folder], cwd=folder, check=True, text=True,
                              capture_output=True).stdout.strip()

    return git('log', '-1', '--format=%h') + '+' * bool(git('status', '--porcelain'))


def is_done(row: Row, cell: Cell, peer: bool, now: str) -> bool:
    """Tell whether a row is of a cell and of this commit; peer : it has to have one."""
    return (row.cell == cell and row.commit == now and not now.endswith('+')
            and (row.peer is not None or not peer))


def measure(datasets: Path, cell: Cell, patience: float) -> Row | None:
    """
    Return what comes of a cell, None: it took too long.

    patience : [s] of the peer's updates, 0: without it
    """
    report_progress(f'{cell.graph} {cell.kind} {cell.share:.0%}, '
                    f'{cell.poses or "all"} keyframes')
    return within(_PATIENCE, lambda: _measured(datasets, cell, patience))


def _place(datasets: Path, cell: Cell) -> Place:
    if cell.graph in WORLDS:
        world = simulate_world(*WORLDS[cell.graph], WorldOptions(), np.random.default_rng(0))
        found = place_of(cell.graph, world.graph, None, error_by_time(world.truth[:, :2]))
    elif cell.graph in SPACES:
        graph, truth = SPACES[cell.graph](datasets)
        found = place_of(cell.graph, graph, None, error_by_time(truth[:, :3]))
    else:
        found = place(datasets, cell.graph)
    if not 0 < cell.poses < found.graph.n_poses:
        return found
    rows = _rows(found.graph, cell.poses)
    return replace(found, graph=prefix(found.graph, cell.poses), stored=None,
                   is_false=found.is_false[rows], is_true=found.is_true[rows])


def _measured(datasets: Path, cell: Cell, patience: float) -> Row:
    beside = isam2(lambda: _case(datasets, cell).clean, patience) if patience else nullcontext()
    with _played(datasets, cell) as drives, beside as peer:
        run_updates(next(drives), None, 1e6, 1, cell.robust)
        drive = next(drives)
        Path('/proc/self/clear_refs').write_text('5')
        found = run_updates(drive, peer, cell.rate, CHECKPOINTS, cell.robust)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # Only now is a graph made in this process: its memory is that of the back end.
    case = _case(datasets, cell)
    n = case.graph.n_poses
    row = Row(cell, commit(), n, len(case.graph.between), n / found.elapsed,
              spread(found.ours), found.behind, memory,
              [now.graph.n_poses for now in found.on_the_way])
    if found.peer:
        row = replace(row, peer=spread(found.peer), peer_poses=len(found.peer),
                      beside=spread(found.ours[:len(found.peer)]))
    return _judged(row, case, [*found.on_the_way, found.at_rest])


def _case(datasets: Path, cell: Cell) -> FalseCase:
    kind = next(kind for kind in KINDS if kind.name == cell.kind and
                (kind.suite == 'recorded') == (cell.kind == RECORDED))
    return false_case(_place(datasets, cell), kind, cell.share, 0)


@contextmanager
def _played(datasets: Path, cell: Cell) -> Iterator[Iterator[Drive]]:
    """Give the drives, first a short one to warm up, of a cell that another process makes."""
    context = multiprocessing.get_context('fork')
    here, there = context.Pipe(duplex=False)
    player = context.Process(target=_play, args=(there, datasets, cell))
    player.start()
    there.close()
    yield (Drive(*here.recv(), iter(here.recv, None)) for _ in range(2))
    player.join()


def _play(there: Connection, datasets: Path, cell: Cell) -> None:
    graph = _case(datasets, cell).graph
    for part in prefix(graph, min(_WARM_UP, graph.n_poses)), graph:
        drive = Drive.of(part)
        there.send((drive.keyframes, drive.dimension))
        for message in drive.messages:
            there.send(message)
        there.send(None)


def _judged(row: Row, case: FalseCase, maps: list[Kept]) -> Row:
    """Return the row with what the maps were worth."""
    place = case.place
    positions = case.graph.manifold.positions
    error = place.truth_error or error_by_time(positions(place.best))
    counts = [held(now, case) for now in maps]
    batch = solve(case.graph, None, SolveOptions(robust=row.cell.robust))
    believed = (np.ones(len(case.graph.between), bool) if batch.judgement is None else
                batch.judgement.accepted)
    optima = [_optimum(prefix(case.clean, now.graph.n_poses), place.best[:now.graph.n_poses])
              for now in maps[:-1]]
    clean = [error(positions(poses)) for poses in optima]
    return replace(
        row, excess=[excess(now) for now in maps],
        error=[error(positions(now.poses)) for now in maps], clean=[*clean, clean[-1]],
        odometry=[error(positions(case.start[:now.graph.n_poses])) for now in maps],
        kept=[kept for kept, _ in counts], lost=[lost for _, lost in counts],
        false=int(case.is_false.sum()), true=int(case.is_true.sum()),
        batch=error(positions(batch.solution.poses)),
        differs=len(_believed(case.graph, believed)
                    ^ _believed(maps[-1].graph, maps[-1].accepted)))


def _optimum(graph: FactorGraph, poses: Array) -> Array:
    """Return the L1 map of a graph from poses (n, p)."""
    return minimise_by(choose(AUTO, graph), graph, poses, OptimiserOptions())[0].poses


def excess(now: Kept) -> float:
    """Return by how much [%] the cost is above the L1 optimum of what is believed."""
    part = now.graph.subset(now.accepted)
    cost, best = (l1_cost(whitened_residual(part, poses))
                  for poses in (now.poses, _optimum(part, now.poses)))
    return 100 * (cost / best - 1) if best > 1e-6 else 0.0


def held(now: Kept, case: FalseCase) -> tuple[int, int]:
    """Return how many false loops are believed, and how many true ones are not."""
    here, all_pairs = (_pairs(graph, case.graph.n_poses) for graph in (now.graph, case.graph))
    false, true = (np.isin(here, all_pairs[rows]) & ~now.graph.between.is_odometry
                   for rows in (case.is_false, case.is_true))
    accepted = now.accepted
    return int((false & accepted).sum()), int((true & ~false & ~accepted).sum())


def _believed(graph: FactorGraph, accepted: Mask) -> set[int]:
    return set(_pairs(graph, graph.n_poses)[accepted & ~graph.between.is_odometry].tolist())


def _pairs(graph: FactorGraph, n: int) -> Indices:
    return pair_key(graph.between.i, graph.between.j, n)


def _rows(graph: FactorGraph, poses: int) -> Indices:
    return np.flatnonzero(np.maximum(graph.between.i, graph.between.j) < poses)


def prefix(graph: FactorGraph, poses: int) -> FactorGraph:
    """Return the graph of the first keyframes."""
    return first_of(graph, poses, _rows(graph, poses))


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """Return what updates cost: [ms], `second` and `last` the p95 of a quarter; total [s]."""
    ms = 1e3 * np.array(seconds)
    _, second, _, last = np.array_split(ms, 4)
    return {'median': float(np.median(ms)), 'p95': float(np.percentile(ms, 95)),
            'p99': float(np.percentile(ms, 99)), 'max': float(ms.max()),
            'second': float(np.percentile(second, 95)), 'last': float(np.percentile(last, 95)),
            'total': float(ms.sum() / 1e3)}
