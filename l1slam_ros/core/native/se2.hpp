// SPDX-License-Identifier: Apache-2.0
// SE(2) factor by factor: the residual e = t2v(Z^-1 Xi^-1 Xj), its Jacobians and its curvature.
#pragma once
#include <cmath>
#include <memory>

#include "arrays.hpp"

namespace se2 {

// Poses (x, y, theta), (n, 3), or other three numbers of each factor.
using Poses = Matrix<const double>;

inline void check(Poses z, Poses x_i, Poses x_j) {
    require(z.shape[1] == 3, "z must be (n, 3)");
    require(x_i.shape[0] == z.size() && x_i.shape[1] == 3, "x_i must be (n, 3), like z");
    require(x_j.shape[0] == z.size() && x_j.shape[1] == 3, "x_j must be (n, 3), like z");
}

constexpr double PI = 3.14159265358979323846;
// Polynomials of sine and cosine from -pi/4 to pi/4. Source: fdlibm, k_sin.c, k_cos.c.
constexpr double SINE[] = {-1.66666666666666324348e-01, 8.33333333332248946124e-03,
                           -1.98412698298579493134e-04, 2.75573137070700676789e-06,
                           -2.50507602534068634195e-08, 1.58969099521155010221e-10};
constexpr double COSINE[] = {4.16666666666666019037e-02, -1.38888888888741095749e-03,
                             2.48015872894767294178e-05, -2.75573143513906633035e-07,
                             2.08757232129817482790e-09, -1.13596475577881948265e-11};

// Cosines and sines of the angles of poses: all at once, so that it is done by vectors. As exact
// as for an angle that differs by the rounding of this one. NaN and infinity become NaN; an angle
// so large that its rounding is a turn becomes some other angle.
struct Turns {
    std::unique_ptr<double[]> c, s;

