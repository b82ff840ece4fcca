# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Noise stated 1e-4 to 1e4 times what it is, of the odometry or of the loops: what is believed then.

    python benchmarks/misstated.py GRAPH... [--share .5] [--seed 0]

To each GRAPH random false loops are added, that share of all. Printed is, for each part and times,
how many of these are kept, how many of its own loops are lost, and whether the map is doubtful; a
judgement that fails is doubtful, too.
"""

import argparse
from pathlib import Path

import numpy as np

from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.spanning_tree import pair_key
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.worlds.false_loops import insert_loops, random_false_loops
from l1slam_ros.io.formats import stored_poses
from l1slam_ros.io.graphs.graph_file import GraphRecord, read_graph_file

# Standard deviations as stated, in units of what the file says.
TIMES = (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4)


def spoiled(record: GraphRecord, share: float, seed: int) -> tuple[FactorGraph, np.ndarray]:
    """Return the graph with false loops, and which factors these are, (m,) bool."""
    graph, n = record.graph, record.graph.n_poses
    count = round(np.count_nonzero(~graph.between.is_odometry) * share / (1 - share))
    lies = random_false_loops(graph, stored_poses(record), count, np.random.default_rng(seed))
    bad = insert_loops(graph, lies)
    return bad, np.isin(pair_key(bad.between.i, bad.between.j, n), pair_key(lies.i, lies.j, n))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('graphs', type=Path, nargs='+', metavar='GRAPH')
    parser.add_argument('--share', type=float, default=0.5)
    parser.add_argument('--seed', type=int, default=0)
    asked = parser.parse_args()
    print('| graph | part | stated | kept | lost | doubtful |\n|---|---|---|---|---|---|')
    for path in asked.graphs:
        bad, is_false = spoiled(read_graph_file(path), asked.share, asked.seed)
        odometry = bad.between.is_odometry
        true = np.count_nonzero(~odometry & ~is_false)
        for part, rows in (('odometry', odometry), ('loops', ~odometry)):
            for times in TIMES:
                found, _ = robust_solve(bad.subset(
                    np.arange(len(rows)), np.where(rows, times**2, 1.0)))
                kept = np.count_nonzero(found.accepted & is_false)
                lost = np.count_nonzero(~found.accepted & ~is_false & ~odometry)
                doubt = found.doubt.kind if found.doubt else ''
                print(f'| {path.stem} | {part} | {times:g} | {kept}/{is_false.sum()} | '
                      f'{lost}/{true} | {doubt} |', flush=True)


if __name__ == '__main__':
    main()
