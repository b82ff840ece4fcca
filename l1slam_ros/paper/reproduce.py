# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: runs the paper's experiments and writes the report, its pictures beside."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.robust.inspection import require_connected
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io import formats
from l1slam_ros.io.compilation import STEPS, compile_now
from l1slam_ros.io.files import new_folder_beside, put_lines, reported, require_folder
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.plot import MapDrawing
from l1slam_ros.io.progress import Progress
from l1slam_ros.paper import figures, report
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import (
    Costs,
    Effort,
    measure_convergence,
    measure_costs,
    measure_largest,
    measure_seconds,
)
from l1slam_ros.paper.printed import PaperGraph
from l1slam_ros.paper.report import WORLD_SEED, GraphResult, Results
from l1slam_ros.paper.runs import (
    NOISES,
    LoopRuns,
    StartRuns,
    run_false_loops,
    run_noisy_starts,
)
from l1slam_ros.paper.updates import Growth, measure_growth

REPORT = 'report.md'


def reproduce(datasets: Path | None, worlds: Sequence[PaperGraph], output: Path,
              effort: Effort) -> None:
    """
    Run the experiments and write the report into the folder `output`, whole or not at all.

    Parameters
    ----------
    datasets : the folder with the paper's own graphs; None: without them
    worlds : which of the paper's simulated worlds to make anew, in their sizes
    output : its other files stay as they are
    effort : how long the experiments run

    Raises
    ------
    FileError : no graph of the paper in the folder, one that cannot be used, or no place to write.
    OptionError : nothing to run.

    """
    if not datasets and not worlds:
        raise OptionError('nothing to run: no datasets and no worlds; expected --datasets DIR, '
                          'or --worlds other than none')
    _check_folder(output)
    records = read_datasets(datasets) if datasets else {}
    compile_now(STEPS)
    results = run(records, worlds, effort)
    with _filling(output) as folder:
        lines = report.head(results)
        for title, section in SECTIONS.items():
            lines += ['', f'## {title}', '', *section(results, folder)]
        put_lines(folder / REPORT, lines)


def read_datasets(datasets: Path) -> dict[str, GraphRecord]:
    """
    Return name in the paper -> graph, for those of the paper's graphs that are in the folder.

    Raises
    ------
    FileError : none is there, or one cannot be used.

    """
    files = {graph.name: datasets / graph.file for graph in paper.GRAPHS
             if graph.file and (datasets / graph.file).is_file()}
    if not files:
        raise FileError(datasets, "none of the paper's graphs is there; expected "
                        + ', '.join(paper.FILES))
    return {name: _read(path) for name, path in files.items()}


def _read(path: Path) -> GraphRecord:
    record = formats.read_input(path)
    with formats.named(path):
        require_connected(record.graph, record.ids)
    return record


def run(records: dict[str, GraphRecord], worlds: Sequence[PaperGraph], effort: Effort) -> Results:
    """Measure every graph, in the order of the paper; records as of `read_datasets`."""
    simulated = {world.name: world for world in worlds}
    graphs, convergence, missing = [], {}, []
    for graph in paper.GRAPHS:
        if graph.name in records:
            _say(graph.name)
            graphs.append(_run_record(graph, records[graph.name], effort))
        elif graph.name in simulated:
            _say(graph.name)
            result, curves = _run_world(simulated[graph.name], effort)
            graphs.append(result)
            convergence.update(curves)
        else:
            missing.append(graph)
    return Results(graphs, missing, convergence, _run_starts(records, effort),
                   _run_growth(effort), _run_false_loops(records, effort),
                   _run_largest(records, effort))


def _say(work: str) -> None:
    print(f'l1slam: {work}', file=sys.stderr)


def _run_starts(records: dict[str, GraphRecord], effort: Effort) -> StartRuns | None:
    record = records.get(paper.NOISY.name)
    if record is None:
        return None
    _say(f'{paper.NOISY.name} from noisy starts')
    as_in_paper = replace(effort, outer=paper.NOISY_OUTER, inner=paper.NOISY_INNER)
    with Progress(len(NOISES) * effort.draws, 'start') as progress:
        return run_noisy_starts(record.graph, formats.stored_poses(record), effort, as_in_paper,
                                np.random.default_rng(WORLD_SEED), progress.advance)


def _run_growth(effort: Effort) -> Growth | None:
    if not effort.keyframes:
        return None
    _say('a world, pose by pose')
    with Progress(effort.keyframes, 'keyframe') as progress:
        return measure_growth(effort.keyframes, effort.rate, np.random.default_rng(WORLD_SEED),
                              progress.advance)


