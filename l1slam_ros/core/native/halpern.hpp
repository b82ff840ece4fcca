// SPDX-License-Identifier: Apache-2.0
// One pass over the factors per iteration of restarted PDHG: gather, update the dual, scatter.
// Factors come in tiles of LANES, each number of a factor one row of a tile, so that one
// instruction works on as many factors as fit a register. Rows of a tile, k the block size:
//
//     2 k k   the blocks, row after row, that of the first keyframe before the second's
//     k       b
//     k       y
//     k       y0, the dual where the iteration was last restarted
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "arrays.hpp"
#include "blocks.hpp"
#include "lanes.hpp"

namespace halpern {

// One cache line of single precision; the caller lays tiles out with as many.
constexpr int LANES = 16;
// Part of a keyframe's scale by which a direction that no factor measures is held.
constexpr double UNMEASURED = 1e-12;

// Turn R'R into R^-1, R upper triangular, a little more than R'R where nothing is measured.
inline void invert_root(double* gram, int64_t k) {
    auto at = [&](int64_t r, int64_t c) -> double& { return gram[r * k + c]; };
    double trace = 0.0;
    for (int64_t a = 0; a < k; a++) trace += at(a, a);
    for (int64_t a = 0; a < k; a++) at(a, a) += trace > 0 ? UNMEASURED * trace : 1.0;
    // The lower triangle becomes R'.
    for (int64_t a = 0; a < k; a++)
        for (int64_t b = 0; b <= a; b++) {
            double total = at(a, b);
            for (int64_t c = 0; c < b; c++) total -= at(a, c) * at(b, c);
            at(a, b) = a == b ? std::sqrt(total) : total / at(b, b);
        }
    // Column by column of R'^-1, which is written to the rows of the upper one.
    for (int64_t b = 0; b < k; b++) {
        at(b, b) = 1 / at(b, b);
        for (int64_t a = b + 1; a < k; a++) {
            double total = 0.0;
            for (int64_t c = b; c < a; c++) total -= at(a, c) * at(b, c);
            at(b, a) = total / at(a, a);
        }
    }
    for (int64_t a = 0; a < k; a++)
        for (int64_t b = 0; b < a; b++) at(a, b) = 0.0;
}

using Scaled = std::tuple<Array<double, 4>, Array<double, 3>>;

template <int K>
Scaled scale_sized(blocks::Keyframes keyframe, blocks::Blocks blocks, int64_t n) {
    const int64_t m = blocks.size(), k = K ? K : blocks.shape[3];
    auto inverse = new_array<double, 3>({n, k, k});
    auto scaled = new_array<double, 4>({m, 2, k, k});
    std::fill_n(inverse.data, n * k * k, 0.0);
    for (int64_t f = 0; f < m; f++)
        for (int side = 0; side < 2; side++) {
            if (!blocks::is_free(keyframe(f, side), n)) continue;
            const double* block = blocks[f] + side * k * k;
            double* total = inverse[keyframe(f, side)];
            for (int64_t r = 0; r < k; r++)
                for (int64_t a = 0; a < k; a++)
                    for (int64_t b = 0; b < k; b++)
                        total[a * k + b] += 2 * block[r * k + a] * block[r * k + b];
        }
    for (int64_t v = 0; v < n; v++) invert_root(inverse[v], k);
    for (int64_t f = 0; f < m; f++)
        for (int side = 0; side < 2; side++) {
            const double* block = blocks[f] + side * k * k;
            double* to = scaled[f] + side * k * k;
            std::fill_n(to, k * k, 0.0);
            if (!blocks::is_free(keyframe(f, side), n)) continue;  // it has no unknowns
            const double* factor = inverse[keyframe(f, side)];
            for (int64_t r = 0; r < k; r++)
                for (int64_t a = 0; a < k; a++)
                    for (int64_t c = 0; c < k; c++)
                        to[r * k + c] += block[r * k + a] * factor[a * k + c];
        }
    return {scaled, inverse};
}

// The blocks in scaled unknowns, (m, 2, k, k), and R_v^-1 of each of n keyframes, (n, k, k).
inline Scaled scale(blocks::Keyframes keyframe, blocks::Blocks blocks, int64_t n) {
    blocks::check(keyframe, blocks);
    require(n >= 0, "n must not be negative");
    return FOR_SIZE(blocks.shape[3], scale_sized, keyframe, blocks, n);
}

// tiles : (tiles, rows, LANES); keyframe : (tiles, 2, LANES); steps : (n + 1, k), the last row of
// what is held fixed.
using Tiles = Array<float, 3>;
using Keyframes = Array<const int32_t, 3>;
using Steps = Matrix<float>;

// A number of each factor of a tile, in registers.
struct Row {
    static constexpr int WIDE = 2 * WIDTH, PARTS = LANES / WIDE;
    typedef float Register __attribute__((vector_size(4 * WIDE)));
    typedef float Unaligned __attribute__((vector_size(4 * WIDE), aligned(4), may_alias));
    Register part[PARTS];

