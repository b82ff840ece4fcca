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

// keyframe : (m, 2) which keyframe's step each block multiplies; whatever is none of the n free
// ones stands for what is held fixed. blocks : (m, 2, k, k).
using Keyframes = Matrix<const int64_t>;
using Blocks = Array<const double, 4>;

inline void check(Keyframes keyframe, Blocks blocks) {
    require(blocks.shape[1] == 2 && blocks.shape[2] == blocks.shape[3],
            "blocks must be (m, 2, k, k)");
    require(keyframe.size() == blocks.size() && keyframe.shape[1] == 2,
            "keyframe must be (m, 2), m as of blocks");
}
// Whether k is one of n; by one comparison.
inline bool is_free(int64_t k, int64_t n) { return uint64_t(k) < uint64_t(n); }

template <int K>
void multiply_sized(Keyframes keyframe, Blocks blocks, Matrix<const double> x,
                    Matrix<double> product) {
    const int64_t k = K ? K : blocks.shape[3], n = x.size();
    const std::vector<double> fixed(k, 0.0);
    for (int64_t f = 0; f < blocks.size(); f++) {
        const int64_t i = keyframe(f, 0), j = keyframe(f, 1);
        const double* xi = is_free(i, n) ? x[i] : fixed.data();
        const double* xj = is_free(j, n) ? x[j] : fixed.data();
        const double* block = blocks[f];
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = 0; c < k; c++)
                total += block[r * k + c] * xi[c] + block[(k + r) * k + c] * xj[c];
            product(f, r) = total;
        }
    }
}

// A x, (m, k); x : (n, k).
inline Matrix<double> multiply(Keyframes keyframe, Blocks blocks, Matrix<const double> x) {
    check(keyframe, blocks);
    require(x.shape[1] == blocks.shape[3], "x must be (n, k), k as of blocks");
    auto product = new_array<double, 2>({blocks.size(), x.shape[1]});
    FOR_SIZE(x.shape[1], multiply_sized, keyframe, blocks, x, product);
    return product;
}

template <int K>
void multiply_transposed_sized(Keyframes keyframe, Blocks blocks, Matrix<const double> y,
                               Matrix<double> product) {
    const int64_t k = K ? K : blocks.shape[3], n = product.size();
    std::vector<double> fixed(k);
    std::fill_n(product.data, n * k, 0.0);
    for (int64_t f = 0; f < blocks.size(); f++) {
        const double* own = y[f];
        for (int side = 0; side < 2; side++) {
            const int64_t v = keyframe(f, side);
            const double* block = blocks[f] + side * k * k;
            double* to = is_free(v, n) ? product[v] : fixed.data();
            for (int64_t c = 0; c < k; c++) {
                double total = 0.0;
                for (int64_t r = 0; r < k; r++) total += block[r * k + c] * own[r];
                to[c] += total;
            }
        }
    }
}

// A'y, (n, k); y : (m, k).
inline Matrix<double> multiply_transposed(Keyframes keyframe, Blocks blocks,
                                          Matrix<const double> y, int64_t n) {
    check(keyframe, blocks);
    require(y.size() == blocks.size() && y.shape[1] == blocks.shape[3],
            "y must be (m, k), as of blocks");
    require(n >= 0, "n must not be negative");
    auto product = new_array<double, 2>({n, y.shape[1]});
    FOR_SIZE(y.shape[1], multiply_transposed_sized, keyframe, blocks, y, product);
    return product;
}

// Square roots of information of each factor, (m, k, k) L', upper triangular.
using Roots = Array<const double, 3>;

inline void check(Roots roots, int64_t m, int64_t k) {
    require(roots.size() == m && roots.shape[1] == k && roots.shape[2] == k,
            "roots must be (m, k, k), as of what they multiply");
}

// L' e of each factor.
template <int K>
void whiten_sized(Roots roots, Matrix<const double> vectors, Matrix<double> product) {
    const int64_t k = K ? K : vectors.shape[1];
    for (int64_t f = 0; f < roots.size(); f++)
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = r; c < k; c++) total += roots[f][r * k + c] * vectors(f, c);
            product(f, r) = total;
        }
}

inline Matrix<double> whiten(Roots roots, Matrix<const double> vectors) {
    check(roots, vectors.size(), vectors.shape[1]);
    auto product = new_array<double, 2>({vectors.size(), vectors.shape[1]});
    FOR_SIZE(vectors.shape[1], whiten_sized, roots, vectors, product);
    return product;
}

// L y of each factor.
template <int K>
void unwhiten_sized(Roots roots, Matrix<const double> duals, Matrix<double> product) {
    const int64_t k = K ? K : duals.shape[1];
    for (int64_t f = 0; f < roots.size(); f++)
        for (int64_t r = 0; r < k; r++) {
            double total = 0.0;
            for (int64_t c = 0; c <= r; c++) total += roots[f][c * k + r] * duals(f, c);
            product(f, r) = total;
        }
}

inline Matrix<double> unwhiten_dual(Roots roots, Matrix<const double> duals) {
    check(roots, duals.size(), duals.shape[1]);
    auto product = new_array<double, 2>({duals.size(), duals.shape[1]});
    FOR_SIZE(duals.shape[1], unwhiten_sized, roots, duals, product);
    return product;
}

