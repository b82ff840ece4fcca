// SPDX-License-Identifier: Apache-2.0
// Covariances of measurements, as `core/geometry/noise.py` reads them.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "arrays.hpp"

namespace noise {

// A = L L' of d x d in place, below the diagonal too; false: it is not positive definite.
inline bool root_of(double* a, int64_t d) {
    for (int64_t r = 0; r < d; r++)
        for (int64_t c = 0; c <= r; c++) {
            double left = a[r * d + c];
            for (int64_t e = 0; e < c; e++) left -= a[r * d + e] * a[c * d + e];
            if (r == c && !(left > 0.0)) return false;
            a[r * d + c] = r == c ? std::sqrt(left) : left / a[c * d + c];
        }
    return true;
}

// Which of (m, d, d) matrices are finite, symmetric but for `asymmetry` of their largest entry,
// and positive definite: the least eigenvalue of the correlation is above `singular`.
inline Vector<bool> usable(Array<const double, 3> covariance, double asymmetry, double singular) {
    const int64_t d = covariance.shape[1];
    require(covariance.shape[2] == d, "covariance of (m, d, d)");
    auto found = new_vector<bool>(covariance.size());
    std::vector<double> a(d * d);
    for (int64_t m = 0; m < covariance.size(); m++) {
        const double* C = covariance[m];
        double scale = 0.0, skew = 0.0;
        bool sound = true;
        for (int64_t r = 0; r < d; r++)
            for (int64_t c = 0; c < d; c++) {
                sound &= std::isfinite(C[r * d + c]);
                scale = std::max(scale, std::abs(C[r * d + c]));
                skew = std::max(skew, std::abs(C[r * d + c] - C[c * d + r]));
            }
        sound = sound && skew <= asymmetry * scale;
        for (int64_t r = 0; r < d; r++) sound &= C[r * d + r] > 0.0;
        for (int64_t r = 0; sound && r < d; r++)
            for (int64_t c = 0; c < d; c++) {
                double entry = C[r * d + c] / std::sqrt(C[r * d + r]) / std::sqrt(C[c * d + c]);
                // A correlation above 1 is not definite; neither is it if it is clipped.
                a[r * d + c] = std::min(std::max(entry, -2.0), 2.0) - (r == c ? singular : 0.0);
            }
        found[m] = sound && root_of(a.data(), d);
    }
    return found;
}

// The upper triangular roots L' of the inverses of (m, d, d) covariances, inverse = L L'; zeros in
// rows and columns without a variance.
inline Array<double, 3> root_of_inverse(Array<const double, 3> covariance) {
    const int64_t d = covariance.shape[1];
    require(covariance.shape[2] == d, "covariance of (m, d, d)");
    auto roots = new_array<double, 3>({covariance.size(), d, d});
    std::vector<double> a(d * d);
    for (int64_t m = 0; m < covariance.size(); m++) {
        const double* C = covariance[m];
        // From the last row up: U U', U upper triangular, and L' = U^-1.
        for (int64_t r = 0; r < d; r++)
            for (int64_t c = 0; c < d; c++) {
                const int64_t i = d - 1 - r, j = d - 1 - c;
                const bool silent = C[i * d + i] == 0.0 || C[j * d + j] == 0.0;
                a[r * d + c] = silent ? double(r == c) : C[i * d + j];
            }
        require(root_of(a.data(), d), "covariances that are positive definite");
        double* L = roots[m];
        std::fill_n(L, d * d, 0.0);
        // Column c of the inverse of the lower triangle, turned round.
        for (int64_t c = 0; c < d; c++)
            for (int64_t r = c; r < d; r++) {
                double total = r == c ? 1.0 : 0.0;
                for (int64_t e = c; e < r; e++)
                    total -= a[r * d + e] * L[(d - 1 - e) * d + d - 1 - c];
                L[(d - 1 - r) * d + d - 1 - c] = total / a[r * d + r];
            }
        for (int64_t r = 0; r < d; r++)
            for (int64_t c = 0; c < d; c++)
                if (C[r * d + r] == 0.0 || C[c * d + c] == 0.0) L[r * d + c] = 0.0;
    }
    return roots;
}

static PyMethodDef methods[] = {
    BRIEF(usable, "covariance, asymmetry, singular"),
    BRIEF(root_of_inverse, "covariance"),
    {}};

}  // namespace noise
