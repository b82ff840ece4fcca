# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The compiled loops of `search`: branch and bound over shifts and turns of a scan.

A scan's points are cells of a grid for each turn, (t, n, 2), at the lowest shift; shifts are so
many cells from there. Scores are sums of likelihoods over the points.
"""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

# The widest bounds are over so many shifts each way, a power of two: wider ones are sooner added
# up, and so loose that ten times as many squares must be looked into.
WIDTH = 8
# A search has at most so many squares each way; most have no more than `FEW`.
ACROSS = 32
FEW = 16


@loop('(u1[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], u2[:, :, ::1], i4[:, :, ::1])')
def add_widest_bounds(blocks, points, turns, start, sums, cells):
    """
    Add up bounds of the scores of all shifts, by squares of `WIDTH` shifts.

    blocks : see `Field.blocks`; points : (n, 2) of the scan, in cells; turns : (t, 2) cosine and
    sine of each; start : (2,) where the scan's (0, 0) lies at the lowest shift, in cells of the
    levels; sums : (t, a, w) of each turn and so many squares each way, w = `FEW` or `ACROSS`: of
    more than a nobody asks, but so many are added in one step of the processor; cells : (t, n, 2)
    takes those of the points
    """
    columns = blocks.shape[2]
    rows = blocks.shape[3]
    wide = np.uint64(sums.shape[2])
    for t in range(len(turns)):
        c, s = turns[t, 0], turns[t, 1]
        for k in range(len(points)):
            x, y = points[k, 0], points[k, 1]
            u = int(np.floor(c * x - s * y + start[0]))
            v = int(np.floor(s * x + c * y + start[1]))
            cells[t, k, 0], cells[t, k, 1] = u, v
            plane = blocks[u % WIDTH, v % WIDTH]
            first, left = u // WIDTH, np.uint64(min(max(v // WIDTH + ACROSS, 0), rows - ACROSS))
            for a in range(max(-first, 0), min(sums.shape[1], columns - first)):
                for b in range(wide):
                    sums[t, a, b] += plane[first + a, left + b]


@loop('(u1[:, :, ::1], i4[:, :, ::1], i8[:, ::1], i8, i8, f8[::1], i8[:, ::1])')
def branch_and_bound(levels, cells, nodes, most, least, excluded, stack):
    """
    Return the best shift of a scan over a likelihood grid for any of its turns.

    levels : see `Field.levels`; cells : see `add_widest_bounds`; nodes : (k, 4) turn, column, row,
    bound of the squares of shifts to look into, the best one first; most : the greatest shift
    each way; least : score to beat; excluded : (6,) turn, shift (2), how many turns and cells
    around it do not count, and after how many turns they begin anew; fewer than no turns: nothing
    is excluded; stack : (4 h, 5) for h levels, for the nodes that are still to be looked into:
    turn, column, row, bound, level

    Returns
    -------
    score, turn, column, row; turn -1: none beats `least`

    Source: Hess, Kohler, Rapp, Andor, "Real-time loop closure in 2D LIDAR SLAM", 2016,
    Algorithm 3.

    """
    top = len(levels) - 1
    best = least
    turn = -1
    column = 0
    row = 0
    for at in range(len(nodes)):
        if nodes[at, 3] <= best:
            break
        for k in range(4):
            stack[0, k] = nodes[at, k]
        stack[0, 4] = top
        depth = 1
        while depth > 0:
            depth -= 1
            if stack[depth, 3] <= best:
                continue
            if stack[depth, 4] > 0:
                depth = _branch(levels, cells, most, best, stack, depth)
            elif _counts(stack, depth, excluded):
                turn, column, row = stack[depth, 0], stack[depth, 1], stack[depth, 2]
                best = stack[depth, 3]
    return best, turn, column, row


@compiled
def _branch(levels, cells, most, best, stack, first):
    """Put the quarters of a node in its place on the stack, the best one on top; return depth."""
    t = stack[first, 0]
    x = stack[first, 1]
    y = stack[first, 2]
    level = stack[first, 4] - 1
    half, depth = 1 << level, first
    grid = levels[level]
    last_column, last_row = np.uint64(grid.shape[0] - 1), np.uint64(grid.shape[1] - 1)
    sums = (0, 0, 0, 0)
    for k in range(cells.shape[1]):
        u, v = cells[t, k, 0] + x, cells[t, k, 1] + y
        # Beyond the edge there is nothing, as on it; what is negative is far beyond, unsigned.
        a, b = min(np.uint64(u), last_column), min(np.uint64(u + half), last_column)
        c, d = min(np.uint64(v), last_row), min(np.uint64(v + half), last_row)
        sums = (sums[0] + grid[a, c], sums[1] + grid[a, d], sums[2] + grid[b, c],
                sums[3] + grid[b, d])
    for q in range(4):
        u, v = x + half * (q >> 1), y + half * (q & 1)
        if sums[q] <= best or u > most or v > most:
            continue
        place = depth
        while place > first and stack[place - 1, 3] > sums[q]:
            for k in range(5):
                stack[place, k] = stack[place - 1, k]
            place -= 1
        stack[place, 0], stack[place, 1], stack[place, 2] = t, u, v
        stack[place, 3], stack[place, 4] = sums[q], level
        depth += 1
    return depth


@compiled
def _counts(stack, at, excluded):
    """Tell whether a node is outside what is excluded."""
    turns = abs(stack[at, 0] - excluded[0])
    return (excluded[3] < 0 or min(turns, excluded[5] - turns) > excluded[3]
            or abs(stack[at, 1] - excluded[1]) > excluded[4]
            or abs(stack[at, 2] - excluded[2]) > excluded[4])
