// SPDX-License-Identifier: Apache-2.0
// Sampled steps of all keyframes at once, and the innovations of factors that they predict.
// Arrays of steps are (n, k, q): q = SAMPLES of the k numbers of each of n keyframes, the last one
// standing for all that are held fixed; k is 3 or 6, and the work is done in tiles of 3 x 3.
// Other arrays are those of `blocks` and of `cholesky`.
#pragma once
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "arrays.hpp"
#include "blocks.hpp"
#include "panels.hpp"

namespace prediction {

// Samples of a step: a constant, so that loops over them are done by vectors. The caller's, too.
constexpr int64_t SAMPLES = 48;
// What is left of a covariance where this part of it was subtracted but rounding.
constexpr double DEFINITE = 1e-14;

using Steps = Array<const double, 3>;
using Signs = Array<const int8_t, 3>;
using blocks::Blocks;

// A 3 x 3 tile of a matrix: entry (r, c) is at from[r down + c across].
struct Tile {
    double m[3][3];
    Tile(const double* from, int64_t down, int64_t across, double sign) {
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) m[r][c] = sign * from[r * down + c * across];
    }
    // Add this tile times three rows of samples to three others.
    void add(const double* x, double* y) const {
        NO_OVERLAP
        for (int64_t t = 0; t < SAMPLES; t++) {
            const double p = x[t], q = x[SAMPLES + t], r = x[2 * SAMPLES + t];
            y[t] += m[0][0] * p + m[0][1] * q + m[0][2] * r;
            y[SAMPLES + t] += m[1][0] * p + m[1][1] * q + m[1][2] * r;
            y[2 * SAMPLES + t] += m[2][0] * p + m[2][1] * q + m[2][2] * r;
        }
    }
};

inline void write_sample(const int8_t* y, int64_t count, double* z) {
    NO_OVERLAP
    for (int64_t t = 0; t < count; t++) z[t] = y[t];
}

// The number of rows of a keyframe, if steps are those of all keyframes that the factors name.
inline int64_t size_of(Matrix<const int64_t> keyframe, Blocks blocks, Steps steps) {
    const int64_t k = steps.shape[1];
    require(k % 3 == 0 && steps.shape[2] == SAMPLES, "steps must be (n + 1, k, 48), k 3 or 6");
    require(blocks.shape[2] == k && blocks.shape[3] == k, "blocks must be (m, sides, k, k)");
    require(keyframe.size() == blocks.size() && keyframe.shape[1] == blocks.shape[1],
            "keyframe must be (m, sides), as of blocks");
    bool fits = true;
    for (int64_t f = 0; f < keyframe.size() * keyframe.shape[1]; f++)
        fits &= keyframe.data[f] >= 0 && keyframe.data[f] < steps.size();
    require(fits, "keyframe must hold rows of the steps");
    return k;
}

inline void check(Signs y, int64_t k) {
    require(y.shape[1] == k && y.shape[2] == SAMPLES, "y must be (m, k, 48), k as of the steps");
}

// Add A'y of all samples to product (n + 1, k, q); y : (m, k, q) whole numbers.
inline void gather(Matrix<const int64_t> keyframe, Blocks blocks, Signs y,
                   Array<double, 3> product) {
    const int64_t k = size_of(keyframe, blocks, product);
    check(y, k);
    require(y.size() == blocks.size(), "y must be (m, k, 48), m as of blocks");
    std::vector<double> z(k * SAMPLES);
    for (int64_t f = 0; f < blocks.size(); f++) {
        write_sample(y[f], k * SAMPLES, z.data());
        for (int64_t side = 0; side < keyframe.shape[1]; side++) {
            const double* J = blocks[f] + side * k * k;
            double* to = product[keyframe(f, side)];
            for (int64_t c = 0; c < k; c += 3)
                for (int64_t r = 0; r < k; r += 3)
                    Tile(J + r * k + c, 1, k, 1.0).add(&z[r * SAMPLES], to + c * SAMPLES);
        }
    }
}