    static INLINE Row zero() {
        Row all;
        UNROLL for (int p = 0; p < PARTS; p++) all.part[p] = Register{};
        return all;
    }
    static INLINE Row load(const float* from) {
        Row all;
        UNROLL for (int p = 0; p < PARTS; p++)
            all.part[p] = *reinterpret_cast<const Unaligned*>(from + p * WIDE);
        return all;
    }
    INLINE void store(float* to) const {
        UNROLL for (int p = 0; p < PARTS; p++)
            *reinterpret_cast<Unaligned*>(to + p * WIDE) = part[p];
    }
    INLINE void add(const Row& one, const Row& other) {
        UNROLL for (int p = 0; p < PARTS; p++) part[p] += one.part[p] * other.part[p];
    }
};

// What the loops have in common, k rows of a block.
template <int K> struct Tile {
    static constexpr int B = 2 * K * K, Y = B + K, START = Y + K, ROWS = START + K;

    // Copy x at both keyframes of each factor to 2 K rows.
    static void gather(Matrix<const float> x, const int32_t* keyframe, float (*rows)[LANES]) {
        for (int side = 0; side < 2; side++)
            for (int lane = 0; lane < LANES; lane++) {
                const float* from = x[keyframe[side * LANES + lane]];
                for (int c = 0; c < K; c++) rows[side * K + c][lane] = from[c];
            }
    }
    // Add A'y to g.
    static void scatter(const float (*tile)[LANES], const float (*y)[LANES],
                        const int32_t* keyframe, Steps g) {
        float product[2 * K][LANES];
        Row rows[K];
        UNROLL for (int r = 0; r < K; r++) rows[r] = Row::load(y[r]);
        for (int c = 0; c < 2 * K; c++) {
            const int at = c < K ? c : K * K + c - K;  // its block's first row
            Row total = Row::zero();
            UNROLL for (int r = 0; r < K; r++) total.add(Row::load(tile[at + r * K]), rows[r]);
            total.store(product[c]);
        }
        for (int side = 0; side < 2; side++)
            for (int lane = 0; lane < LANES; lane++) {
                float* to = g[keyframe[side * LANES + lane]];
                for (int c = 0; c < K; c++) to[c] += product[side * K + c][lane];
            }
    }
    // A x, all rows at once: each sum waits for the one before.
    static void multiply(const float (*tile)[LANES], const float (*x)[LANES],
                         float (*product)[LANES]) {
        Row total[K];
        UNROLL for (int r = 0; r < K; r++) total[r] = Row::zero();
        for (int c = 0; c < 2 * K; c++) {
            const int at = c < K ? c : K * K + c - K;
            const Row of_x = Row::load(x[c]);
            UNROLL for (int r = 0; r < K; r++) total[r].add(Row::load(tile[at + r * K]), of_x);
        }
        UNROLL for (int r = 0; r < K; r++) total[r].store(product[r]);
    }
    template <class T> static T (*tile(Array<T, 3> tiles, int64_t t))[LANES] {
        return reinterpret_cast<T(*)[LANES]>(tiles[t]);
    }
};

inline void check(Tiles tiles, Keyframes keyframe, std::initializer_list<Steps> steps) {
    const Steps x = *steps.begin();
    const int64_t k = x.shape[1];
    require(k == 1 || k == 2 || k == 3 || k == 6, "x must be (n + 1, k), k 1, 2, 3 or 6");
    for (const Steps& other : steps)
        require(other.size() == x.size() && other.shape[1] == k, "all steps must be (n + 1, k)");
    require(tiles.shape[1] == 2 * k * k + 3 * k && tiles.shape[2] == LANES,
            "tiles must be (tiles, 2 k k + 3 k, 16)");
    require(keyframe.size() == tiles.size() && keyframe.shape[1] == 2 &&
            keyframe.shape[2] == LANES, "keyframe must be (tiles, 2, 16)");
    bool fits = true;
    for (int64_t f = 0; f < keyframe.size() * 2 * LANES; f++)
        fits &= keyframe.data[f] >= 0 && keyframe.data[f] < x.size();
    require(fits, "keyframe must hold rows of x");
}
#define FOR_ROWS(k, function, ...) \
    ((k) == 1 ? function<1>(__VA_ARGS__) : (k) == 2 ? function<2>(__VA_ARGS__) \
     : (k) == 3 ? function<3>(__VA_ARGS__) : function<6>(__VA_ARGS__))

// Set z = x - twice g, x = a z, and clear g.
inline void reflect(float* x, float* z, float* g, int64_t count, float twice, float a) {
    NO_OVERLAP
    for (int64_t j = 0; j < count; j++) {
        z[j] = x[j] - twice * g[j];
        x[j] = a * z[j];
        g[j] = 0;
    }
}

template <int K>
void iterate_sized(Tiles tiles, Keyframes keyframe, Steps x, Steps z, Steps g, double weight,
                   int64_t first, int64_t count) {
    using Tile = halpern::Tile<K>;
    const float w = float(weight), twice = float(2 / weight);
    float local[2 * K][LANES], Ax[K][LANES], y[K][LANES];
    for (int64_t iteration = first; iteration < first + count; iteration++) {
        const float a = float((iteration + 1.0) / (iteration + 2.0));
        const float rest = float(1.0 / (iteration + 2.0));
        reflect(x.data, z.data, g.data, x.size() * K, twice, a);
        for (int64_t t = 0; t < tiles.size(); t++) {
            auto tile = Tile::tile(tiles, t);
            Tile::gather(z, keyframe[t], local);
            Tile::multiply(tile, local, Ax);
            for (int r = 0; r < K; r++) {
                float* own = tile[Tile::Y + r];
                for (int lane = 0; lane < LANES; lane++) {
                    const float residual = Ax[r][lane] - tile[Tile::B + r][lane], was = own[lane];
                    const float bar = std::min(std::max(was + w * residual, -1.0f), 1.0f);
                    y[r][lane] = a * (bar + bar - was) + rest * tile[Tile::START + r][lane];
                    own[lane] = y[r][lane];
                }
            }
            Tile::scatter(tile, y, keyframe[t], g);
        }
    }
}

// Advance x, the y of the tiles and g = A'y by `count` iterations. z : scratch; first : iterations
// since the restart.
inline void iterate(Tiles tiles, Keyframes keyframe, Steps x, Steps z, Steps g, double weight,
                    int64_t first, int64_t count) {
    check(tiles, keyframe, {x, z, g});
    FOR_ROWS(x.shape[1], iterate_sized, tiles, keyframe, x, z, g, weight, first, count);
}

struct Look {
    double residual, cost, dual;
};

template <int K>
Look look_sized(Tiles tiles, Keyframes keyframe, Steps x, Steps g, double weight, Steps x_bar,
                Steps g_bar, Tiles y_bar) {
    using Tile = halpern::Tile<K>;
    const float w = float(weight), rest = float(1 / weight);
    std::vector<float> step(g.size() * K);
    Matrix<const float> d(step.data(), nullptr);
    d.shape[0] = g.size(), d.shape[1] = K;
    double moved = 0.0, turned = 0.0, crossed = 0.0, cost = 0.0, value = 0.0;
    for (int64_t j = 0; j < g.size() * K; j++) {
        step[j] = rest * g.data[j];
        x_bar.data[j] = x.data[j] - step[j];
        moved += double(step[j]) * step[j];
        g_bar.data[j] = 0;
    }
    float local[2 * K][LANES], change[2 * K][LANES], Ax[K][LANES], Ad[K][LANES];
    for (int64_t t = 0; t < tiles.size(); t++) {
        auto tile = Tile::tile(tiles, t);
        auto y = Tile::tile(y_bar, t);
        Tile::gather(x_bar, keyframe[t], local);
        Tile::gather(d, keyframe[t], change);
        Tile::multiply(tile, local, Ax);
        Tile::multiply(tile, change, Ad);
        for (int r = 0; r < K; r++)
            for (int lane = 0; lane < LANES; lane++) {
                const float b = tile[Tile::B + r][lane], was = tile[Tile::Y + r][lane];
                const float residual = Ax[r][lane] - b;
                const float now =
                    std::min(std::max(was + w * (residual - Ad[r][lane]), -1.0f), 1.0f);
                turned += double(now - was) * (now - was);
                crossed += double(now - was) * Ad[r][lane];
                cost += std::abs(residual);
                value -= double(b) * now;
                y[r][lane] = now;
            }
        Tile::scatter(tile, y, keyframe[t], g_bar);
    }
    return {weight * moved + turned / weight + 2 * crossed, cost, value};
}

// Find the next point without the pull to the restart: x_bar, g_bar = A'y_bar and y_bar (tiles, k,
// LANES). Return the squared fixed-point residual, |A x_bar - b|_1 and -b'y_bar.
inline std::tuple<double, double, double> look(Tiles tiles, Keyframes keyframe, Steps x, Steps g,
                                               double weight, Steps x_bar, Steps g_bar,
                                               Tiles y_bar) {
    check(tiles, keyframe, {x, g, x_bar, g_bar});
    require(y_bar.size() == tiles.size() && y_bar.shape[1] == x.shape[1] &&
            y_bar.shape[2] == LANES, "y_bar must be (tiles, k, 16)");
    const Look found =
        FOR_ROWS(x.shape[1], look_sized, tiles, keyframe, x, g, weight, x_bar, g_bar, y_bar);
    return {found.residual, found.cost, found.dual};
}

static PyMethodDef methods[] = {
    BY_SIZE(scale, "keyframe, blocks, n"),
    FUNCTION(iterate, "tiles, keyframe, x, z, g, weight, first, count"),
    BY_SIZE(look, "tiles, keyframe, x, g, weight, x_bar, g_bar, y_bar"),
    {}};

}  // namespace halpern