def _run_false_loops(records: dict[str, GraphRecord], effort: Effort) -> dict[str, LoopRuns]:
    runs = {}
    for graph, count in paper.FALSE_LOOPS.items():
        record = records.get(graph.name)
        if record is None:
            continue
        _say(f'{graph.name} with false loops')
        with formats.named(graph.file), Progress(1 + effort.draws, 'draw') as progress:
            runs[graph.name] = run_false_loops(
                record.graph, formats.stored_poses(record), count, effort,
                np.random.default_rng(WORLD_SEED), progress.advance)
    return runs


def _run_largest(records: dict[str, GraphRecord], effort: Effort) -> dict[str, Array]:
    record = records.get(paper.NOISY.name)
    if record is None:
        return {}
    _say(f'{paper.NOISY.name} in L-infinity')
    return measure_largest(record.graph, formats.stored_poses(record), effort)


def _run_record(graph: PaperGraph, record: GraphRecord, effort: Effort) -> GraphResult:
    seed = seed_poses(record.graph, cholesky_of(record.graph))
    return _measured(graph, record.graph, formats.stored_poses(record), seed, effort)


def _run_world(graph: PaperGraph,
               effort: Effort) -> tuple[GraphResult, dict[str, dict[str, Array]]]:
    """Return what a world of the graph's size gives, with the curves if they are shown of it."""
    world = simulate_world(graph.poses, graph.edges, WorldOptions(),
                           np.random.default_rng(WORLD_SEED))
    seed = seed_poses(world.graph, cholesky_of(world.graph))
    truth_cost = l1_cost(whitened_residual(world.graph, world.truth))
    result = _measured(graph, world.graph, world.odometry, seed, effort, truth_cost)
    if graph.name != paper.MANHATTAN_10K.name:
        return result, {}
    curves = measure_convergence(world.graph, world.odometry, seed, effort.iterations)
    return result, {**curves, 'global': _global_curves(result.costs)}


def _measured(paper_graph: PaperGraph, graph: FactorGraph, start: Array, seed: Array,
              effort: Effort, truth_cost: float | None = None) -> GraphResult:
    steps = (OptimiserOptions().outer_iterations + effort.outer + LeastSquaresOptions().iterations)
    with Progress(steps, 'step') as progress:
        costs = measure_costs(graph, start, seed, effort, progress.report)
    seconds = measure_seconds(graph, seed, effort)
    return GraphResult(paper_graph, graph.n_poses, len(graph.between), costs, seconds,
                       _map(paper_graph, graph, costs), truth_cost)


def _map(paper_graph: PaperGraph, graph: FactorGraph, costs: Costs) -> MapDrawing:
    factors, solution = graph.between, costs.solution
    loops = factors.pairs[~factors.is_odometry]
    return MapDrawing(paper_graph.name, graph.manifold.positions(solution.poses), loops=loops,
                      note=f'L1 cost {solution.cost:.6g}')


def _global_curves(costs: Costs) -> dict[str, Array]:
    histories = {'as printed': costs.printed, f'ours, {costs.solver}': costs.solution.history}
    return {method: np.stack((np.arange(len(history)), history), axis=1)
            for method, history in histories.items()}


# Title -> what draws the section's pictures into a folder and returns its lines.
SECTIONS: dict[str, Callable[[Results, Path], list[str]]] = {
    'Table I: the cost': lambda results, _: report.table_1(results),
    'Table II: the time per iteration': lambda results, _: report.table_2(results),
    'Figure 2: cost against iterations': figures.figure_2, 'Figure 3: the maps': figures.figure_3,
    'Figure 4: a start that is mostly noise': figures.figure_4,
    'Figure 5: the time per update': figures.figure_5,
    'Figure 6: loops that lie': figures.figure_6,
    'Left for later: L-infinity': lambda results, _: report.future_work(results)}


def _check_folder(output: Path) -> None:
    """Refuse, before any work is done, a place where no folder can be."""
    require_folder(output)
    if os.path.lexists(output) and not output.is_dir():
        raise FileError(output, 'is no folder; expected one, or nothing there')
    if output.exists():
        require_folder(output / REPORT)


@contextmanager
def _filling(output: Path) -> Iterator[Path]:
    """Yield a new folder, whose files go into the folder `output` when the block succeeds."""
    with reported(output), new_folder_beside(output) as made:
        yield made
        output.mkdir(exist_ok=True)
        # The report last: it names the others.
        for file in sorted(made.iterdir(), key=lambda file: file.name == REPORT):
            os.replace(file, output / file.name)