// Add sign times the sum of J x of one factor to the k rows of d.
inline void add_moved(const int64_t* keyframe, int64_t sides, const double* J, Steps x, double sign,
                      double* d) {
    const int64_t k = x.shape[1];
    for (int64_t side = 0; side < sides; side++)
        for (int64_t r = 0; r < k; r += 3)
            for (int64_t c = 0; c < k; c += 3)
                Tile(J + (side * k + r) * k + c, k, 1, sign)
                    .add(x[keyframe[side]] + c * SAMPLES, d + r * SAMPLES);
}

// A x of each factor and sample, (m, k, q); a row of A may have blocks of any number of keyframes.
inline Array<double, 3> moved(Matrix<const int64_t> keyframe, Blocks blocks, Steps x) {
    const int64_t k = size_of(keyframe, blocks, x);
    auto d = new_array<double, 3>({blocks.size(), k, SAMPLES});
    for (int64_t f = 0; f < blocks.size(); f++) {
        std::fill_n(d[f], k * SAMPLES, 0.0);
        add_moved(keyframe[f], blocks.shape[1], blocks[f], x, 1.0, d[f]);
    }
    return d;
}

// The second moment of y - A x of each factor, (m, k, k). y : as of `gather`, of the first
// factors; zero of the others.
inline Array<double, 3> left_over(Matrix<const int64_t> keyframe, Blocks blocks, Steps x, Signs y) {
    const int64_t k = size_of(keyframe, blocks, x);
    check(y, k);
    require(y.size() <= blocks.size(), "y must not be of more factors than blocks");
    auto moment = new_array<double, 3>({blocks.size(), k, k});
    std::vector<double> d(k * SAMPLES);
    for (int64_t f = 0; f < blocks.size(); f++) {
        if (f < y.size()) write_sample(y[f], k * SAMPLES, d.data());
        else std::fill(d.begin(), d.end(), 0.0);
        add_moved(keyframe[f], blocks.shape[1], blocks[f], x, -1.0, d.data());
        double* to = moment[f];
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c <= r; c++) {
                const double *one = &d[r * SAMPLES], *other = &d[c * SAMPLES];
                double total = 0.0;
                for (int64_t t = 0; t < SAMPLES; t++) total += one[t] * other[t];
                to[r * k + c] = to[c * k + r] = total / SAMPLES;
            }
    }
    return moment;
}

// Solve L y = three rows of x, in place; with L' if `transposed`. L : of a panel, of this stride.
template <bool TRANSPOSED> void solve_three(const double* L, int64_t stride, double* x) {
    const double a = 1 / L[0], b = L[stride], c = 1 / L[stride + 1];
    const double d = L[2 * stride], e = L[2 * stride + 1], f = 1 / L[2 * stride + 2];
    NO_OVERLAP
    for (int64_t t = 0; t < SAMPLES; t++) {
        double u = x[t], v = x[SAMPLES + t], w = x[2 * SAMPLES + t];
        if constexpr (TRANSPOSED) {
            w *= f;
            v = (v - e * w) * c;
            u = (u - b * v - d * w) * a;
        } else {
            u *= a;
            v = (v - b * u) * c;
            w = (w - d * u - e * v) * f;
        }
        x[t] = u, x[SAMPLES + t] = v, x[2 * SAMPLES + t] = w;
    }
}

