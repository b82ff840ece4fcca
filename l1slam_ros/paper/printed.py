# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What the paper printed of its experiments; nothing here was measured by this package.

Source: J. J. Casafranca, L. M. Paz and P. Pinies, "L1 Factor Graph SLAM: going beyond the L2
norm" (2013), Tables I and II; its times are of C++ on an Intel i7 at 2.9 GHz.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperGraph:
    """
    One graph of the paper.

    file : its name in a folder of datasets, empty for a world that the authors simulated and
    that is simulated here anew; poses, edges : its size; initial, final : L1 costs (Table I);
    seconds : per iteration of the angle, the translation and the global problem, and l2_seconds
    of g2o's L2, None where it did not finish (Table II).
    """

    name: str
    file: str
    poses: int
    edges: int
    initial: float
    final: float
    seconds: tuple[float, float, float]
    l2_seconds: float | None


MANHATTAN_3500 = PaperGraph('Manhattan3500', 'manhattan3500.g2o', 3500, 5598, 5940, 1319.53,
                            (0.0009, 0.002, 0.003), 0.016)
MANHATTAN_10K = PaperGraph('Manhattan10k', '', 10_000, 64_000, 5.2064e7, 30206.5,
                           (0.003, 0.0075, 0.011), 2.31)
INTEL = PaperGraph('Intel', 'intel.g2o', 943, 1837, 1513.17, 982.051,
                   (0.0003, 0.0006, 0.001), 0.0067)
CITY_10K = PaperGraph('City10k', 'city10000.g2o', 10_000, 20_687, 2.78513e6, 4021.95,
                      (0.003, 0.0076, 0.013), 0.12)
MANHATTAN_50K = PaperGraph('Manhattan50k', '', 50_000, 700_000, 7.14591e8, 117734,
                           (0.015, 0.033, 0.056), None)

GRAPHS = (MANHATTAN_3500, MANHATTAN_10K, INTEL, CITY_10K, MANHATTAN_50K)
FILES = tuple(graph.file for graph in GRAPHS if graph.file)
# By the word that asks for them: the worlds that are simulated anew.
WORLDS = {'all': (MANHATTAN_10K, MANHATTAN_50K), '10k': (MANHATTAN_10K,), 'none': ()}

# Figure 4: the graph whose start is noise; Algorithm 4 took so many linearisations, and so many
# iterations of each.
NOISY = INTEL
NOISY_OUTER, NOISY_INNER = 5, 500
# Figure 6: how many loops that measure nothing were put between far poses, by graph.
FALSE_LOOPS = {INTEL: 10, MANHATTAN_3500: 2}
