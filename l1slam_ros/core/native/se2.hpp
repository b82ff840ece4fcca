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

// Cosine and sine of an angle [rad].
struct Turn {
    double c, s;
};
inline Turn turn_of(double angle) { return {std::cos(angle), std::sin(angle)}; }

// Those of the angles of poses: all at once, so that it is done by vectors. As exact
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
    Turn operator[](int64_t k) const { return {c[k], s[k]}; }
};

// An angle [rad] in (-pi, pi].
inline double wrapped(double angle) {
    angle -= 2 * PI * std::rint(angle / (2 * PI));
    return angle <= -PI || angle > PI ? PI : angle;  // NaN stays
}

// The position of j seen from i, Ri'(tj - ti).
struct Seen {
    double x, y;
    Seen(const double* i, const double* j, Turn i_)
        : x(i_.c * (j[0] - i[0]) + i_.s * (j[1] - i[1])),
          y(i_.c * (j[1] - i[1]) - i_.s * (j[0] - i[0])) {}
};

// One row each; of_z, of_i, of_j : the turns of z, i and j.

// a b; `product` may be a.
inline void compose(const double* a, const double* b, Turn of_a, double* product) {
    product[0] = a[0] + of_a.c * b[0] - of_a.s * b[1];
    product[1] = a[1] + of_a.s * b[0] + of_a.c * b[1];
    product[2] = wrapped(a[2] + b[2]);
}
inline void compose(const double* a, const double* b, double* product) {
    compose(a, b, turn_of(a[2]), product);
}

inline void write_residual(const double* z, const double* i, const double* j, Turn of_z,
                           Turn of_i, double* e) {
    Seen t(i, j, of_i);
    e[0] = of_z.c * (t.x - z[0]) + of_z.s * (t.y - z[1]);
    e[1] = of_z.c * (t.y - z[1]) - of_z.s * (t.x - z[0]);
    e[2] = wrapped(j[2] - i[2] - z[2]);
}

// J : (2, 3, 3) J_r_i and J_r_j.
inline void write_jacobians(const double* i, const double* j, Turn of_z, Turn of_i, Turn of_j,
                            double* J) {
    const auto [c, s] = of_z;
    Seen t(i, j, of_i);
    double c_ij = of_i.c * of_j.c + of_i.s * of_j.s, s_ij = of_i.c * of_j.s - of_i.s * of_j.c;
    double c_phi = c * c_ij + s * s_ij, s_phi = c * s_ij - s * c_ij;
    J[0] = -c, J[1] = -s, J[2] = c * t.y - s * t.x;
    J[3] = s, J[4] = -c, J[5] = -s * t.y - c * t.x;
    J[6] = 0, J[7] = 0, J[8] = -1;
    J[9] = c_phi, J[10] = -s_phi, J[11] = 0;
    J[12] = s_phi, J[13] = c_phi, J[14] = 0;
    J[15] = 0, J[16] = 0, J[17] = 1;
}

// Poses moved by right steps: a pose and its tangent share their coordinates.
inline Matrix<double> retract(Poses pose, Poses step) {
    require(pose.shape[1] == 3, "pose must be (n, 3)");
    require(step.size() == pose.size() && step.shape[1] == 3, "step must be (n, 3), like pose");
    auto moved = new_array<double, 2>({pose.size(), 3});
    const Turns of(pose);
    for (int64_t f = 0; f < pose.size(); f++) compose(pose[f], step[f], of[f], moved[f]);
    return moved;
}

inline Matrix<double> residual(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto e = new_array<double, 2>({z.shape[0], 3});
    Turns of_z(z), of_i(x_i);
    for (int64_t f = 0; f < z.size(); f++)
        write_residual(z[f], x_i[f], x_j[f], of_z[f], of_i[f], e[f]);
    return e;
}

inline Array<double, 4> jacobians(Poses z, Poses x_i, Poses x_j) {
    check(z, x_i, x_j);
    auto J = new_array<double, 4>({z.shape[0], 2, 3, 3});
    Turns of_z(z), of_i(x_i), of_j(x_j);
    for (int64_t f = 0; f < z.size(); f++)
        write_jacobians(x_i[f], x_j[f], of_z[f], of_i[f], of_j[f], J[f]);
    return J;
}

inline Array<double, 4> curvature(Poses z, Poses x_i, Poses x_j, Poses dual) {
    check(z, x_i, x_j);
    require(dual.size() == z.size() && dual.shape[1] == 3, "dual must be (n, 3), like z");
    auto H = new_array<double, 4>({z.shape[0], 2, 1, 6});
    Turns of_z(z), of_i(x_i), of_j(x_j);
    for (int64_t f = 0; f < z.size(); f++) {
        double c = of_z.c[f], s = of_z.s[f], c_i = of_i.c[f], s_i = of_i.s[f];
        Seen t(x_i[f], x_j[f], of_i[f]);
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