// Turn J_i and J_j of each factor into L'J_i and L'J_j; a row needs none above it.
template <int K> void whiten_blocks_sized(Roots roots, Array<double, 4> blocks) {
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

inline void whiten_blocks(Roots roots, Array<double, 4> blocks) {
    require(blocks.shape[1] == 2 && blocks.shape[2] == blocks.shape[3],
            "blocks must be (m, 2, k, k)");
    check(roots, blocks.size(), blocks.shape[3]);
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

// Where in the panels of `cholesky` the blocks lie. address, width : (m,) the block between the
// keyframes i and j of each factor, and the stride of its panel; address -1: there is none; turned :
// (m,) that block is the one of row i and column j; corner, stride : (n,) where each keyframe's own
// block begins, and its panel's stride.
struct Places {
    Vector<const int64_t> address, width;
    Vector<const bool> turned;
    Vector<const int64_t> corner, stride;

    void check(int64_t m, int64_t n, int64_t k, int64_t size) const {
        require(address.size() == m && width.size() == m && turned.size() == m,
                "address, width and turned must have an entry for each factor");
        require(corner.size() == n && stride.size() == n,
                "corner and stride must have an entry for each row of diagonal");
        bool fits = true;
        for (int64_t f = 0; f < m; f++)
            fits &= address[f] < 0 ||
                    (width[f] >= 0 && address[f] + (k - 1) * width[f] + k <= size);
        require(fits, "address and width must point into panels");
        for (int64_t v = 0; v < n; v++)
            fits &= corner[v] >= 0 && stride[v] >= 0 &&
                    corner[v] + (k - 1) * stride[v] + k <= size;
        require(fits, "corner and stride must point into panels");
    }
};

template <int K>
void assemble_sized(Vector<double> panels, Keyframes keyframe, const Places& at, Blocks blocks,
                    Matrix<const double> weights, Matrix<const double> diagonal,
                    Array<const double, 4> curvature, double share) {
    const int64_t k = K ? K : blocks.shape[3], n = diagonal.size(), m = blocks.size();
    std::fill_n(panels.data, panels.size(), 0.0);
    // Keyframes' own blocks are summed up side by side: in the panels they lie far apart, and each
    // factor would wait for two of them. The last one is of what is held fixed.
    std::vector<double> own((n + 1) * k * k);
    for (int64_t v = 0; v < n; v++)
        for (int64_t a = 0; a < k; a++) own[(v * k + a) * k + a] = diagonal(v, a);
    constexpr int64_t AHEAD = 16;
    for (int64_t f = 0; f < m; f++) {
        if (f + AHEAD < m && at.address[f + AHEAD] >= 0)
            for (int64_t r = 0; r < k; r++)
                __builtin_prefetch(
                    &panels[at.address[f + AHEAD] + r * at.width[f + AHEAD]], 1);
        const int left = at.turned[f] ? 0 : 1;
        const double* block[2] = {blocks[f], blocks[f] + k * k};
        double* mine[2];
        for (int side = 0; side < 2; side++) {
            const int64_t v = is_free(keyframe(f, side), n) ? keyframe(f, side) : n;
            mine[side] = &own[v * k * k];
            add_product<K>(block[side], block[side], weights[f], mine[side], k, k);
        }
        double* between = at.address[f] < 0 ? nullptr : &panels[at.address[f]];
        if (between)
            add_product<K>(block[left], block[1 - left], weights[f], between, at.width[f], k);
        if (f < curvature.size())
            add_curvature<K>(curvature[f], share, mine, between, at.width[f], left, k);
    }
    for (int64_t v = 0; v < n; v++)
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c <= r; c++)
                panels[at.corner[v] + r * at.stride[v] + c] = own[(v * k + r) * k + c];
}

// Write the lower triangle of J'WJ + diag(diagonal) + share C to the panels. weights : (m, k);
// diagonal : (n, k); curvature : (m', 2, k / 2, 2 k) of the first m' factors, of each the rows of
// the turns, the last entries, of keyframe i, and of j, which are its columns, too; all else is
// zero. C is their sum.
inline void assemble(Vector<double> panels, Keyframes keyframe, Vector<const int64_t> address,
                     Vector<const int64_t> width, Vector<const bool> turned,
                     Vector<const int64_t> corner, Vector<const int64_t> stride, Blocks blocks,
                     Matrix<const double> weights, Matrix<const double> diagonal,
                     Array<const double, 4> curvature, double share) {
    check(keyframe, blocks);
    const int64_t k = blocks.shape[3];
    require(weights.size() == blocks.size() && weights.shape[1] == k, "weights must be (m, k)");
    require(diagonal.shape[1] == k, "diagonal must be (n, k)");
    require(curvature.size() <= blocks.size() && curvature.shape[1] == 2 &&
            curvature.shape[2] == k / 2 && curvature.shape[3] == 2 * k,
            "curvature must be (m, 2, k / 2, 2 k) or of fewer factors");
    const Places at{address, width, turned, corner, stride};
    at.check(blocks.size(), diagonal.size(), k, panels.size());
    FOR_SIZE(k, assemble_sized, panels, keyframe, at, blocks, weights, diagonal, curvature, share);
}

static PyMethodDef methods[] = {
    BY_SIZE(multiply, "keyframe, blocks, x"),
    BY_SIZE(multiply_transposed, "keyframe, blocks, y, n"),
    BY_SIZE(whiten, "roots, vectors"),
    BY_SIZE(unwhiten_dual, "roots, duals"),
    BY_SIZE(whiten_blocks, "roots, blocks"),
    BY_SIZE(assemble,
             "panels, keyframe, address, width, turned, corner, stride, blocks, weights, "
             "diagonal, curvature, share"),
    {}};

}  // namespace blocks
