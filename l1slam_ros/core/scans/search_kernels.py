# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The compiled loops of `search`: branch and bound over shifts and turns of a scan."""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(f4[:, :, ::1], i8[::1], i8[:, :, ::1], i8[::1], i8[::1])')
def widest_nodes(levels, margin, cells, lowest, highest):
    """
    Return where a search begins: the nodes of the highest level, and bounds of their scores.

    levels : (h + 1, a, b) the likelihood, pooled over 1, 2, 4, ... cells; margin : (2,) cells of
    the grid before cell (0, 0) of the shifts; cells : (t, n, 2) cells of the points for each turn,
    unshifted; lowest, highest : (2,) of the shifts, inclusive

    Returns
    -------
    nodes (k, 3): turn, column, row of each, and bounds (k,), the best one first

    """
    height = len(levels) - 1
    width = 1 << height
    across = (highest[0] - lowest[0]) // width + 1
    along = (highest[1] - lowest[1]) // width + 1
    nodes = np.empty((len(cells) * across * along, 3), np.int64)
    scores = np.empty(len(nodes))
    count = 0
    for t in range(len(cells)):
        for x in range(lowest[0], highest[0] + 1, width):
            for y in range(lowest[1], highest[1] + 1, width):
                nodes[count, 0], nodes[count, 1], nodes[count, 2] = t, x, y
                scores[count] = _score(levels[height], margin, cells[t], x, y)
                count += 1
    order = np.argsort(-scores)
    return nodes[order], scores[order]


@loop('(f4[:, :, ::1], i8[::1], i8[:, :, ::1], i8[:, ::1], f8[::1], i8[::1], f8, f8[::1])')
def branch_and_bound(levels, margin, cells, nodes, scores, highest, least, excluded):
    """
    Return the best shift of a scan over a likelihood grid for any of its turns.

    levels, margin, cells, highest, nodes, scores : see `widest_nodes`; least : score to beat;
    excluded : (6,) turn, shift (2), how many turns and cells around it do not count, and after how
    many turns they begin anew; fewer than no turns: nothing is excluded

    Returns
    -------
    score, turn, column, row; turn -1: none beats `least`

    Source: Hess, Kohler, Rapp, Andor, "Real-time loop closure in 2D LIDAR SLAM", 2016,
    Algorithm 3.

    """
    height = len(levels) - 1
    best, found = least, np.array([-1, 0, 0])
    stack = np.empty((4 * height + 4, 4), np.int64)
    bounds = np.empty(4 * height + 4)
    for at in range(len(nodes)):
        if scores[at] <= best:
            break
        stack[0, :3] = nodes[at]
        stack[0, 3], bounds[0] = height, scores[at]
        depth = 1
        while depth > 0:
            depth -= 1
            if bounds[depth] <= best:
                continue
            if stack[depth, 3] > 0:
                depth = _branch(levels, margin, cells, highest, best, stack, bounds, depth)
            elif _counts(stack[depth], excluded):
                best = bounds[depth]
                found[:] = stack[depth, :3]
    return best, found[0], found[1], found[2]


@compiled
def _branch(levels, margin, cells, highest, best, stack, bounds, depth):
    """Put the quarters of a node in its place on the stack, the best one on top; return depth."""
    t, x, y, level = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3] - 1
    half, first = 1 << level, depth
    for dx in (0, half):
        for dy in (0, half):
            if x + dx > highest[0] or y + dy > highest[1]:
                continue
            score = _score(levels[level], margin, cells[t], x + dx, y + dy)
            if score <= best:
                continue
            place = depth
            while place > first and bounds[place - 1] > score:
                bounds[place] = bounds[place - 1]
                stack[place] = stack[place - 1]
                place -= 1
            bounds[place] = score
            stack[place, 0], stack[place, 1] = t, x + dx
            stack[place, 2], stack[place, 3] = y + dy, level
            depth += 1
    return depth


@compiled
def _counts(node, excluded):
    """Tell whether a node is outside what is excluded."""
    turns = abs(node[0] - excluded[0])
    return (excluded[3] < 0 or min(turns, excluded[5] - turns) > excluded[3]
            or abs(node[1] - excluded[1]) > excluded[4]
            or abs(node[2] - excluded[2]) > excluded[4])


@compiled
def _score(likelihood, margin, cells, x, y):
    total = 0.0
    for k in range(len(cells)):
        column, row = cells[k, 0] + x + margin[0], cells[k, 1] + y + margin[1]
        if 0 <= column < likelihood.shape[0] and 0 <= row < likelihood.shape[1]:
            total += likelihood[column, row]
    return total / len(cells)