// Turn right hand sides, (n, k, q) in the order of the keyframes, into L'^-1 L^-1 right.
inline void solve_many(Vector<const double> panels, PANELS_ARGUMENTS,
                       Vector<const int32_t> position, Array<double, 3> right) {
    const int64_t n = right.size(), k = right.shape[1];
    require(k % 3 == 0 && right.shape[2] == SAMPLES, "right must be (n, k, 48), k 3 or 6");
    const Panels shape(panels.size(), first, start, pattern, offset, stride, k);
    check_positions(shape, position);
    require(n == position.size(), "right must have a row for each position");
    std::vector<double*> row(n);  // of each position
    for (int64_t f = 0; f < n; f++) row[position[f]] = right[f];
    // Row r of panel s, which has these block rows.
    auto at = [&](const int32_t* rows, int64_t r) { return row[rows[r / k]] + r % k * SAMPLES; };
    for (int64_t s = 0; s < shape.count(); s++) {
        const int64_t width = shape.columns(s) * k, height = shape.rows(s) * k, down = stride[s];
        const int32_t* rows = &pattern[start[s]];
        for (int64_t c = 0; c < width; c += 3) {
            const double* panel = &panels[offset[s]] + c;
            double* own = at(rows, c);
            solve_three<false>(panel + c * down, down, own);
            for (int64_t r = c + 3; r < height; r += 3)
                Tile(panel + r * down, down, 1, -1.0).add(own, at(rows, r));
        }
    }
    for (int64_t s = shape.count() - 1; s >= 0; s--) {
        const int64_t width = shape.columns(s) * k, height = shape.rows(s) * k, down = stride[s];
        const int32_t* rows = &pattern[start[s]];
        for (int64_t c = width - 3; c >= 0; c -= 3) {
            const double* panel = &panels[offset[s]] + c;
            double* own = at(rows, c);
            for (int64_t r = c + 3; r < height; r += 3)
                Tile(panel + r * down, 1, down, -1.0).add(at(rows, r), own);
            solve_three<true>(panel + c * down, down, own);
        }
    }
}

// r'C^-1 r and ln det C.
struct Normalised {
    double square, log_det;
};

// Turn C (k, k) into its Cholesky factor L, and find u = L^-1 r. whole : (k,) the diagonal of which
// a pivot is a part. Where C is not definite beyond rounding, infinity and minus infinity.
// K : rows, 0: any number of them, k.
template <int K>
INLINE Normalised normalised(double* C, int64_t any, const double* whole, const double* residual,
                             double* u) {
    const int64_t k = K ? K : any;
    Normalised found{0.0, 0.0};
    double inverse[K ? K : 1];  // of the diagonal of L
    double product = 1.0;  // of pivots: logarithms take longest
    for (int64_t r = 0; r < k; r++) {
        double* row = C + r * k;
        for (int64_t c = 0; c < r; c++) {
            double value = row[c];
            for (int64_t e = 0; e < c; e++) value -= row[e] * C[c * k + e];
            row[c] = K ? value * inverse[K ? c : 0] : value / C[c * k + c];
        }
        double value = row[r], total = residual[r];
        for (int64_t e = 0; e < r; e++) value -= row[e] * row[e], total -= row[e] * u[e];
        if (!(value > DEFINITE * whole[r])) {
            constexpr double infinity = std::numeric_limits<double>::infinity();
            return {infinity, -infinity};
        }
        row[r] = std::sqrt(value);
        if constexpr (K > 0) inverse[r] = 1 / row[r];
        u[r] = total / row[r];
        found.square += u[r] * u[r];
        product *= value;
        if (!(product > 1e-100 && product < 1e100))
            found.log_det += std::log(product), product = 1.0;
    }
    found.log_det += std::log(product);
    return found;
}

using Squares = std::tuple<Vector<double>, Vector<double>>;

inline void check(Array<const double, 3> covariance, Matrix<const double> residual) {
    const int64_t k = residual.shape[1];
    require(covariance.size() == residual.size() && covariance.shape[1] == k &&
            covariance.shape[2] == k, "covariance must be (m, k, k), residual (m, k)");
}

template <int K>
Squares normalise_sized(Array<const double, 3> covariance, Matrix<const double> residual) {
    const int64_t m = residual.size(), k = K ? K : residual.shape[1];
    auto square = new_vector<double>(m), log_det = new_vector<double>(m);
    std::vector<double> factor(k * k), whole(k), u(k);
    for (int64_t f = 0; f < m; f++) {
        std::copy_n(covariance[f], k * k, factor.data());
        for (int64_t r = 0; r < k; r++) whole[r] = factor[r * (k + 1)];
        const Normalised found =
            normalised<K>(factor.data(), k, whole.data(), residual[f], u.data());
        square[f] = found.square, log_det[f] = found.log_det;
    }
    return {square, log_det};
}

