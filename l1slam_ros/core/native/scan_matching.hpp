// SPDX-License-Identifier: Apache-2.0
// Point-to-line matching of a scan with a map; see `l1slam_ros.core.scans.matching`.
//
// A pose is x, y [m] and heading [rad]; it maps points of the moving scan into the frame of the
// map. Steps, gradients and H are in the axes of the moving pose.
#pragma once
#include <algorithm>
#include <cmath>
#include <tuple>

#include "arrays.hpp"
#include "se2.hpp"

namespace scan_matching {

// [m] The gate of the first round becomes narrower with each, down to this.
constexpr double NARROWEST = 0.15, SHRINK = 0.75;
constexpr int MOST_ROUNDS = 20;
// [m], [rad] A step that is no step any more.
constexpr double STILL = 1e-4;
// What a step is held by where neither points nor a prior hold it.
constexpr double LEAST = 1e-9;
// Normals that differ by more than 45 degrees do not match.
constexpr double ALIKE = 0.7071;
// Points of so many in a row, about half a metre, may be off by one cause.
constexpr int64_t TOGETHER = 10;

// The moving scan, and the map with its look-up of the nearest point.
struct Matched {
    Matrix<const double> points, normals, map_points, map_normals;
    Matrix<const int32_t> nearest;
    Vector<const double> origin;
    double resolution;

    void check() const {
        require(points.shape[1] == 2 && normals.shape[1] == 2 && map_points.shape[1] == 2 &&
                    map_normals.shape[1] == 2,
                "points, normals, map_points and map_normals must have two columns");
        require(normals.size() == points.size(), "normals must be as many as points");
        require(map_normals.size() == map_points.size(), "map_normals must be as map_points");
        require(origin.size() == 2, "origin must have two entries");
        require(resolution > 0, "resolution must be positive");
    }
};

// What one step of Gauss-Newton is made of: see `normal_equations`.
struct Sums {
    double H[6], scatter[6], g[3], count, square;
};
static_assert(sizeof(Sums) == 17 * sizeof(double), "an array of Python's");

// Add up the sums: the residual of a point p with the map's nearest point m and its normal n is
// n'(R p + t - m). Weights are Cauchy's, 1 / (1 + (e / scale)^2).
inline Sums sums_of(const Matched& of, const double* pose, double gate, double scale) {
    Sums sums{};
    const double c = std::cos(pose[2]), s = std::sin(pose[2]);
    const double columns = double(of.nearest.shape[0]), rows = double(of.nearest.shape[1]);
    const auto known = uint64_t(of.map_points.size());
    double group[3] = {0.0, 0.0, 0.0};
    auto end_group = [&] {
        for (int i = 0, at = 0; i < 3; i++) {
            for (int j = i; j < 3; j++) sums.scatter[at++] += group[i] * group[j];
            sums.g[i] += group[i];
        }
        group[0] = group[1] = group[2] = 0.0;
    };
    for (int64_t k = 0, left = TOGETHER; k < of.points.size(); k++, left--) {
        if (left == 0) end_group(), left = TOGETHER;
        const double px = of.points(k, 0), py = of.points(k, 1);
        const double x = c * px - s * py + pose[0], y = s * px + c * py + pose[1];
        const double u = (x - of.origin[0]) / of.resolution;
        const double v = (y - of.origin[1]) / of.resolution;
        if (!(u >= 0 && v >= 0 && u < columns && v < rows)) continue;
        const auto m = uint64_t(int64_t(of.nearest(int64_t(u), int64_t(v))));
        if (m >= known) continue;  // -1: none is near
        const double* at = of.map_points[int64_t(m)];
        const double* normal = of.map_normals[int64_t(m)];
        const double dx = x - at[0], dy = y - at[1];
        if (dx * dx + dy * dy > gate * gate) continue;
        // The normal, seen from the moving pose.
        const double ux = c * normal[0] + s * normal[1], uy = c * normal[1] - s * normal[0];
        if (ux * of.normals(k, 0) + uy * of.normals(k, 1) < ALIKE) continue;
        const double e = normal[0] * dx + normal[1] * dy, turn = uy * px - ux * py;
        const double w = 1.0 / (1.0 + (e / scale) * (e / scale));
        sums.H[0] += w * ux * ux, sums.H[1] += w * ux * uy, sums.H[2] += w * ux * turn;
        sums.H[3] += w * uy * uy, sums.H[4] += w * uy * turn, sums.H[5] += w * turn * turn;
        group[0] += w * ux * e, group[1] += w * uy * e, group[2] += w * turn * e;
        sums.count += 1.0, sums.square += w * e * e;
    }
    end_group();
    return sums;
}

using Three = double[3][3];

inline void fill_symmetric(const double* upper, Three& whole) {
    for (int r = 0, at = 0; r < 3; r++)
        for (int c = r; c < 3; c++) whole[r][c] = whole[c][r] = upper[at++];
}

// Eigenvalues (the diagonal of A) and eigenvectors (columns of V) of a symmetric matrix.
// Source: Jacobi's rotations; Golub and Van Loan, "Matrix Computations", section 8.5.
inline void eigen(Three& A, Three& V) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) V[r][c] = r == c;
    for (int sweep = 0; sweep < 30; sweep++) {
        const double off = A[0][1] * A[0][1] + A[0][2] * A[0][2] + A[1][2] * A[1][2];
        const double own = A[0][0] * A[0][0] + A[1][1] * A[1][1] + A[2][2] * A[2][2];
        if (!(off > 1e-32 * own)) return;
        for (int p = 0; p < 2; p++)
            for (int q = p + 1; q < 3; q++) {
                if (A[p][q] == 0.0) continue;
                const double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                const double t =
                    (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
                const double c = 1 / std::sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 3; k++) {
                    const double a = A[k][p], b = A[k][q];
                    A[k][p] = c * a - s * b, A[k][q] = s * a + c * b;
                }
                for (int k = 0; k < 3; k++) {
                    double a = A[p][k], b = A[q][k];
                    A[p][k] = c * a - s * b, A[q][k] = s * a + c * b;
                    a = V[k][p], b = V[k][q];
                    V[k][p] = c * a - s * b, V[k][q] = s * a + c * b;
                }
            }
    }
}

