# SPDX-License-Identifier: Apache-2.0
"""Solving with the factor that `cholesky` left in the panels, forwards and backwards."""

import numpy as np

from l1slam_ros.core.kernels.compiled import compiled, loop


@loop('(f8[::1], i4[::1], i8[::1], i4[::1], i8[::1], i4[::1], f8[:, ::1])')
def solve(panels, first, start, pattern, offset, position, right):
    """Return the solution of L L' x = right; both (n, k) in the order of the keyframes."""
    k = right.shape[1]
    x = np.empty_like(right)
    for f in range(len(right)):
        for a in range(k):
            x[position[f], a] = right[f, a]
    tallest = 0
    for s in range(len(first) - 1):
        tallest = max(tallest, start[s + 1] - start[s])
    local = np.empty(tallest * k)
    for s in range(len(first) - 1):
        _forward(panels[offset[s]:offset[s + 1]], pattern[start[s]:start[s + 1]],
                 first[s], first[s + 1] - first[s], x, local)
    for s in range(len(first) - 2, -1, -1):
        _backward(panels[offset[s]:offset[s + 1]], pattern[start[s]:start[s + 1]],
                  first[s], first[s + 1] - first[s], x, local)
    solution = np.empty_like(x)
    for f in range(len(right)):
        for a in range(k):
            solution[f, a] = x[position[f], a]
    return solution


@compiled
def _forward(panel, rows, first, columns, x, local):
    """Solve for the supernode's own rows, and subtract what they do to the rows below."""
    d = x.shape[1]
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
    for k in range(columns, len(rows)):
        for a in range(d):
            total = 0.0
            for c in range(width):
                total += panel[at + c] * local[c]
            x[rows[k], a] -= total
            at += width


@compiled
def _backward(panel, rows, first, columns, x, local):
    """Solve with the transpose for the supernode's own rows, once all below are known."""
    d = x.shape[1]
    width = columns * d
    for k in range(columns):
        for a in range(d):
            local[k * d + a] = x[first + k, a]
    at = width * width
    for k in range(columns, len(rows)):
        for a in range(d):
            value = x[rows[k], a]
            for c in range(width):
                local[c] -= panel[at + c] * value
            at += width
    for r in range(width - 1, -1, -1):
        local[r] /= panel[r * width + r]
        for c in range(r):
            local[c] -= panel[r * width + c] * local[r]
    for k in range(columns):
        for a in range(d):
            x[first + k, a] = local[k * d + a]
