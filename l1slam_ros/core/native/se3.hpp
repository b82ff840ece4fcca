// SPDX-License-Identifier: Apache-2.0
// SE(3) factor by factor: the residual e = (t, 2 q_v) of Z^-1 Xi^-1 Xj, Jacobians, curvature.
#pragma once
#include <algorithm>
#include <cmath>
#include <limits>

#include "arrays.hpp"

namespace se3 {

// Poses (x, y, z, qx, qy, qz, qw), (n, 7).
using Poses = Matrix<const double>;

inline void check(Poses z, Poses x_i, Poses x_j) {
    require(z.shape[1] == 7, "z must be (n, 7)");
    require(x_i.shape[0] == z.size() && x_i.shape[1] == 7, "x_i must be (n, 7), like z");
    require(x_j.shape[0] == z.size() && x_j.shape[1] == 7, "x_j must be (n, 7), like z");
}

struct Point { double x, y, z; };
struct Quaternion { double x, y, z, w; };

inline Quaternion turn_of(const double* pose) { return {pose[3], pose[4], pose[5], pose[6]}; }

// The quaternion of R(a)' R(b).
inline Quaternion product(Quaternion a, Quaternion b) {
    return {a.w * b.x - a.x * b.w - a.y * b.z + a.z * b.y,
            a.w * b.y - a.y * b.w - a.z * b.x + a.x * b.z,
            a.w * b.z - a.z * b.w - a.x * b.y + a.y * b.x,
            a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z};
}

// R(q)' v.
inline Point turned_back(Quaternion q, Point v) {
    double a = 2 * (v.y * q.z - v.z * q.y), b = 2 * (v.z * q.x - v.x * q.z);
    double c = 2 * (v.x * q.y - v.y * q.x);
    return {v.x + q.w * a + b * q.z - c * q.y, v.y + q.w * b + c * q.x - a * q.z,
            v.z + q.w * c + a * q.y - b * q.x};
}

// A quaternion whose squared norm is that near to 1 is left as it is.
constexpr double UNIT = 4 * std::numeric_limits<double>::epsilon();

// Write a pose, its quaternion normalised, qw >= 0.
inline void write(Point t, Quaternion q, double* pose) {
    const double square = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w;
    double scale = std::abs(square - 1) <= UNIT ? 1.0 : 1 / std::sqrt(square);
    if (q.w < 0) scale = -scale;
    const double row[7] = {t.x, t.y, t.z, scale * q.x, scale * q.y, scale * q.z, scale * q.w};
    std::copy(row, row + 7, pose);
}

// A pose times another one, of which only the turn may differ from a pose's: (t, q).
inline void compose(const double* a, Point t, Quaternion q, double* to) {
    const Quaternion back{-a[3], -a[4], -a[5], a[6]};
    const Point moved = turned_back(back, t);
    write({a[0] + moved.x, a[1] + moved.y, a[2] + moved.z}, product(back, q), to);
}
inline void compose(const double* a, const double* b, double* to) {
    compose(a, {b[0], b[1], b[2]}, turn_of(b), to);
}

// A pose moved by a right step: (rho, exp omega).
inline void move(const double* pose, const double* step, double* to) {
    const double half = std::sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5]) / 2;
    const double scale = half == 0 ? 0.5 : std::sin(half) / (2 * half);
    compose(pose, {step[0], step[1], step[2]},
            {scale * step[3], scale * step[4], scale * step[5], std::cos(half)}, to);
}
inline Matrix<double> retract(Poses pose, Matrix<const double> step) {
    require(pose.shape[1] == 7, "pose must be (n, 7)");
    require(step.size() == pose.size() && step.shape[1] == 6, "step must be (n, 6), n as of pose");
    auto moved = new_array<double, 2>({pose.size(), 7});
    for (int64_t f = 0; f < pose.size(); f++) move(pose[f], step[f], moved[f]);
    return moved;
}

