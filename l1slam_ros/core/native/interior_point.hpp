// SPDX-License-Identifier: Apache-2.0
// The row-wise work of one interior-point step in a single pass. All arrays are (rows,).
#pragma once
#include <algorithm>
#include <cmath>
#include <limits>

#include "arrays.hpp"

namespace interior_point {

using Rows = Vector<double>;
#define STATE Rows u_, Rows v_, Rows s_, Rows t_, Rows q_, Rows e_, Rows y_
// Arrays do not overlap, which the compiler is told: else it takes one row after the other.
#define NO_OVERLAP _Pragma("GCC ivdep")
#define UNPACK(name) const double* __restrict name = name##_.data
#define STATE_UNPACKED \
    const int64_t m = e_.size(); \
    UNPACK(u); UNPACK(v); UNPACK(s); UNPACK(t); UNPACK(q); UNPACK(e); UNPACK(y)

inline Rows like(const Rows& rows) { return new_array<double, 1>({rows.shape[0]}); }

// u, v, s, t, y with e = u - v, u s = v t = mu, s = 1 - y and t = 1 + y.
inline std::tuple<Rows, Rows, Rows, Rows, Rows> begin(Rows e, double mu) {
    Rows u = like(e), v = like(e), s = like(e), t = like(e), y = like(e);
    NO_OVERLAP
    for (int64_t k = 0; k < e.size(); k++) {
        double root = std::sqrt(mu * mu + e[k] * e[k]), large = (mu + root + std::abs(e[k])) / 2;
        double small = mu * (mu + root) / (2 * large);
        u[k] = e[k] >= 0 ? large : small, v[k] = e[k] >= 0 ? small : large;
        s[k] = mu / u[k], t[k] = mu / v[k], y[k] = e[k] / (mu + root);
    }
    return {u, v, s, t, y};
}

inline std::tuple<Rows, double> weigh(Rows u_, Rows v_, Rows s_, Rows t_) {
    Rows q = like(u_);
    UNPACK(u); UNPACK(v); UNPACK(s); UNPACK(t);
    double gap = 0.0, *__restrict to = q.data;
    NO_OVERLAP
    for (int64_t k = 0; k < q.size(); k++) {
        to[k] = 1 / (u[k] / s[k] + v[k] / t[k]);
        gap += u[k] * s[k] + v[k] * t[k];
    }
    return {q, gap};
}

// -(y + q g), g = e - (u - v) - (c1/s - u) + (c2/t - v).
inline Rows aim(STATE, Rows c1_, Rows c2_) {
    Rows pull_ = like(e_);
    STATE_UNPACKED;
    UNPACK(c1); UNPACK(c2);
    double* __restrict pull = pull_.data;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++)
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] / s[k] + c2[k] / t[k]);
    return pull_;
}

inline std::tuple<Rows, Rows, Rows> aim_combined(STATE, Rows dy_, double mu, double most) {
    Rows c1_ = like(e_), c2_ = like(e_), pull_ = like(e_);
    STATE_UNPACKED;
    UNPACK(dy);
    double *__restrict c1 = c1_.data, *__restrict c2 = c2_.data, *__restrict pull = pull_.data;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        double by_s = 1 / s[k], by_t = 1 / t[k];
        double of_u = (u[k] * dy[k] * by_s - u[k]) * dy[k];
        double of_v = (-v[k] * dy[k] * by_t - v[k]) * dy[k];
        c1[k] = mu + std::min(std::max(of_u, -most), most);
        c2[k] = mu - std::min(std::max(of_v, -most), most);
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] * by_s + c2[k] * by_t);
    }
    return {c1_, c2_, pull_};
}

inline std::tuple<Rows, Rows, Rows> aim_centrally(STATE, Rows dy_, Rows c1_, Rows c2_,
                                                  double least, double most) {
    Rows new1_ = like(e_), new2_ = like(e_), pull_ = like(e_);
    STATE_UNPACKED;
    UNPACK(dy); UNPACK(c1); UNPACK(c2);
    double *__restrict new1 = new1_.data, *__restrict new2 = new2_.data;
    double* __restrict pull = pull_.data;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        double by_s = 1 / s[k], by_t = 1 / t[k];
        double end1 = c1[k] - ((c1[k] + u[k] * dy[k]) * by_s - u[k]) * dy[k];
        double end2 = c2[k] + ((c2[k] - v[k] * dy[k]) * by_t - v[k]) * dy[k];
        new1[k] = c1[k] + std::max(std::min(std::max(end1, least), most) - end1, -most);
        new2[k] = c2[k] + std::max(std::min(std::max(end2, least), most) - end2, -most);
        pull[k] = -y[k] - q[k] * (e[k] - new1[k] * by_s + new2[k] * by_t);
    }
    return {new1_, new2_, pull_};
}

