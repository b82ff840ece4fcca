// SPDX-License-Identifier: Apache-2.0
// Sums over factors of products of their two blocks with vectors. K : rows of a block, 0: any.
#pragma once
#include <algorithm>
#include <vector>

#include "arrays.hpp"
#include "lanes.hpp"

namespace blocks {

// Call a template for the number of rows of a block; those of whole poses are constants to it.
#define FOR_SIZE(k, function, ...) \
    ((k) == 3 ? function<3>(__VA_ARGS__) : (k) == 6 ? function<6>(__VA_ARGS__) \
                                                    : function<0>(__VA_ARGS__))

template <int K>
void multiply_sized(Matrix<int64_t> keyframe, Array<double, 4> blocks, Matrix<double> x,
                    Matrix<double> product) {
    const int64_t k = K ? K : blocks.shape[3];
    for (int64_t f = 0; f < blocks.size(); f++) {
        const double *block = blocks[f], *xi = x[keyframe(f, 0)], *xj = x[keyframe(f, 1)];
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = 0; c < k; c++)
                total += block[r * k + c] * xi[c] + block[(k + r) * k + c] * xj[c];
            product(f, r) = total;
        }
    }
}

inline void multiply(Matrix<int64_t> keyframe, Array<double, 4> blocks, Matrix<double> x,
                     Matrix<double> product) {
    FOR_SIZE(blocks.shape[3], multiply_sized, keyframe, blocks, x, product);
}

template <int K>
void multiply_transposed_sized(Matrix<int64_t> keyframe, Array<double, 4> blocks,
                               Matrix<double> y, Matrix<double> product) {
    const int64_t k = K ? K : blocks.shape[3];
    for (int64_t f = 0; f < blocks.size(); f++) {
        const double* own = y[f];
        for (int side = 0; side < 2; side++) {
            const double* block = blocks[f] + side * k * k;
            double* to = product[keyframe(f, side)];
            for (int64_t c = 0; c < k; c++) {
                double total = 0.0;
                for (int64_t r = 0; r < k; r++) total += block[r * k + c] * own[r];
                to[c] += total;
            }
        }
    }
}

inline void multiply_transposed(Matrix<int64_t> keyframe, Array<double, 4> blocks,
                                Matrix<double> y, Matrix<double> product) {
    FOR_SIZE(blocks.shape[3], multiply_transposed_sized, keyframe, blocks, y, product);
}

// L' e of each factor; roots : (m, k, k) L', upper triangular.
template <int K>
void whiten_sized(Array<double, 3> roots, Matrix<double> vectors, Matrix<double> product) {
    const int64_t k = K ? K : vectors.shape[1];
    for (int64_t f = 0; f < roots.size(); f++)
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = r; c < k; c++) total += roots[f][r * k + c] * vectors(f, c);
            product(f, r) = total;
        }
}

inline Matrix<double> whiten(Array<double, 3> roots, Matrix<double> vectors) {
    auto product = new_array<double, 2>({roots.shape[0], vectors.shape[1]});
    FOR_SIZE(vectors.shape[1], whiten_sized, roots, vectors, product);
    return product;
}

template <int K>
void unwhiten_sized(Array<double, 3> roots, Matrix<double> duals, Matrix<double> product) {
    const int64_t k = K ? K : duals.shape[1];
    for (int64_t f = 0; f < roots.size(); f++)
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = 0; c <= r; c++) total += roots[f][c * k + r] * duals(f, c);
            product(f, r) = total;
        }
}

inline Matrix<double> unwhiten_dual(Array<double, 3> roots, Matrix<double> duals) {
    auto product = new_array<double, 2>({roots.shape[0], duals.shape[1]});
    FOR_SIZE(duals.shape[1], unwhiten_sized, roots, duals, product);
    return product;
}

// Turn J_i and J_j of each factor into L'J_i and L'J_j; a row needs none above it.
template <int K> void whiten_blocks_sized(Array<double, 3> roots, Array<double, 4> blocks) {
    const int64_t k = K ? K : blocks.shape[3];
    for (int64_t f = 0; f < roots.size(); f++)
        for (int side = 0; side < 2; side++) {
            double* block = blocks[f] + side * k * k;
            const double* root = roots[f];
            if constexpr (K == 6) {
                using L = Lanes<8>;
                L rows[K];
                UNROLL for (int r = 0; r < K; r++) rows[r] = L::load(block + r * K, K);
                UNROLL for (int r = 0; r < K; r++) {
                    L total = rows[r] * root[r * K + r];
                    UNROLL for (int a = r + 1; a < K; a++) total.add(root[r * K + a], rows[a]);
                    total.store(block + r * K, K);
                }
            } else {
                for (int64_t r = 0; r < k; r++)
                    for (int64_t c = 0; c < k; c++) {
                        double total = 0.0;
                        for (int64_t a = r; a < k; a++)
                            total += root[r * k + a] * block[a * k + c];
                        block[r * k + c] = total;
                    }
            }
        }
}

inline void whiten_blocks(Array<double, 3> roots, Array<double, 4> blocks) {
    FOR_SIZE(blocks.shape[3], whiten_blocks_sized, roots, blocks);
}