struct Square {
    double m[3][3];
    static Square of(Quaternion q) {
        double x = q.x, y = q.y, z = q.z, w = q.w;
        return {{{1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
                 {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
                 {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)}}};
    }
    static Square skew(Point v, double diagonal) {
        return {{{diagonal, -v.z, v.y}, {v.z, diagonal, -v.x}, {-v.y, v.x, diagonal}}};
    }
};

// Position and quaternion of j seen from i, and the quaternion of the error, qw >= 0.
struct Seen {
    Point p;
    Quaternion q_ij, q;
    Seen(const double* z, const double* i, const double* j)
        : p(turned_back(turn_of(i), {j[0] - i[0], j[1] - i[1], j[2] - i[2]})),
          q_ij(product(turn_of(i), turn_of(j))), q(product(turn_of(z), q_ij)) {
        if (q.w < 0) q = {-q.x, -q.y, -q.z, -q.w};
    }
};

inline void write_residual(const double* z, const double* i, const double* j, double* e) {
    Seen at(z, i, j);
    Point t = turned_back(turn_of(z), {at.p.x - z[0], at.p.y - z[1], at.p.z - z[2]});
    const double row[6] = {t.x, t.y, t.z, 2 * at.q.x, 2 * at.q.y, 2 * at.q.z};
    std::copy(row, row + 6, e);
}
inline Matrix<double> residual(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto e = new_array<double, 2>({z.shape[0], 6});
    for (int64_t f = 0; f < z.size(); f++) write_residual(z[f], x_i[f], x_j[f], e[f]);
    return e;
}

// J : (2, 6, 6) J_r_i and J_r_j.
inline void write_jacobians(const double* z, const double* i, const double* j, double* J) {
    Seen at(z, i, j);
    Square R_z = Square::of(turn_of(z)), R_ij = Square::of(at.q_ij);
    Square M = Square::skew({at.q.x, at.q.y, at.q.z}, at.q.w);
    double *of_i = J, *of_j = J + 36;
    std::fill_n(J, 72, 0.0);
    const double p[3] = {at.p.x, at.p.y, at.p.z};
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) {
            int a = (c + 1) % 3, b = (c + 2) % 3;
            of_i[r * 6 + c] = -R_z.m[c][r];
            // Row r of Rz' times [p]x is p x (column r of Rz), sign turned.
            of_i[r * 6 + 3 + c] = R_z.m[a][r] * p[b] - R_z.m[b][r] * p[a];
            of_j[(3 + r) * 6 + 3 + c] = M.m[r][c];
            for (int k = 0; k < 3; k++) {
                of_j[r * 6 + c] += R_z.m[k][r] * R_ij.m[k][c];
                of_i[(3 + r) * 6 + 3 + c] -= M.m[r][k] * R_ij.m[c][k];
            }
        }
}
inline Array<double, 4> jacobians(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto J = new_array<double, 4>({z.shape[0], 2, 6, 6});
    for (int64_t f = 0; f < z.size(); f++) write_jacobians(z[f], x_i[f], x_j[f], J[f]);
    return J;
}

inline Array<double, 4> curvature(Poses z, Poses x_i, Poses x_j,
                                  Matrix<const double> dual) {
    check(z, x_i, x_j);
    require(dual.size() == z.size() && dual.shape[1] == 6, "dual must be (n, 6), n as of z");
    auto H = new_array<double, 4>({z.shape[0], 2, 3, 12});
    for (int64_t f = 0; f < z.size(); f++) {
        Seen at(z[f], x_i[f], x_j[f]);
        const double *y = dual[f] + 3, p[3] = {at.p.x, at.p.y, at.p.z};
        Quaternion q = at.q;
        // R(-q)' turns forwards.
        Point mp = turned_back({-z(f, 3), -z(f, 4), -z(f, 5), z(f, 6)},
                               {dual(f, 0), dual(f, 1), dual(f, 2)});
        const double m[3] = {mp.x, mp.y, mp.z};
        double along = q.x * y[0] + q.y * y[1] + q.z * y[2];
        double pull = m[0] * p[0] + m[1] * p[1] + m[2] * p[2];
        Square R = Square::of(at.q_ij), S = Square::skew(mp, 0.0);
        Square K = Square::skew({q.w * y[0] - q.y * y[2] + q.z * y[1],
                                 q.w * y[1] - q.z * y[0] + q.x * y[2],
                                 q.w * y[2] - q.x * y[1] + q.y * y[0]}, along);
        double *of_i = H[f], *of_j = of_i + 36;
        std::fill_n(of_i, 72, 0.0);
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) {
                double toward = 0.0, turn = 0.0;
                for (int k = 0; k < 3; k++)
                    toward += S.m[r][k] * R.m[k][c], turn += R.m[r][k] * K.m[k][c] / 2;
                of_i[r * 12 + c] = -S.m[r][c];
                if (c <= r)  // the same bits on either side of the diagonal
                    of_i[r * 12 + 3 + c] = of_i[c * 12 + 3 + r] =
                        r == c ? m[r] * p[r] - pull - along / 2
                               : (m[r] * p[c] + p[r] * m[c]) / 2;
                of_i[r * 12 + 6 + c] = toward;
                of_i[r * 12 + 9 + c] = of_j[c * 12 + 3 + r] = turn;
                if (r == c) of_j[r * 12 + 9 + c] = -along / 2;
            }
    }
    return H;
}

static PyMethodDef methods[] = {
    BY_SIZE(retract, "pose, step"),
    BY_SIZE(residual, "z, x_i, x_j"),
    BY_SIZE(jacobians, "z, x_i, x_j"),
    BY_SIZE(curvature, "z, x_i, x_j, dual"),
    {}};

}  // namespace se3
