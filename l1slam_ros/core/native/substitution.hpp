// SPDX-License-Identifier: Apache-2.0
// Solving with the factor that `cholesky` left in the panels, forwards and backwards.
// Rows of a panel are taken three at a time, so that what is read of the solution serves all
// three. Most panels of a sparse graph are one keyframe wide: those are taken block by block, by
// loops whose bounds are known when they are compiled.
#pragma once
#include <vector>

#include "arrays.hpp"
#include "lanes.hpp"
#include "panels.hpp"

namespace substitution {

// Panels of no more block columns are taken one such column after the other.
constexpr int THIN = 4;

template <int K> constexpr int LANES = K == 3 ? 4 : 8;

template <int K>
INLINE void forward_block(const double* panel, int64_t stride, const int32_t* rows, int64_t count,
                          double* x) {
    double own[K], *to = x + int64_t(rows[0]) * K;
    for (int r = 0; r < K; r++) {
        double value = to[r];
        for (int c = 0; c < r; c++) value -= panel[stride * r + c] * own[c];
        to[r] = own[r] = value / panel[stride * r + r];
    }
    const double* row = panel + stride * K;
    for (int64_t k = 1; k < count; k++) {
        to = x + int64_t(rows[k]) * K;
        for (int r = 0; r < K; r++, row += stride) {
            double value = to[r];
            for (int c = 0; c < K; c++) value -= row[c] * own[c];
            to[r] = value;
        }
    }
}

template <int K>
INLINE void backward_block(const double* panel, int64_t stride, const int32_t* rows, int64_t count,
                           double* x) {
    using L = Lanes<LANES<K>>;
    L total = L::zero();
    const double* row = panel + stride * K;
    for (int64_t k = 1; k < count; k++) {
        const double* below = x + int64_t(rows[k]) * K;
        for (int r = 0; r < K; r++, row += stride) total.add(below[r], L::load(row, K));
    }
    double own[K], *to = x + int64_t(rows[0]) * K;
    for (int r = 0; r < K; r++) own[r] = to[r] - total[r];
    for (int r = K - 1; r >= 0; r--) {
        row = panel + stride * r;
        own[r] /= row[r];
        for (int c = 0; c < r; c++) own[c] -= row[c] * own[r];
        to[r] = own[r];
    }
}

// Solve for a supernode's own rows, and subtract what they do to the rows below.
inline void forward(const double* panel, int64_t stride, int64_t width, const int64_t* place,
                    int64_t height, double* own, double* x) {
    for (int64_t r = 0; r < width; r++) {
        const double* row = panel + r * stride;
        double total = 0.0;
        for (int64_t c = 0; c < r; c++) total += row[c] * own[c];
        own[r] = (own[r] - total) / row[r];
    }
    int64_t r = width;
    for (; r + 3 <= height; r += 3) {
        const double *a = panel + r * stride, *b = a + stride, *c = b + stride;
        double x0 = 0.0, x1 = 0.0, x2 = 0.0;
        for (int64_t k = 0; k < width; k++)
            x0 += a[k] * own[k], x1 += b[k] * own[k], x2 += c[k] * own[k];
        x[place[r]] -= x0, x[place[r + 1]] -= x1, x[place[r + 2]] -= x2;
    }
    for (; r < height; r++)
        for (int64_t k = 0; k < width; k++) x[place[r]] -= panel[r * stride + k] * own[k];
}

inline void backward(const double* panel, int64_t stride, int64_t width, const int64_t* place,
                     int64_t height, double* own, const double* x) {
    int64_t r = width;
    for (; r + 3 <= height; r += 3) {
        const double *a = panel + r * stride, *b = a + stride, *c = b + stride;
        double x0 = x[place[r]], x1 = x[place[r + 1]], x2 = x[place[r + 2]];
        for (int64_t k = 0; k < width; k++) own[k] -= a[k] * x0 + b[k] * x1 + c[k] * x2;
    }
    for (; r < height; r++)
        for (int64_t k = 0; k < width; k++) own[k] -= panel[r * stride + k] * x[place[r]];
    for (r = width - 1; r >= 0; r--) {
        const double* row = panel + r * stride;
        own[r] /= row[r];
        for (int64_t c = 0; c < r; c++) own[c] -= row[c] * own[r];
    }
}

// K : rows of a block, 0: any number of them. x : in the order of elimination.
template <int K>
void solve_sized(const double* panels, const Panels& shape, double* x) {
    const int64_t k = K ? K : shape.k;
    std::vector<int64_t> place(shape.tallest() * k);
    auto take = [&](int64_t s, bool backwards) {
        const int64_t width = shape.columns(s), rows = shape.rows(s), stride = shape.stride[s];
        const double* panel = panels + shape.offset[s];
        const int32_t* row = &shape.pattern[shape.start[s]];
        if constexpr (K > 0)
            if (width <= THIN) {
                for (int64_t at = 0; at < width; at++) {
                    const int64_t c = backwards ? width - 1 - at : at;
                    auto step = backwards ? backward_block<K> : forward_block<K>;
                    step(panel + c * K * (stride + 1), stride, row + c, rows - c, x);
                }
                return;
            }
        for (int64_t r = 0; r < rows; r++)
            for (int64_t a = 0; a < k; a++) place[r * k + a] = row[r] * k + a;
        double* own = x + shape.first[s] * k;
        if (backwards) backward(panel, stride, width * k, place.data(), rows * k, own, x);
        else forward(panel, stride, width * k, place.data(), rows * k, own, x);
    };
    for (int64_t s = 0; s < shape.count(); s++) take(s, false);
    for (int64_t s = shape.count() - 1; s >= 0; s--) take(s, true);
}

// The solution of L L' x = right; both (n, k) in the order of the keyframes; position : (n,) of
// each keyframe in the order of elimination.
inline Matrix<double> solve(Vector<const double> panels, PANELS_ARGUMENTS,
                            Vector<const int32_t> position, Matrix<const double> right) {
    const int64_t n = right.shape[0], k = right.shape[1];
    const Panels shape(panels.size(), first, start, pattern, offset, stride, k);
    check_positions(shape, position);
    require(n == position.size(), "right must have a row for each position");
    auto solution = new_array<double, 2>({n, k});
    std::vector<double> x(n * k);
    for (int64_t f = 0; f < n; f++)
        for (int64_t a = 0; a < k; a++) x[position[f] * k + a] = right(f, a);
    auto solve = k == 3 ? solve_sized<3> : k == 6 ? solve_sized<6> : solve_sized<0>;
    solve(panels.data, shape, x.data());
    for (int64_t f = 0; f < n; f++)
        for (int64_t a = 0; a < k; a++) solution(f, a) = x[position[f] * k + a];
    return solution;
}

static PyMethodDef methods[] = {
    BY_SIZE(solve, "panels, " PANELS_NAMES ", position, right"),
    {}};

}  // namespace substitution