    explicit Turns(Poses poses)
        : c(new double[poses.size()]), s(new double[poses.size()]) {
        double *to_c = c.get(), *to_s = s.get();
        const double* from = poses.data + 2;
        const int64_t count = poses.size();
#pragma GCC ivdep
        for (int64_t k = 0; k < count; k++) {
            double angle = from[3 * k];
            double quarters = std::rint(angle * (2 / PI)), r = angle - quarters * (PI / 2);
            r = std::abs(r) > 1.0 ? 0.0 : r;
            double w = r * r;
            double sine = SINE[0] + w * (SINE[1] + w * (SINE[2] + w * (SINE[3] + w * (
                SINE[4] + w * SINE[5]))));
            double cosine = COSINE[0] + w * (COSINE[1] + w * (COSINE[2] + w * (COSINE[3] + w * (
                COSINE[4] + w * COSINE[5]))));
            sine = r + r * w * sine;
            cosine = 1 - w / 2 + w * w * cosine;
            double quadrant = quarters - 4 * std::floor(quarters / 4);
            bool is_odd = (quadrant == 1) | (quadrant == 3);
            double along = is_odd ? sine : cosine, across = is_odd ? cosine : sine;
            to_c[k] = ((quadrant == 1) | (quadrant == 2)) ? -along : along;
            to_s[k] = quadrant >= 2 ? -across : across;
        }
    }
};

// An angle [rad] in (-pi, pi].
inline double wrapped(double angle) {
    angle -= 2 * PI * std::rint(angle / (2 * PI));
    return angle <= -PI || angle > PI ? PI : angle;  // NaN stays
}

// The position of j seen from i, Ri'(tj - ti); c, s : cosine and sine of i's angle.
struct Seen {
    double x, y;
    Seen(const double* i, const double* j, double c, double s)
        : x(c * (j[0] - i[0]) + s * (j[1] - i[1])), y(c * (j[1] - i[1]) - s * (j[0] - i[0])) {}
};

// a b.
inline void compose(const double* a, const double* b, double c, double s, double* product) {
    product[0] = a[0] + c * b[0] - s * b[1];
    product[1] = a[1] + s * b[0] + c * b[1];
    product[2] = wrapped(a[2] + b[2]);
}
inline void compose(const double* a, const double* b, double* product) {
    compose(a, b, std::cos(a[2]), std::sin(a[2]), product);
}

// Poses moved by right steps: a pose and its tangent share their coordinates.
inline Matrix<double> retract(Poses pose, Poses step) {
    require(pose.shape[1] == 3, "pose must be (n, 3)");
    require(step.size() == pose.size() && step.shape[1] == 3, "step must be (n, 3), like pose");
    auto moved = new_array<double, 2>({pose.size(), 3});
    const Turns of(pose);
    for (int64_t f = 0; f < pose.size(); f++)
        compose(pose[f], step[f], of.c[f], of.s[f], moved[f]);
    return moved;
}

inline Matrix<double> residual(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto e = new_array<double, 2>({z.shape[0], 3});
    Turns of_z(z), of_i(x_i);
    for (int64_t f = 0; f < z.size(); f++) {
        const double *i = x_i[f], *j = x_j[f], *m = z[f];
        double c = of_z.c[f], s = of_z.s[f];
        Seen t(i, j, of_i.c[f], of_i.s[f]);
        e(f, 0) = c * (t.x - m[0]) + s * (t.y - m[1]);
        e(f, 1) = c * (t.y - m[1]) - s * (t.x - m[0]);
        e(f, 2) = wrapped(j[2] - i[2] - m[2]);
    }
    return e;
}

inline Array<double, 4> jacobians(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto J = new_array<double, 4>({z.shape[0], 2, 3, 3});
    Turns of_z(z), of_i(x_i), of_j(x_j);
    for (int64_t f = 0; f < z.size(); f++) {
        double c = of_z.c[f], s = of_z.s[f], c_i = of_i.c[f], s_i = of_i.s[f];
        Seen t(x_i[f], x_j[f], c_i, s_i);
        double c_ij = c_i * of_j.c[f] + s_i * of_j.s[f], s_ij = c_i * of_j.s[f] - s_i * of_j.c[f];
        double c_phi = c * c_ij + s * s_ij, s_phi = c * s_ij - s * c_ij;
        double* to = J[f];
        to[0] = -c, to[1] = -s, to[2] = c * t.y - s * t.x;
        to[3] = s, to[4] = -c, to[5] = -s * t.y - c * t.x;
        to[6] = 0, to[7] = 0, to[8] = -1;
        to[9] = c_phi, to[10] = -s_phi, to[11] = 0;
        to[12] = s_phi, to[13] = c_phi, to[14] = 0;
        to[15] = 0, to[16] = 0, to[17] = 1;
    }
    return J;
}

inline Array<double, 4> curvature(Poses z, Poses x_i, Poses x_j, Poses dual) {
    check(z, x_i, x_j);
    require(dual.size() == z.size() && dual.shape[1] == 3, "dual must be (n, 3), like z");
    auto H = new_array<double, 4>({z.shape[0], 2, 1, 6});
    Turns of_z(z), of_i(x_i), of_j(x_j);
    for (int64_t f = 0; f < z.size(); f++) {
        double c = of_z.c[f], s = of_z.s[f], c_i = of_i.c[f], s_i = of_i.s[f];
        Seen t(x_i[f], x_j[f], c_i, s_i);
        double mx = c * dual(f, 0) - s * dual(f, 1), my = s * dual(f, 0) + c * dual(f, 1);
        c = c_i * of_j.c[f] + s_i * of_j.s[f], s = c_i * of_j.s[f] - s_i * of_j.c[f];
        double* to = H[f];
        to[0] = my, to[1] = -mx, to[2] = -(mx * t.x + my * t.y);
        to[3] = s * mx - c * my, to[4] = c * mx + s * my;
        for (int k = 5; k < 12; k++) to[k] = 0.0;
    }
    return H;
}

static PyMethodDef methods[] = {
    BY_SIZE(retract, "pose, step"),
    BY_SIZE(residual, "z, x_i, x_j"),
    BY_SIZE(jacobians, "z, x_i, x_j"),
    BY_SIZE(curvature, "z, x_i, x_j, dual"),
    {}};

}  // namespace se2