// Take out of H and g what is said of a direction by the errors of normals alone, which are off
// by `off_normal` [rad]. Directions are compared in `units`; returns H's least eigenvalue in them.
inline double hold(Three& H, double (&g)[3], Vector<const double> units, double off_normal) {
    Three A, V;
    double part[3], along[3];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) A[r][c] = H[r][c] * units[r] * units[c];
    const double noise = off_normal * off_normal * (H[0][0] + H[1][1]);
    eigen(A, V);
    for (int k = 0; k < 3; k++) {
        part[k] = std::max(1 - noise / std::max(A[k][k], 1e-12), 0.0);
        along[k] = 0.0;
        for (int r = 0; r < 3; r++) along[k] += V[r][k] * units[r] * g[r];
    }
    for (int r = 0; r < 3; r++) {
        g[r] = 0.0;
        for (int k = 0; k < 3; k++) g[r] += V[r][k] / units[r] * part[k] * along[k];
        for (int c = 0; c < 3; c++) {
            H[r][c] = 0.0;
            for (int k = 0; k < 3; k++)
                H[r][c] += V[r][k] / units[r] * part[k] * A[k][k] * V[c][k] / units[c];
        }
    }
    return std::min({part[0] * A[0][0], part[1] * A[1][1], part[2] * A[2][2]});
}

