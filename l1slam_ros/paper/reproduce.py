# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: runs the paper's experiments and writes the report, its pictures beside."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.linear_system import whitened_residual
from l1slam_ros.core.graph.parts import require_connected
from l1slam_ros.core.solvers.block_cholesky import cholesky_of
from l1slam_ros.core.solvers.gauss_newton import LeastSquaresOptions
from l1slam_ros.core.solvers.nonlinear import OptimiserOptions
from l1slam_ros.core.solvers.optimality import l1_cost
from l1slam_ros.core.solvers.seed import seed_poses
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world
from l1slam_ros.io import formats
from l1slam_ros.io.files import new_folder_beside, put_lines, reported, require_folder
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.ours import REPORT_MARK, refuse_others
from l1slam_ros.io.progress import Progress, say
from l1slam_ros.paper import figures, report
from l1slam_ros.paper import printed as paper
from l1slam_ros.paper.experiments import Effort, measure_costs, measure_seconds
from l1slam_ros.paper.printed import PaperGraph
from l1slam_ros.paper.report import WORLD_SEED, GraphResult, Study

REPORT = 'report.md'


def reproduce(datasets: Path | None, worlds: Sequence[PaperGraph], output: Path,
              effort: Effort, force: bool = False) -> None:
    """
    Run the experiments and write the report into the folder `output`, whole or not at all.

    Parameters
    ----------
    datasets : the folder with the paper's own graphs; None: without them
    worlds : which of the paper's simulated worlds to make anew, in their sizes
    output : its other files stay as they are
    effort : how long the experiments run
    force : whether to replace files of these names that others wrote

    Raises
    ------
    FileError : no graph of the paper in the folder, one that cannot be used, or no place to write.
    OptionError : nothing to run.

    """
    if not datasets and not worlds:
        raise OptionError('nothing to run: no datasets and no worlds; expected --datasets DIR, '
                          'or --worlds other than none')
    _check_folder(output, force)
    records = read_datasets(datasets) if datasets else {}
    study = Study(measured(records, worlds, effort), effort)
    with _filling(output) as folder:
        lines = report.head(study)
        for title, section in SECTIONS.items():
            say(title)
            lines += ['', f'## {title}', '', *section(study, folder)]
        put_lines(folder / REPORT, [REPORT_MARK, *lines])


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


def measured(records: dict[str, GraphRecord], worlds: Sequence[PaperGraph],
             effort: Effort) -> dict[str, GraphResult]:
    """Return what is measured of every graph, in the order of the paper, by name."""
    simulated = {world.name: world for world in worlds}
    found = {}
    for graph in paper.GRAPHS:
        if graph.name in records:
            record = records[graph.name]
            found[graph.name] = _measured(graph, record.graph, formats.stored_poses(record),
                                          effort)
        elif graph.name in simulated:
            size = simulated[graph.name]
            world = simulate_world(size.poses, size.edges, WorldOptions(),
                                   np.random.default_rng(WORLD_SEED))
            truth_cost = l1_cost(whitened_residual(world.graph, world.truth))
            found[graph.name] = _measured(graph, world.graph, world.odometry, effort, truth_cost)
    return found


def _measured(printed: PaperGraph, graph: FactorGraph, start: Array, effort: Effort,
              truth_cost: float | None = None) -> GraphResult:
    say(printed.name)
    seed = seed_poses(graph, cholesky_of(graph))
    steps = OptimiserOptions().outer_iterations + effort.outer + LeastSquaresOptions().iterations
    with Progress(steps, 'step') as progress:
        costs = measure_costs(graph, start, seed, effort, progress.report)
    return GraphResult(printed, graph, start, seed, costs, measure_seconds(graph, seed, effort),
                       truth_cost)


# Title -> what runs the section's experiment, draws into a folder and returns the lines.
SECTIONS: dict[str, Callable[[Study, Path], list[str]]] = {
    'Table I: the cost': report.table_1,
    'Table II: the time per iteration': report.table_2,
    'Figure 2: cost against iterations': figures.figure_2,
    'Figure 3: the maps': figures.figure_3,
    'Figure 4: a start that is mostly noise': figures.figure_4,
    'Figure 5: the time per update': figures.figure_5,
    'Figure 6: loops that lie': figures.figure_6,
    'Left for later: L-infinity': report.future_work}


def _check_folder(output: Path, force: bool) -> None:
    """Refuse, before any work is done, a place where no folder can be."""
    require_folder(output)
    if os.path.lexists(output) and not output.is_dir():
        raise FileError(output, 'is no folder; expected one, or nothing there')
    if output.exists():
        require_folder(output / REPORT)
        refuse_others([output / REPORT, *sorted(output.glob('figure_*.png'))], force=force)


@contextmanager
def _filling(output: Path) -> Iterator[Path]:
    """Yield a new folder, whose files go into the folder `output` when the block succeeds."""
    with reported(output), new_folder_beside(output) as made:
        yield made
        output.mkdir(exist_ok=True)
        # The report last: it names the others.
        for file in sorted(made.iterdir(), key=lambda file: file.name == REPORT):
            os.replace(file, output / file.name)