// Add left' W right to rows at `to`; of a block in space a row at a time.
template <int K>
INLINE void add_product(const double* left, const double* right, const double* weights, double* to,
                        int64_t stride, int64_t k) {
    if constexpr (K == 6) {
        using L = Lanes<8>;
        L scaled[K];
        UNROLL for (int a = 0; a < K; a++) scaled[a] = L::load(right + a * K, K) * weights[a];
        UNROLL for (int r = 0; r < K; r++, to += stride) {
            auto total = L::load(to, K);
            UNROLL for (int a = 0; a < K; a++) total.add(left[a * K + r], scaled[a]);
            total.store(to, K);
        }
    } else {
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c < k; c++) {
                double total = 0.0;
                for (int64_t a = 0; a < k; a++)
                    total += left[a * k + r] * (weights[a] * right[a * k + c]);
                to[r * stride + c] += total;
            }
    }
}

// Add a factor's curvature, (2, k / 2, 2 k), to its keyframes' own blocks and the one between.
template <int K>
INLINE void add_curvature(const double* curvature, double share, double* const own[2], double* at,
                          int64_t width, int left, int64_t k) {
    // Of three and of six numbers a step turns by one and by three.
    const int64_t turns = k / 2, still = k - turns;
    for (int side = 0; side < 2; side++)
        for (int64_t r = still; r < k; r++)
            for (int64_t c = 0; c <= r; c++)
                own[side][r * k + c] +=
                    share * curvature[(side * turns + r - still) * 2 * k + side * k + c];
    if (!at) return;
    const double* right_rows = curvature + (1 - left) * turns * 2 * k;
    const double* left_rows = curvature + left * turns * 2 * k;
    for (int64_t r = 0; r < still; r++)
        for (int64_t c = still; c < k; c++)
            at[r * width + c] += share * right_rows[(c - still) * 2 * k + left * k + r];
    for (int64_t r = still; r < k; r++)
        for (int64_t c = 0; c < k; c++)
            at[r * width + c] += share * left_rows[(r - still) * 2 * k + (1 - left) * k + c];
}

template <int K>
void assemble_sized(Vector<double> panels, Matrix<int64_t> keyframe, Vector<int64_t> address,
                    Vector<int64_t> width, Vector<bool> turned, Vector<int64_t> corner,
                    Vector<int64_t> stride, Array<double, 4> blocks, Matrix<double> weights,
                    Matrix<double> diagonal, Array<double, 4> curvature, double share) {
    const int64_t k = K ? K : blocks.shape[3], n = corner.size(), m = blocks.size();
    std::fill_n(panels.data, panels.size(), 0.0);
    // Keyframes' own blocks are summed up side by side: in the panels they lie far apart.
    std::vector<double> own((n + 1) * k * k);
    for (int64_t v = 0; v < n; v++)
        for (int64_t a = 0; a < k; a++) own[(v * k + a) * k + a] = diagonal(v, a);
    constexpr int64_t AHEAD = 16;
    for (int64_t f = 0; f < m; f++) {
        if (f + AHEAD < m && address[f + AHEAD] >= 0)
            for (int64_t r = 0; r < k; r++)
                __builtin_prefetch(&panels[address[f + AHEAD] + r * width[f + AHEAD]], 1);
        int left = turned[f] ? 0 : 1;
        const double* block[2] = {blocks[f], blocks[f] + k * k};
        double* mine[2] = {&own[keyframe(f, 0) * k * k], &own[keyframe(f, 1) * k * k]};
        for (int side = 0; side < 2; side++)
            add_product<K>(block[side], block[side], weights[f], mine[side], k, k);
        double* at = address[f] < 0 ? nullptr : &panels[address[f]];
        if (at) add_product<K>(block[left], block[1 - left], weights[f], at, width[f], k);
        if (f < curvature.size())
            add_curvature<K>(curvature[f], share, mine, at, width[f], left, k);
    }
    for (int64_t v = 0; v < n; v++)
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c <= r; c++)
                panels[corner[v] + r * stride[v] + c] = own[(v * k + r) * k + c];
}

// Write the lower triangle of J'WJ + diag(diagonal) + share C to the panels.
inline void assemble(Vector<double> panels, Matrix<int64_t> keyframe, Vector<int64_t> address,
                     Vector<int64_t> width, Vector<bool> turned, Vector<int64_t> corner,
                     Vector<int64_t> stride, Array<double, 4> blocks, Matrix<double> weights,
                     Matrix<double> diagonal, Array<double, 4> curvature, double share) {
    FOR_SIZE(blocks.shape[3], assemble_sized, panels, keyframe, address, width, turned, corner,
             stride, blocks, weights, diagonal, curvature, share);
}

static PyMethodDef methods[] = {
    FUNCTION(multiply, "keyframe, blocks, x, product"),
    FUNCTION(multiply_transposed, "keyframe, blocks, y, product"),
    FUNCTION(whiten, "roots, vectors"),
    FUNCTION(unwhiten_dual, "roots, duals"),
    FUNCTION(whiten_blocks, "roots, blocks"),
    FUNCTION(assemble,
             "panels, keyframe, address, width, turned, corner, stride, blocks, weights, "
             "diagonal, curvature, share"),
    {}};

}  // namespace blocks