// Add to A and b what a prior says: |t2v(prior^-1 pose)|^2 by its information.
inline void add_prior(const double* pose, const double* prior, Matrix<const double> information,
                      Three& A, double (&b)[3]) {
    const double c = std::cos(prior[2]), s = std::sin(prior[2]);
    const double dx = pose[0] - prior[0], dy = pose[1] - prior[1];
    const double off[3] = {c * dx + s * dy, c * dy - s * dx, se2::wrapped(pose[2] - prior[2])};
    const double ct = std::cos(off[2]), st = std::sin(off[2]);
    const Three J = {{ct, -st, 0}, {st, ct, 0}, {0, 0, 1}};
    for (int r = 0; r < 3; r++) {
        double weighted[3] = {};
        for (int q = 0; q < 3; q++)
            for (int k = 0; k < 3; k++) weighted[q] += J[k][r] * information(k, q);
        for (int k = 0; k < 3; k++) {
            b[r] += weighted[k] * off[k];
            for (int q = 0; q < 3; q++) A[r][q] += weighted[k] * J[k][q];
        }
    }
}

// Solve A x = b, A positive definite but for rounding: no pivot is less than what is added to it.
inline void solve(const Three& A, const double (&b)[3], double (&x)[3]) {
    const double d0 = std::max(A[0][0], LEAST), l10 = A[1][0] / d0, l20 = A[2][0] / d0;
    const double d1 = std::max(A[1][1] - l10 * A[1][0], LEAST);
    const double off = A[2][1] - l20 * A[1][0], l21 = off / d1;
    const double d2 = std::max(A[2][2] - l20 * A[2][0] - l21 * off, LEAST);
    const double y1 = b[1] - l10 * b[0], y2 = b[2] - l20 * b[0] - l21 * y1;
    x[2] = y2 / d2;
    x[1] = y1 / d1 - l21 * x[2];
    x[0] = b[0] / d0 - l10 * x[1] - l20 * x[2];
}

inline Vector<double> array_of(const Sums& sums) {
    auto made = new_vector<double>(17);
    std::memcpy(made.data, &sums, sizeof sums);
    return made;
}

// One step's sums, (17,): the upper triangle of H by rows (6), the same of the sum over groups of
// points of their part of g times itself (6), g (3), how many points match, and the sum of the
// weighted squared residuals.
inline Vector<double> normal_equations(
    Matrix<const double> points, Matrix<const double> normals, Matrix<const double> map_points,
    Matrix<const double> map_normals, Matrix<const int32_t> nearest, Vector<const double> origin,
    double resolution, Vector<const double> pose, double gate, double scale) {
    const Matched of{points, normals, map_points, map_normals, nearest, origin, resolution};
    of.check();
    require(pose.size() == 3, "pose must have three entries");
    return array_of(sums_of(of, pose.data, gate, scale));
}

// All rounds of Gauss-Newton from a pose on; returns the last pose, H without what `hold` takes
// out, its least eigenvalue, and the sums before it. `gate` is that of the first round, `variance`
// is of a residual.
inline std::tuple<Vector<double>, Matrix<double>, double, Vector<double>> match(
    Matrix<const double> points, Matrix<const double> normals, Matrix<const double> map_points,
    Matrix<const double> map_normals, Matrix<const int32_t> nearest, Vector<const double> origin,
    double resolution, Vector<const double> start, Vector<const double> prior,
    Matrix<const double> information, Vector<const double> units, double gate, double scale,
    double variance, double off_normal) {
    const Matched of{points, normals, map_points, map_normals, nearest, origin, resolution};
    of.check();
    require(start.size() == 3 && prior.size() == 3 && units.size() == 3,
            "start, prior and units must have three entries");
    require(information.shape[0] == 3 && information.shape[1] == 3, "information must be (3, 3)");
    auto end = new_vector<double>(3);
    auto held = new_array<double, 2>({3, 3});
    double* pose = end.data;
    std::copy_n(start.data, 3, pose);
    Three H;
    Sums sums{};
    double least = 0.0;
    for (int round = 0; round < MOST_ROUNDS; round++) {
        sums = sums_of(of, pose, gate, scale);
        fill_symmetric(sums.H, H);
        double g[3] = {sums.g[0], sums.g[1], sums.g[2]};
        least = hold(H, g, units, off_normal);
        Three A;
        double b[3], step[3];
        for (int r = 0; r < 3; r++) {
            b[r] = g[r] / variance;
            for (int q = 0; q < 3; q++) A[r][q] = H[r][q] / variance + (r == q ? LEAST : 0.0);
        }
        add_prior(pose, prior.data, information, A, b);
        solve(A, b, step);
        const double c = std::cos(pose[2]), s = std::sin(pose[2]);
        pose[0] -= c * step[0] - s * step[1];
        pose[1] -= s * step[0] + c * step[1];
        pose[2] = se2::wrapped(pose[2] - step[2]);
        const bool was_narrow = gate <= NARROWEST;
        gate = std::max(gate * SHRINK, NARROWEST);
        const double moved =
            std::max({std::abs(step[0]), std::abs(step[1]), std::abs(step[2])});
        if (was_narrow && moved < STILL) break;
    }
    std::copy_n(&H[0][0], 9, held.data);
    return {end, held, least, array_of(sums)};
}