// r'C^-1 r and ln det C of each factor, (m,) each; C (m, k, k).
inline Squares normalise(Array<const double, 3> covariance, Matrix<const double> residual) {
    check(covariance, residual);
    return FOR_SIZE(residual.shape[1], normalise_sized, covariance, residual);
}

template <int K>
Squares normalise_pairs_sized(Array<const double, 3> covariance, Matrix<const double> residual,
                              Matrix<const double> shared, Vector<const int64_t> first,
                              Vector<const int64_t> second) {
    const int64_t m = residual.size(), k = K ? K : residual.shape[1], pairs = first.size();
    auto square = new_vector<double>(pairs), log_det = new_vector<double>(pairs);
    std::vector<double> factor(covariance.data, covariance.data + m * k * k);
    std::vector<double> whole(m * k), u(m * k), inverse(m * k);
    std::vector<Normalised> own(m);
    for (int64_t f = 0; f < m; f++) {
        double* L = &factor[f * k * k];
        for (int64_t r = 0; r < k; r++) whole[f * k + r] = L[r * (k + 1)];
        own[f] = normalised<K>(L, k, &whole[f * k], residual[f], &u[f * k]);
        for (int64_t r = 0; r < k; r++) inverse[f * k + r] = 1 / L[r * (k + 1)];
    }
    // Of the second one what the first one does not explain: C - W'W, W = L^-1 of what they share.
    std::vector<double> W(k * k), C(k * k), left(k), unused(k);
    for (int64_t pair = 0; pair < pairs; pair++) {
        const int64_t a = first[pair], b = second[pair];
        const double *L = &factor[a * k * k], *between = &shared(a * k, b * k);
        std::copy_n(covariance[b], k * k, C.data());
        std::copy_n(residual[b], k, left.data());
        for (int64_t r = 0; r < k; r++) {
            double* row = &W[r * k];
            for (int64_t c = 0; c < k; c++) row[c] = between[r * m * k + c];
            for (int64_t e = 0; e < r; e++)
                for (int64_t c = 0; c < k; c++) row[c] -= L[r * k + e] * W[e * k + c];
            for (int64_t c = 0; c < k; c++) {
                row[c] *= inverse[a * k + r];
                left[c] -= row[c] * u[a * k + r];
            }
            for (int64_t d = 0; d < k; d++)
                for (int64_t c = 0; c < k; c++) C[d * k + c] -= row[d] * row[c];
        }
        const Normalised more =
            normalised<K>(C.data(), k, &whole[b * k], left.data(), unused.data());
        square[pair] = own[a].square + more.square;
        log_det[pair] = own[a].log_det + more.log_det;
    }
    return {square, log_det};
}

// What `normalise` does, of pairs of factors together, (pairs,) each. covariance : (m, k, k) of
// each; shared : (m k, m k) of all with all, what is read of it are the blocks of first and second
// ones.
inline Squares normalise_pairs(Array<const double, 3> covariance, Matrix<const double> residual,
                               Matrix<const double> shared, Vector<const int64_t> first,
                               Vector<const int64_t> second) {
    check(covariance, residual);
    const int64_t m = residual.size(), k = residual.shape[1], pairs = first.size();
    require(shared.shape[0] == m * k && shared.shape[1] == m * k, "shared must be (m k, m k)");
    require(second.size() == pairs, "second must have as many entries as first");
    bool fits = true;
    for (int64_t pair = 0; pair < pairs; pair++)
        fits &= first[pair] >= 0 && first[pair] < m && second[pair] >= 0 && second[pair] < m;
    require(fits, "first and second must be rows of residual");
    return FOR_SIZE(k, normalise_pairs_sized, covariance, residual, shared, first, second);
}

static PyMethodDef methods[] = {
    BY_SIZE(gather, "keyframe, blocks, y, product"),
    BY_SIZE(solve_many, "panels, " PANELS_NAMES ", position, right"),
    BY_SIZE(left_over, "keyframe, blocks, x, y"),
    BY_SIZE(moved, "keyframe, blocks, x"),
    BY_SIZE(normalise, "covariance, residual"),
    BY_SIZE(normalise_pairs, "covariance, residual, shared, first, second"),
    {}};

}  // namespace prediction
