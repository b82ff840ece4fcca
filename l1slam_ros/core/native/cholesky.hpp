// SPDX-License-Identifier: Apache-2.0
// Supernodal Cholesky of a sparse matrix of k x k blocks, which `blocks::assemble` wrote.
// Left-looking: each supernode gathers what all earlier ones subtract from it, then is factored.
// All the work is done in tiles of rows and columns: a tile stays in the processor's registers
// while what its rows have in common with its columns is summed up.
// Source: Ng and Peyton, "Block sparse Cholesky algorithms on advanced uniprocessor computers"
// (1993); tiles: Goto and van de Geijn, "Anatomy of high-performance matrix multiplication" (2008).
#pragma once
#include <algorithm>
#include <cmath>
#include <system_error>
#include <thread>
#include <type_traits>
#include <vector>

#include "arrays.hpp"
#include "lanes.hpp"
#include "panels.hpp"

namespace cholesky {

// A pivot that is left with less than this part of its diagonal entry is rounding.
constexpr double SINGULAR = 1e-13;
// Rows and columns of a tile: as many sums as registers hold.
constexpr int ROWS = WIDTH == 4 ? 6 : 3, WIDE = WIDTH == 2 ? 4 : 8;
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
// place : (height,) where each of the rows begins in the target's panel; target : (columns,) the
// column of that panel that belongs to each of the first rows; packed : work space.
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

// Subtract products of blocks in the plane with the first of them from another panel: a tile would
// take longer to begin than so few products. begin, width : of the blocks; rows : (count,) their
// positions; local, column, stride : where to.
inline void subtract_blocks(double* panels, int64_t begin, int64_t width, const int32_t* rows,
                            int64_t count, const int64_t* local, int64_t column, int64_t stride) {
    const double* source = panels + begin;
    Lanes<4> right[PLANE];
    for (int q = 0; q < PLANE; q++) {
        right[q] = Lanes<4>::zero();
        for (int r = 0; r < PLANE; r++)
            right[q].part[r / Lanes<4>::W][r % Lanes<4>::W] = source[width * r + q];
    }
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
// least : (width,) what each pivot must exceed; others : work space.
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

// One factorisation. Supernodes have shares, 0 and 1, which may be worked on at the same time, and
// 2, which comes after both.
class Factorisation {
  public:
    Factorisation(double* panels, const Panels& shape, Vector<const int8_t> share)
        : panels(panels), shape(shape), share(share), owner(shape.positions()),
          head(shape.count(), -1), next(shape.count(), -1), reach(shape.count(), 0) {
        for (int64_t s = 0; s < shape.count(); s++)
            for (int32_t k = shape.first[s]; k < shape.first[s + 1]; k++) owner[k] = int32_t(s);
        const int64_t tallest = shape.tallest() * shape.k;
        for (Work& own : work) {
            own.local.resize(shape.positions()), own.place.resize(tallest);
            own.target.resize(tallest), own.least.resize(tallest);
            own.packed.resize(WIDE * (tallest + WIDE + 1));
            if (!has(1)) break;
        }
    }
    bool has(int8_t which) const {
        return std::find(share.data, share.data + share.size(), which) != share.data + share.size();
    }
    // Factorise one share; return the first position whose pivot is not positive, the number of
    // positions when all are.
    int64_t run(int8_t mine) {
        for (int64_t s = 0; s < shape.count(); s++)
            if (share[s] < mine) enqueue(s, mine);
        for (int64_t s = 0; s < shape.count(); s++) {
            if (share[s] != mine) continue;
            const int64_t bad = factorise_supernode(s, mine, work[mine == 1]);
            if (bad < shape.columns(s) * shape.k) return shape.first[s] + bad / shape.k;
            reach[s] = shape.columns(s);
            enqueue(s, mine);
        }
        return shape.positions();
    }

  private:
    // Of each position where its rows begin in a panel; of rows, of columns; see `subtract`.
    struct Work {
        std::vector<int64_t> local, place, target;
        std::vector<double> least, packed;
    };
    double* const panels;
    const Panels shape;
    const Vector<const int8_t> share;
    std::vector<int32_t> owner;
    // What has something to subtract from supernode s is a linked list: head[s], next[head[s]]
    // ...; reach : from which of its rows on.
    std::vector<int32_t> head, next;
    std::vector<int64_t> reach;
    Work work[2];

    // Let a supernode wait for the one that owns its next row, if that is of this share.
    void enqueue(int64_t s, int8_t mine) {
        if (reach[s] >= shape.rows(s)) return;
        const int32_t target = owner[shape.pattern[shape.start[s] + reach[s]]];
        if (share[target] == mine) next[s] = head[target], head[target] = int32_t(s);
    }

    // Return the column whose pivot is bad, the number of columns when none is.
    int64_t factorise_supernode(int64_t s, int8_t mine, Work& own) {
        const int64_t k = shape.k, begin = shape.offset[s], stride = shape.stride[s];
        const int64_t width = shape.columns(s) * k, height = shape.rows(s) * k;
        const int32_t* rows = &shape.pattern[shape.start[s]];
        int64_t* local = own.local.data();
        double* least = own.least.data();
        for (int64_t r = 0; r * k < height; r++) local[rows[r]] = begin + r * k * stride;
        for (int64_t c = 0; c < width; c++) least[c] = SINGULAR * panels[begin + c * (stride + 1)];
        for (int64_t source = head[s]; source >= 0;) {
            const int64_t behind = next[source];
            reach[source] += subtract_source(source, s, own);
            enqueue(source, mine);
            source = behind;
        }
        return width == PLANE
            ? factorise_block(panels + begin, stride, height, least)
            : factorise_panel(panels, begin, stride, height, width, least,
                              own.place.data(), own.target.data(), own.packed.data());
    }

    // Subtract what an earlier supernode has for supernode s; return of how many block columns.
    int64_t subtract_source(int64_t source, int64_t s, Work& own) {
        const int64_t k = shape.k, step = shape.stride[source], stride = shape.stride[s];
        const int64_t first = shape.first[s], end = shape.first[s + 1];
        const int64_t* local = own.local.data();
        int64_t *place = own.place.data(), *target = own.target.data();
        const int32_t* below = &shape.pattern[shape.start[source] + reach[source]];
        const int64_t many = shape.rows(source) - reach[source];
        const int64_t inner = shape.columns(source) * k;
        const int64_t top = shape.offset[source] + reach[source] * k * step;
        int64_t columns = 0;
        while (columns < many && below[columns] < end) columns++;
        if (k == PLANE && inner <= THIN) {
            for (int64_t c = 0; c < columns; c++)
                for (int64_t q = top; q < top + inner; q += PLANE)
                    subtract_blocks(panels, q + c * PLANE * step, step, below + c, many - c, local,
                                    (below[c] - first) * PLANE, stride);
            return columns;
        }
        for (int64_t r = 0; r < many; r++)
            for (int64_t a = 0; a < k; a++)
                place[r * k + a] = local[below[r]] + a * stride;
        for (int64_t c = 0; c < columns; c++)
            for (int64_t a = 0; a < k; a++)
                target[c * k + a] = (below[c] - first) * k + a;
        subtract(panels + top, step, inner, many * k, columns * k, panels, place, target,
                 own.packed.data());
        return columns;
    }
};

// Turn the lower triangle in `panels` into its factor; return the first position whose pivot is
// not positive, the number of positions when all are. k : rows of a block; share : of each
// supernode, see `Factorisation`; threads : how many may be used.
inline int64_t factorise(Vector<double> panels, PANELS_ARGUMENTS, Vector<const int8_t> share,
                         int64_t k, int64_t threads) {
    const Panels shape(panels.size(), first, start, pattern, offset, stride, k);
    require(share.size() == shape.count(), "share must have an entry for each panel");
    Factorisation all(panels.data, shape, share);
    if (!all.has(1)) return std::min(all.run(0), all.run(2));
    int64_t one = 0, other = 0;
    std::thread second;
    if (threads > 1) {
        try {
            second = std::thread([&] { other = all.run(1); });
        } catch (const std::system_error&) {  // there are no more threads to be had
        }
    }
    one = all.run(0);
    if (second.joinable()) second.join();
    else other = all.run(1);
    return std::min({one, other, all.run(2)});
}

static PyMethodDef methods[] = {
    BY_SIZE(factorise, "panels, " PANELS_NAMES ", share, k, threads"),
    {}};

}  // namespace cholesky