// H over a variance [m^2], or less where `scatter`, the covariance of the gradient, is more than
// the variance times H: of each direction the greater of both counts.
inline Matrix<double> information(Matrix<const double> H, Vector<const double> scatter,
                                  double variance) {
    require(H.shape[0] == 3 && H.shape[1] == 3, "H must be (3, 3)");
    require(scatter.size() == 6, "scatter must have six entries");
    // With L L' = H: the eigenvectors of L^-1 scatter L^-T, and H L^-T times these.
    Three L = {}, A, V, root;
    for (int c = 0; c < 3; c++) {
        double square = H(c, c) + LEAST;
        for (int k = 0; k < c; k++) square -= L[c][k] * L[c][k];
        L[c][c] = std::sqrt(std::max(square, LEAST));
        for (int r = c + 1; r < 3; r++) {
            L[r][c] = H(r, c);
            for (int k = 0; k < c; k++) L[r][c] -= L[r][k] * L[c][k];
            L[r][c] /= L[c][c];
        }
    }
    fill_symmetric(scatter.data, A);
    for (int side = 0; side < 2; side++)  // from the left, and, transposed, from the right
        for (int c = 0; c < 3; c++)
            for (int r = 0; r < 3; r++) {
                double& entry = side ? A[c][r] : A[r][c];
                for (int k = 0; k < r; k++) entry -= L[r][k] * (side ? A[c][k] : A[k][c]);
                entry /= L[r][r];
            }
    eigen(A, V);
    for (int c = 0; c < 3; c++) {
        double x[3];
        for (int r = 2; r >= 0; r--) {
            x[r] = V[r][c];
            for (int k = r + 1; k < 3; k++) x[r] -= L[k][r] * x[k];
            x[r] /= L[r][r];
        }
        for (int r = 0; r < 3; r++)
            root[r][c] = H(r, 0) * x[0] + H(r, 1) * x[1] + H(r, 2) * x[2];
    }
    auto made = new_array<double, 2>({3, 3});
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) {
            made(r, c) = 0.0;
            for (int k = 0; k < 3; k++)
                made(r, c) +=
                    root[r][k] / std::max(A[k][k] / variance, 1.0) * root[c][k] / variance;
        }
    return made;
}

static PyMethodDef methods[] = {
    FUNCTION(normal_equations,
             "points, normals, map_points, map_normals, nearest, origin, resolution, pose, "
             "gate, scale"),
    FUNCTION(match,
             "points, normals, map_points, map_normals, nearest, origin, resolution, start, "
             "prior, information, units, gate, scale, variance, off_normal"),
    BRIEF(information, "H, scatter, variance"),
    {}};

}  // namespace scan_matching
