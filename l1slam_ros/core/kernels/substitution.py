# SPDX-License-Identifier: Apache-2.0
"""Solving with the factor that `cholesky` left in the panels, forwards and backwards."""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop

_TAKES = 'f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i4[::1], f8[:, ::1]'


@loop(f'({_TAKES}, UniTuple(i8, 3))', f'({_TAKES}, f8[::1])')
def solve(panels, first, start, pattern, offset, position, right, size):
    """Return the solution of L L' x = right; both (n, k) in the order of the keyframes."""
    x = np.empty_like(right)
    for k in range(len(right)):
        for a in range(len(size)):
            x[position[k], a] = right[k, a]
    tallest = 0
    for s in range(len(first) - 1):
        tallest = max(tallest, start[s + 1] - start[s])
    local = np.empty(tallest * len(size))
    for s in range(len(first) - 1):
        _forward(panels[offset[s]:offset[s + 1]], pattern[start[s]:start[s + 1]],
                 first[s], first[s + 1] - first[s], x, local, size)
    for s in range(len(first) - 2, -1, -1):
        _backward(panels[offset[s]:offset[s + 1]], pattern[start[s]:start[s + 1]],
                  first[s], first[s + 1] - first[s], x, local, size)
    solution = np.empty_like(x)
    for k in range(len(right)):
        for a in range(len(size)):
            solution[k, a] = x[position[k], a]
    return solution


@compiled
def _forward(panel, rows, first, columns, x, local, size):
    """Solve for the supernode's own rows, and subtract what they do to the rows below."""
    d = len(size)
    width = columns * d
    at = 0
    for k in range(columns):
        for a in range(d):
            total = x[first + k, a]
            for c in range(k * d + a):
                total -= panel[at + c] * local[c]
            local[k * d + a] = total / panel[at + k * d + a]
            x[first + k, a] = local[k * d + a]
            at += width
    below = panel[at:]
    for k in range(len(rows) - columns):
        row = rows[columns + k]
        for a in range(d):
            line = below[(k * d + a) * width:(k * d + a + 1) * width]
            total = 0.0
            if columns == 1:
                for c in range(d):
                    total += line[c] * local[c]
            else:
                for c in range(width):
                    total += line[c] * local[c]
            x[row, a] -= total


@compiled
def _backward(panel, rows, first, columns, x, local, size):
    """Solve with the transpose for the supernode's own rows, once all below are known."""
    d = len(size)
    width = columns * d
    for k in range(columns):
        for a in range(d):
            local[k * d + a] = x[first + k, a]
    below = panel[width * width:]
    for k in range(len(rows) - columns):
        row = rows[columns + k]
        for a in range(d):
            line = below[(k * d + a) * width:(k * d + a + 1) * width]
            value = x[row, a]
            if columns == 1:
                for c in range(d):
                    local[c] -= line[c] * value
            else:
                for c in range(width):
                    local[c] -= line[c] * value
    for r in range(width - 1, -1, -1):
        local[r] /= panel[r * width + r]
        for c in range(r):
            local[c] -= panel[r * width + c] * local[r]
    for k in range(columns):
        for a in range(d):
            x[first + k, a] = local[k * d + a]
