// SPDX-License-Identifier: Apache-2.0
// Supernodal Cholesky of a sparse matrix of d x d blocks, left-looking, in register tiles.
// Panels are dense, row after row: entry (r, c) of panel s is panels[offset[s] + r stride[s] + c].
#pragma once
#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

#include "arrays.hpp"
#include "lanes.hpp"

namespace cholesky {

// A pivot that is left with less than this part of its diagonal entry is rounding.
constexpr double SINGULAR = 1e-13;
// Rows and columns of a tile: as many sums as registers hold.
constexpr int ROWS = WIDTH == 8 ? 12 : WIDTH == 4 ? 6 : 3, WIDE = WIDTH == 2 ? 4 : 8;
constexpr int NARROW = WIDTH == 2 ? 2 : 4;
// Rows of a block in the plane, and most columns of a source that is subtracted block by block.
constexpr int PLANE = 3, THIN = 12;

// Subtract products of R rows (of `inner` numbers) with packed columns (inner, N).
template <int R, int N>
INLINE void subtract_rows(const double* left, int64_t stride, const double* right, int64_t inner,
                          double* panels, const int64_t* place, int64_t column, int columns) {
    Lanes<N> sums[R];
    UNROLL for (int r = 0; r < R; r++) sums[r] = Lanes<N>::zero();
    for (int64_t q = 0; q < inner; q++) {
        auto factor = Lanes<N>::load(right + N * q);
        UNROLL for (int r = 0; r < R; r++) sums[r].add(left[r * stride + q], factor);
    }
    UNROLL for (int r = 0; r < R; r++) {
        double* to = panels + place[r] + column;
        (Lanes<N>::load(to, columns) - sums[r]).store(to, columns);
    }
}

template <int N>
void subtract_tiles(const double* left, int64_t stride, int64_t rows, const double* right,
                    int64_t inner, double* panels, const int64_t* place, int64_t column,
                    int columns) {
    int64_t r = 0;
    for (; r + ROWS <= rows; r += ROWS)
        subtract_rows<ROWS, N>(left + r * stride, stride, right, inner, panels, place + r, column,
                               columns);
    // The rest in ever smaller tiles.
    auto rest = [&](auto tile) {
        constexpr int R = decltype(tile)::value;
        for (; r + R <= rows; r += R)
            subtract_rows<R, N>(left + r * stride, stride, right, inner, panels, place + r, column,
                                columns);
    };
    if constexpr (ROWS > 6) rest(std::integral_constant<int, 6>{});
    if constexpr (ROWS > 3) rest(std::integral_constant<int, 3>{});
    rest(std::integral_constant<int, 1>{});
}

// Solve for R rows and the columns of a corner, packed (N + 1, N) by `factorise_corner`.
template <int R, int N>
INLINE void solve_rows(double* panels, const int64_t* place, int64_t column, int columns,
                       const double* corner) {
    Lanes<N> found[R];
    UNROLL for (int r = 0; r < R; r++) found[r] = Lanes<N>::load(panels + place[r] + column, columns);
    UNROLL for (int k = 0; k < N; k++) {
        auto below = Lanes<N>::load(corner + N * k);
        UNROLL for (int r = 0; r < R; r++) found[r].take(found[r][k], below);
    }
    auto inverse = Lanes<N>::load(corner + N * N);
    UNROLL for (int r = 0; r < R; r++)
        (found[r] * inverse).store(panels + place[r] + column, columns);
}

template <int N>
void solve_tiles(double* panels, const int64_t* place, int64_t rows, int64_t column, int columns,
                 const double* corner) {
    int64_t r = 0;
    for (; r + ROWS <= rows; r += ROWS)
        solve_rows<ROWS, N>(panels, place + r, column, columns, corner);
    for (; r + 3 <= rows; r += 3) solve_rows<3, N>(panels, place + r, column, columns, corner);
    for (; r < rows; r++) solve_rows<1, N>(panels, place + r, column, columns, corner);
}

template <int N>
void pack(const double* source, int64_t stride, int rows, int64_t inner, double* packed) {
    const double* row[N];
    for (int r = 0; r < N; r++) row[r] = source + std::min(r, rows - 1) * stride;
    for (int64_t q = 0; q < inner; q++)
        for (int r = 0; r < N; r++) packed[q * N + r] = row[r][q];
}

// Subtract products of a source's first rows from the panel that they belong to.
inline void subtract(const double* source, int64_t stride, int64_t inner, int64_t height,
                     int64_t columns, double* panels, const int64_t* place, const int64_t* target,
                     double* packed) {
    for (int64_t c = 0, end; c < columns; c = end) {
        end = c + 1;
        while (end < std::min(c + WIDE, columns) && target[end] == target[end - 1] + 1) end++;
        int wide = int(end - c);
        const double* from = source + c * stride;
        if (wide > NARROW) {
            pack<WIDE>(from, stride, wide, inner, packed);
            subtract_tiles<WIDE>(from, stride, height - c, packed, inner, panels, place + c,
                                 target[c], wide);
        } else {
            pack<NARROW>(from, stride, wide, inner, packed);
            subtract_tiles<NARROW>(from, stride, height - c, packed, inner, panels, place + c,
                                   target[c], wide);
        }
    }
}

// Subtract products of blocks in the plane with the first of them.
inline void subtract_blocks(double* panels, int64_t begin, int64_t width, const int32_t* rows,
                            int64_t count, const int64_t* local, int64_t column, int64_t stride) {
    const double* source = panels + begin;
    Lanes<4> right[PLANE];
    for (int q = 0; q < PLANE; q++)
        for (int r = 0; r < 4; r++)
            right[q].part[r / Lanes<4>::W][r % Lanes<4>::W] =
                r < PLANE ? source[width * r + q] : 0.0;
    for (int64_t k = 0; k < count; k++) {
        const double* block = source + width * PLANE * k;
        double* to = panels + local[rows[k]] + column;
        for (int r = 0; r < PLANE; r++, block += width, to += stride) {
            auto total = right[0] * block[0];
            total.add(block[1], right[1]);
            total.add(block[2], right[2]);
            (Lanes<4>::load(to, PLANE) - total).store(to, PLANE);
        }
    }
}

// Factor a panel of one block column in the plane; return the column whose pivot is bad.
inline int factorise_block(double* panel, int64_t stride, int64_t height, const double* least) {
    if (!(panel[0] > std::max(least[0], 0.0))) return 0;
    double d0 = std::sqrt(panel[0]), i0 = 1 / d0;
    double l10 = panel[stride] * i0, l20 = panel[2 * stride] * i0;
    double d1 = panel[stride + 1] - l10 * l10;
    if (!(d1 > std::max(least[1], 0.0))) return 1;
    d1 = std::sqrt(d1);
    double i1 = 1 / d1, l21 = (panel[2 * stride + 1] - l20 * l10) * i1;
    double d2 = panel[2 * stride + 2] - l20 * l20 - l21 * l21;
    if (!(d2 > std::max(least[2], 0.0))) return 2;
    d2 = std::sqrt(d2);
    double i2 = 1 / d2;
    panel[0] = d0, panel[stride] = l10, panel[stride + 1] = d1;
    panel[2 * stride] = l20, panel[2 * stride + 1] = l21, panel[2 * stride + 2] = d2;
    for (int64_t r = PLANE; r < height; r++) {
        double* row = panel + r * stride;
        row[0] *= i0;
        row[1] = (row[1] - row[0] * l10) * i1;
        row[2] = (row[2] - row[0] * l20 - row[1] * l21) * i2;
    }
    return PLANE;
}

// Factor a diagonal block of a few columns, and pack it for `solve_rows`.
inline int factorise_corner(double* corner, int64_t stride, int width, const double* least,
                            int lanes, double* packed) {
    std::fill_n(packed, lanes * (lanes + 1), 0.0);
    double* inverse = packed + lanes * lanes;
    for (int k = 0; k < width; k++) {
        double pivot = corner[k * (stride + 1)];
        for (int q = 0; q < k; q++) pivot -= corner[k * stride + q] * corner[k * stride + q];
        if (!(pivot > std::max(least[k], 0.0))) return k;
        double root = std::sqrt(pivot);
        inverse[k] = 1 / root;
        corner[k * (stride + 1)] = root;
        for (int r = k + 1; r < width; r++) {
            double value = corner[r * stride + k];
            for (int q = 0; q < k; q++) value -= corner[r * stride + q] * corner[k * stride + q];
            value *= inverse[k];
            corner[r * stride + k] = value;
            packed[k * lanes + r] = value * inverse[k];
        }
    }
    return width;
}

// Factor the diagonal block of a panel and solve for the rest; return the bad column.
inline int64_t factorise_panel(double* panels, int64_t begin, int64_t stride, int64_t height,
                               int64_t width, const double* least, int64_t* place,
                               int64_t* target, double* packed) {
    for (int64_t r = 0; r < height; r++) place[r] = begin + r * stride, target[r] = r;
    for (int64_t c = 0; c < width; c += WIDE) {
        int columns = int(std::min<int64_t>(WIDE, width - c));
        int64_t top = place[c];
        if (c)
            subtract(panels + top, stride, c, height - c, columns, panels, place + c, target + c,
                     packed);
        int lanes = columns > NARROW ? WIDE : NARROW;
        int bad = factorise_corner(panels + top + c, stride, columns, least + c, lanes, packed);
        if (bad < columns) return c + bad;
        int64_t r = c + columns;
        if (lanes == WIDE)
            solve_tiles<WIDE>(panels, place + r, height - r, c, columns, packed);
        else
            solve_tiles<NARROW>(panels, place + r, height - r, c, columns, packed);
    }
    return width;
}

// Turn the lower triangle in `panels` into its factor, for one share of the supernodes; return
// the first position whose pivot is not positive, the number of positions when all are.
inline int64_t factorise(Vector<double> panels_, Vector<int32_t> first, Vector<int64_t> start,
                         Vector<int32_t> pattern, Vector<int64_t> offset, Vector<int64_t> stride,
                         Vector<int32_t> owner, Vector<int8_t> share, int64_t mine,
                         Matrix<int32_t> lists, Vector<int64_t> reach, int64_t d) {
    double* panels = panels_.data;
    int64_t count = first.size() - 1, n = first[count], tallest = 0;
    int32_t *head = lists[0], *next = lists[1];
    // Let a supernode wait for the one that owns its next row, if that is of this share.
    auto enqueue = [&](int64_t s) {
        if (start[s] + reach[s] < start[s + 1]) {
            int32_t target = owner[pattern[start[s] + reach[s]]];
            if (share[target] == mine) next[s] = head[target], head[target] = int32_t(s);
        }
    };
    for (int64_t s = 0; s < count; s++) {
        tallest = std::max(tallest, start[s + 1] - start[s]);
        if (share[s] < mine) enqueue(s);
    }
    tallest *= d;
    std::vector<int64_t> local(n), place(tallest), target(tallest);
    std::vector<double> least(tallest), packed(WIDE * (tallest + WIDE + 1));
    for (int64_t s = 0; s < count; s++) {
        if (share[s] != mine) continue;
        int64_t begin = offset[s], own = stride[s], width = (first[s + 1] - first[s]) * d;
        const int32_t* rows = &pattern[start[s]];
        int64_t height = (start[s + 1] - start[s]) * d;
        for (int64_t k = 0; k < start[s + 1] - start[s]; k++) local[rows[k]] = begin + k * d * own;
        for (int64_t c = 0; c < width; c++) least[c] = SINGULAR * panels[begin + c * (own + 1)];
        for (int64_t source = head[s]; source >= 0;) {
            int64_t next_source = next[source], step = stride[source];
            const int32_t* below = &pattern[start[source] + reach[source]];
            int64_t many = start[source + 1] - start[source] - reach[source], columns = 0;
            int64_t inner = (first[source + 1] - first[source]) * d;
            int64_t top = offset[source] + reach[source] * d * step;
            while (columns < many && below[columns] < first[s + 1]) columns++;
            if (d == PLANE && inner <= THIN) {
                for (int64_t c = 0; c < columns; c++)
                    for (int64_t q = top; q < top + inner; q += PLANE)
                        subtract_blocks(panels, q + c * PLANE * step, step, below + c, many - c,
                                        local.data(), (below[c] - first[s]) * PLANE, own);
            } else {
                for (int64_t k = 0; k < many; k++)
                    for (int64_t a = 0; a < d; a++) place[k * d + a] = local[below[k]] + a * own;
                for (int64_t k = 0; k < columns; k++)
                    for (int64_t a = 0; a < d; a++)
                        target[k * d + a] = (below[k] - first[s]) * d + a;
                subtract(panels + top, step, inner, many * d, columns * d, panels, place.data(),
                         target.data(), packed.data());
            }
            reach[source] += columns;
            enqueue(source);
            source = next_source;
        }
        int64_t bad = width == PLANE
            ? factorise_block(panels + begin, own, height, least.data())
            : factorise_panel(panels, begin, own, height, width, least.data(), place.data(),
                              target.data(), packed.data());
        if (bad < width) return first[s] + bad / d;
        reach[s] = first[s + 1] - first[s];
        enqueue(s);
    }
    return n;
}

static PyMethodDef methods[] = {
    FUNCTION(factorise,
             "panels, first, start, pattern, offset, stride, owner, share, mine, lists, "
             "reach, d"),
    {}};

}  // namespace cholesky
