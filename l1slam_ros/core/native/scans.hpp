// SPDX-License-Identifier: Apache-2.0
// Point-to-line matching of scans; see the module of the same name.
#pragma once
#include <algorithm>
#include <cmath>

#include "arrays.hpp"

namespace scans {

// Add up the sums of one Gauss-Newton step, (17,); arguments and weights as in `scans.kernels`.
inline void normal_equations(Matrix<double> points, Matrix<double> normals,
                             Matrix<double> map_points, Matrix<double> map_normals,
                             Matrix<int32_t> nearest, Vector<double> origin, double resolution,
                             Vector<double> pose, double gate, double scale, int64_t together,
                             Vector<double> sums) {
    const double c = std::cos(pose[2]), s = std::sin(pose[2]);
    double group[3] = {0.0, 0.0, 0.0};
    auto end_group = [&] {
        for (int i = 0, at = 6; i < 3; i++) {
            for (int j = i; j < 3; j++) sums[at++] += group[i] * group[j];
            sums[12 + i] += group[i];
        }
        group[0] = group[1] = group[2] = 0.0;
    };
    for (int64_t k = 0; k < points.size(); k++) {
        if (k % together == 0) end_group();
        double px = points(k, 0), py = points(k, 1);
        double x = c * px - s * py + pose[0], y = s * px + c * py + pose[1];
        auto column = int64_t(std::floor((x - origin[0]) / resolution));
        auto row = int64_t(std::floor((y - origin[1]) / resolution));
        if (column < 0 || row < 0 || column >= nearest.shape[0] || row >= nearest.shape[1])
            continue;
        int32_t m = nearest(column, row);
        if (m < 0) continue;
        double dx = x - map_points(m, 0), dy = y - map_points(m, 1);
        if (dx * dx + dy * dy > gate * gate) continue;
        double nx = map_normals(m, 0), ny = map_normals(m, 1);
        // The normal, seen from the moving pose.
        double ux = c * nx + s * ny, uy = c * ny - s * nx;
        if (ux * normals(k, 0) + uy * normals(k, 1) < 0.7071) continue;
        double e = nx * dx + ny * dy, turn = uy * px - ux * py;
        double w = 1.0 / (1.0 + (e / scale) * (e / scale));
        sums[0] += w * ux * ux, sums[1] += w * ux * uy, sums[2] += w * ux * turn;
        sums[3] += w * uy * uy, sums[4] += w * uy * turn, sums[5] += w * turn * turn;
        group[0] += w * ux * e, group[1] += w * uy * e, group[2] += w * turn * e;
        sums[15] += 1.0, sums[16] += w * e * e;
    }
    end_group();
}

// Eigenvalues and eigenvectors (columns) of a symmetric matrix, by Jacobi's rotations.
inline void eigen(double (&A)[3][3], double (&V)[3][3]) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) V[r][c] = r == c;
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = A[0][1] * A[0][1] + A[0][2] * A[0][2] + A[1][2] * A[1][2];
        double own = A[0][0] * A[0][0] + A[1][1] * A[1][1] + A[2][2] * A[2][2];
        if (!(off > 1e-32 * own)) return;
        for (int p = 0; p < 2; p++)
            for (int q = p + 1; q < 3; q++) {
                if (A[p][q] == 0.0) continue;
                double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
                double c = 1 / std::sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 3; k++) {
                    double a = A[k][p], b = A[k][q];
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

// The sums without what is said of a direction by the errors of normals alone.
inline void hold(double (&H)[3][3], double (&g)[3], const double* units, double off_normal) {
    double A[3][3], V[3][3], part[3], along[3];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) A[r][c] = H[r][c] * units[r] * units[c];
    double noise = off_normal * off_normal * (H[0][0] + H[1][1]);
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
}

