// SPDX-License-Identifier: Apache-2.0
// A sparse factorisation bordered by later factors: covariances, and a dense factor that grows.
// Triangular matrices are stored row by row, row r from r (r + 1) / 2 on.
#pragma once
#include <algorithm>
#include <vector>

#include "arrays.hpp"

namespace border {

using Blocks = Array<double, 3>;

// The covariance of points s and t: entry (r, c) of it.
struct Between {
    const double* data;
    int64_t row, column;
    Between(const Blocks& covariance, int64_t s, int64_t t) {
        int64_t k = covariance.shape[2];
        data = covariance[s <= t ? t * (t + 1) / 2 + s : s * (s + 1) / 2 + t];
        row = s <= t ? k : 1, column = s <= t ? 1 : k;
    }
    double operator()(int64_t r, int64_t c) const { return data[r * row + c * column]; }
};

// The covariances of all points with a new one that hangs on `parent`, (t, k, k).
inline void follow(Blocks covariance, int64_t parent, Matrix<double> turn, Matrix<double> noise,
                   Blocks product) {
    int64_t last = product.size() - 1, k = turn.size();
    std::fill_n(product.data, last * k * k, 0.0);
    std::copy_n(noise.data, k * k, product[last]);
    if (parent < 0) return;
    for (int64_t s = 0; s < last; s++) {
        Between with(covariance, parent, s);
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c < k; c++)
                for (int64_t e = 0; e < k; e++)
                    product[s][c * k + r] += turn(r, e) * with(e, c);
    }
    for (int64_t r = 0; r < k; r++)
        for (int64_t c = 0; c < k; c++)
            for (int64_t e = 0; e < k; e++)
                product[last][r * k + c] += turn(r, e) * product[parent][e * k + c];
}

// Turn rows (m, n) into rows F^-T in place.
inline void reduce(const double* factor, Matrix<double> rows) {
    for (int64_t r = 0; r < rows.shape[1]; r++) {
        const double* line = factor + r * (r + 1) / 2;
        for (int64_t q = 0; q < rows.size(); q++) {
            double *row = rows[q], total = row[r];
            for (int64_t c = 0; c < r; c++) total -= line[c] * row[c];
            row[r] = total / line[r];
        }
    }
}

// The rows of a factor, reduced by those before, what is said of J x, and what is expected.
inline void predict(Blocks covariance, Matrix<double> mean, Matrix<int64_t> ends,
                    Array<double, 4> blocks, Vector<double> factor, Vector<double> right,
                    Vector<int64_t> own_ends, Blocks own_blocks, Matrix<double> rows,
                    Matrix<double> said, Vector<double> expected) {
    int64_t k = rows.size(), width = rows.shape[1];
    std::fill_n(rows.data, k * width, 0.0);
    std::fill_n(said.data, k * k, 0.0);
    auto add = [k](const double* left, Between middle, const double* other, double* to,
                   int64_t stride) {
        for (int64_t r = 0; r < k; r++)
            for (int64_t e = 0; e < k; e++) {
                double total = 0.0;
                for (int64_t c = 0; c < k; c++) total += left[r * k + c] * middle(c, e);
                for (int64_t c = 0; c < k; c++) to[r * stride + c] += total * other[c * k + e];
            }
    };
    for (int side = 0; side < 2; side++) {
        int64_t end = own_ends[side];
        const double* own = own_blocks[side];
        if (end < 0) continue;
        for (int64_t b = 0; b < ends.size(); b++)
            for (int other = 0; other < 2; other++)
                if (ends(b, other) >= 0)
                    add(own, Between(covariance, end, ends(b, other)), blocks[b] + other * k * k,
                        rows.data + b * k, width);
        for (int other = 0; other < 2; other++)
            if (own_ends[other] >= 0)
                add(own, Between(covariance, end, own_ends[other]), own_blocks[other], said.data,
                    k);
        for (int64_t r = 0; r < k; r++)
            for (int64_t c = 0; c < k; c++) expected[r] += own[r * k + c] * mean(end, c);
    }
    reduce(factor.data, rows);
    for (int64_t r = 0; r < k; r++) {
        for (int64_t e = 0; e < width; e++) expected[r] += rows(r, e) * right[e];
        for (int64_t c = 0; c <= r; c++) {
            double total = (said(r, c) + said(c, r)) / 2;
            for (int64_t e = 0; e < width; e++) total -= rows(r, e) * rows(c, e);
            said(r, c) = said(c, r) = total;
        }
    }
}

// Add to the gradient (t, k) what factors pull at points: A'lambda, F'lambda = right.
inline void pull(Vector<double> factor, Vector<double> right, Matrix<int64_t> ends,
                 Array<double, 4> blocks, Matrix<double> gradient) {
    int64_t k = gradient.shape[1];
    std::vector<double> x(right.data, right.data + right.size());
    for (int64_t r = right.size() - 1; r >= 0; r--) {
        const double* line = &factor.data[r * (r + 1) / 2];
        x[r] /= line[r];
        for (int64_t c = 0; c < r; c++) x[c] -= line[c] * x[r];
    }
    for (int64_t b = 0; b < ends.size(); b++)
        for (int side = 0; side < 2; side++)
            if (int64_t end = ends(b, side); end >= 0)
                for (int64_t r = 0; r < k; r++)
                    for (int64_t c = 0; c < k; c++)
                        gradient(end, c) += blocks[b][(side * k + r) * k + c] * x[b * k + r];
}

// The steps of some points, (m, k), -1 for none, by what pulls at all of them.
inline Matrix<double> move(Blocks covariance, Matrix<double> mean, Matrix<double> gradient,
                           Vector<int64_t> points) {
    int64_t k = gradient.shape[1];
    auto steps = new_array<double, 2>({points.shape[0], k});
    for (int64_t m = 0; m < points.size(); m++) {
        double* step = steps[m];
        std::fill_n(step, k, 0.0);
        if (points[m] < 0) continue;
        std::copy_n(mean[points[m]], k, step);
        for (int64_t other = 0; other < gradient.size(); other++) {
            Between between(covariance, points[m], other);
            for (int64_t r = 0; r < k; r++)
                for (int64_t c = 0; c < k; c++) step[r] += between(r, c) * gradient(other, c);
        }
    }
    return steps;
}

static PyMethodDef methods[] = {
    BRIEF(follow, "covariance, parent, turn, noise, product"),
    BRIEF(predict,
             "covariance, mean, ends, blocks, factor, right, own_ends, own_blocks, rows, "
             "said, expected"),
    BRIEF(pull, "factor, right, ends, blocks, gradient"),
    BRIEF(move, "covariance, mean, gradient, points"),
    {}};

}  // namespace border