// The largest of some values; four at a time, none of which waits for another one.
inline double largest(const double* values, int64_t count, double least) {
    double most[4] = {least, least, least, least};
    int64_t k = 0;
    for (; k + 4 <= count; k += 4)
        for (int lane = 0; lane < 4; lane++)
            most[lane] = values[k + lane] > most[lane] ? values[k + lane] : most[lane];
    for (; k < count; k++) most[0] = values[k] > most[0] ? values[k] : most[0];
    return std::max(std::max(most[0], most[1]), std::max(most[2], most[3]));
}

// The step of y, the lengths of the primal and the dual step, and u's + v't after them.
inline std::tuple<Rows, double, double, double> complete(STATE, Rows c1_, Rows c2_, Rows moved_,
                                                         double fraction) {
    Rows step_ = like(e_);
    STATE_UNPACKED;
    UNPACK(c1); UNPACK(c2); UNPACK(moved);
    double* __restrict step = step_.data;
    double here = 0.0, by_primal = 0.0, by_dual = 0.0, by_both = 0.0;
    double primal = fraction, dual = fraction;
    // The nearest bound is where the step is largest beside what is left; found apart, or the
    // rows would be done one by one.
    constexpr int64_t RUN = 512;
    double of_primal[RUN], of_dual[RUN];
    for (int64_t first = 0; first < m; first += RUN) {
        const int64_t end = std::min(first + RUN, m);
        NO_OVERLAP
        for (int64_t k = first; k < end; k++) {
            double by_s = 1 / s[k], by_t = 1 / t[k];
            double dy = q[k] * (moved[k] + (e[k] - c1[k] * by_s + c2[k] * by_t));
            double du = (c1[k] + u[k] * dy) * by_s - u[k], dv = (c2[k] - v[k] * dy) * by_t - v[k];
            step[k] = dy;
            double of_u = -du / u[k], of_v = -dv / v[k], of_s = dy * by_s, of_t = -dy * by_t;
            of_primal[k - first] = of_u > of_v ? of_u : of_v;
            of_dual[k - first] = of_s > of_t ? of_s : of_t;
            here += u[k] * s[k] + v[k] * t[k];
            by_primal += du * s[k] + dv * t[k];
            by_dual += (v[k] - u[k]) * dy;
            by_both += (dv - du) * dy;
        }
        primal = largest(of_primal, end - first, primal);
        dual = largest(of_dual, end - first, dual);
    }
    primal = fraction / primal, dual = fraction / dual;
    return {step_, primal, dual,
            here + primal * by_primal + dual * (by_dual + primal * by_both)};
}

inline void advance(Rows u_, Rows v_, Rows s_, Rows t_, Rows y_, Rows c1_, Rows c2_, Rows dy_,
                    double primal, double dual, double least) {
    double *__restrict u = u_.data, *__restrict v = v_.data, *__restrict s = s_.data;
    double *__restrict t = t_.data, *__restrict y = y_.data;
    UNPACK(c1); UNPACK(c2); UNPACK(dy);
    NO_OVERLAP
    for (int64_t k = 0; k < u_.size(); k++) {
        double du = (c1[k] + u[k] * dy[k]) / s[k] - u[k], dv = (c2[k] - v[k] * dy[k]) / t[k] - v[k];
        u[k] += primal * du, v[k] += primal * dv;
        s[k] = std::max(s[k] - dual * dy[k], least), t[k] = std::max(t[k] + dual * dy[k], least);
        y[k] += dual * dy[k];
    }
}

inline std::tuple<double, double> missing(Rows u, Rows v, Rows s, Rows t, Rows e) {
    double gap = 0.0, apart = 0.0;
    NO_OVERLAP
    for (int64_t k = 0; k < e.size(); k++) {
        gap += u[k] * s[k] + v[k] * t[k];
        apart += std::abs(e[k] - u[k] + v[k]);
    }
    return {gap, apart};
}

inline std::tuple<double, double> depart(Rows after, Rows e, Rows moved, double length) {
    double cost = 0.0, departure = 0.0;
    NO_OVERLAP
    for (int64_t k = 0; k < e.size(); k++) {
        cost += std::abs(after[k]);
        departure += std::abs(after[k] - (e[k] + length * moved[k]));
    }
    return {cost, departure};
}

static PyMethodDef methods[] = {
    FUNCTION(begin, "e, mu"),
    FUNCTION(weigh, "u, v, s, t"),
    FUNCTION(aim, "u, v, s, t, q, e, y, c1, c2"),
    FUNCTION(aim_combined, "u, v, s, t, q, e, y, dy, mu, most"),
    FUNCTION(aim_centrally, "u, v, s, t, q, e, y, dy, c1, c2, least, most"),
    FUNCTION(complete, "u, v, s, t, q, e, y, c1, c2, moved, fraction"),
    FUNCTION(advance, "u, v, s, t, y, c1, c2, dy, primal, dual, least"),
    FUNCTION(missing, "u, v, s, t, e"),
    FUNCTION(depart, "after, e, moved, length"),
    {}};

}  // namespace interior_point