// All Gauss-Newton steps of a match: moves the pose, (3,), writes H, (3, 3), and the last sums.
inline void descend(Matrix<double> points, Matrix<double> normals, Matrix<double> map_points,
                    Matrix<double> map_normals, Matrix<int32_t> nearest, Vector<double> origin,
                    Vector<double> numbers, Vector<double> prior, Matrix<double> information,
                    Vector<double> units, Vector<double> pose, Matrix<double> H_out,
                    Vector<double> sums) {
    const double resolution = numbers[0], scale = numbers[1], variance = numbers[2];
    const double off_normal = numbers[3], narrowest = numbers[5], shrink = numbers[6];
    const double still = numbers[7], most = numbers[8];
    double gate = numbers[4];
    double H[3][3] = {};
    for (int round = 0; round < most; round++) {
        std::fill_n(sums.data, 17, 0.0);
        normal_equations(points, normals, map_points, map_normals, nearest, origin, resolution,
                         pose, gate, scale, int64_t(numbers[9]), sums);
        static const int at[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
        double g[3] = {sums[12], sums[13], sums[14]}, A[3][3], b[3];
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) H[r][c] = sums[at[r][c]];
        hold(H, g, units.data, off_normal);
        // t2v(prior^-1 pose), and its derivative by a step of the pose.
        double c = std::cos(prior[2]), s = std::sin(prior[2]);
        double dx = pose[0] - prior[0], dy = pose[1] - prior[1];
        double expected[3] = {c * dx + s * dy, c * dy - s * dx, pose[2] - prior[2]};
        expected[2] -= 2 * M_PI * std::rint(expected[2] / (2 * M_PI));
        double ce = std::cos(expected[2]), se = std::sin(expected[2]);
        const double J[3][3] = {{ce, -se, 0}, {se, ce, 0}, {0, 0, 1}};
        double W[3][3];
        for (int r = 0; r < 3; r++)
            for (int q = 0; q < 3; q++) {
                W[r][q] = 0.0;
                for (int k = 0; k < 3; k++) W[r][q] += J[k][r] * information(k, q);
            }
        for (int r = 0; r < 3; r++) {
            b[r] = g[r] / variance;
            for (int k = 0; k < 3; k++) b[r] += W[r][k] * expected[k];
            for (int q = 0; q < 3; q++) {
                A[r][q] = H[r][q] / variance + (r == q) * 1e-9;
                for (int k = 0; k < 3; k++) A[r][q] += W[r][k] * J[k][q];
            }
        }
        double step[3], l00 = std::sqrt(A[0][0]), l10 = A[1][0] / l00, l20 = A[2][0] / l00;
        double l11 = std::sqrt(A[1][1] - l10 * l10), l21 = (A[2][1] - l20 * l10) / l11;
        double l22 = std::sqrt(A[2][2] - l20 * l20 - l21 * l21);
        double y0 = b[0] / l00, y1 = (b[1] - l10 * y0) / l11;
        step[2] = -(b[2] - l20 * y0 - l21 * y1) / l22 / l22;
        step[1] = (-y1 - l21 * step[2]) / l11;
        step[0] = (-y0 - l10 * step[1] - l20 * step[2]) / l00;
        double cp = std::cos(pose[2]), sp = std::sin(pose[2]);
        pose[0] += cp * step[0] - sp * step[1], pose[1] += sp * step[0] + cp * step[1];
        pose[2] += step[2];
        pose[2] -= 2 * M_PI * std::rint(pose[2] / (2 * M_PI));
        bool narrow = gate <= narrowest;
        gate = std::max(gate * shrink, narrowest);
        if (narrow && std::abs(step[0]) < still && std::abs(step[1]) < still &&
            std::abs(step[2]) < still)
            break;
    }
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) H_out(r, c) = H[r][c];
}

static PyMethodDef methods[] = {
    FUNCTION(normal_equations,
             "points, normals, map_points, map_normals, nearest, origin, resolution, pose, "
             "gate, scale, together, sums"),
    FUNCTION(descend,
             "points, normals, map_points, map_normals, nearest, origin, numbers, prior, "
             "information, units, pose, H_out, sums"),
    {}};

}  // namespace scans
