// SPDX-License-Identifier: Apache-2.0
// The row-wise work of one interior-point step in a single pass; see `solvers/interior_point`.
// All arrays are (rows,). q = 1 / (u/s + v/t); c1, c2 are what the products u s and v t are to
// become. What can be worked out again from the step of y, dy, is not kept: to read it from memory
// would take longer.
#pragma once
#include <algorithm>
#include <cmath>

#include "arrays.hpp"
#include "lanes.hpp"

namespace interior_point {

using Rows = Vector<const double>;
using NewRows = Vector<double>;
// What the linearised conditions of optimality are written in.
#define STATE Rows u, Rows v, Rows s, Rows t, Rows q, Rows e, Rows y
#define STATE_NAMES "u, v, s, t, q, e, y"

// Other arrays must have as many rows as e.
template <class... Others> int64_t rows_of(Rows e, Others... others) {
    require(((others.size() == e.size()) && ...), "all arrays must have as many entries as e");
    return e.size();
}

// u, v, s, t, y with e = u - v, u s = v t = mu, s = 1 - y and t = 1 + y.
inline std::tuple<NewRows, NewRows, NewRows, NewRows, NewRows> begin(Rows e, double mu) {
    const int64_t m = e.size();
    auto u = new_vector<double>(m), v = new_vector<double>(m), s = new_vector<double>(m);
    auto t = new_vector<double>(m), y = new_vector<double>(m);
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        const double root = std::sqrt(mu * mu + e[k] * e[k]);
        const double large = (mu + root + std::abs(e[k])) / 2;
        const double small = mu * (mu + root) / (2 * large);  // (mu + root - |e|) / 2 would cancel
        u[k] = e[k] >= 0 ? large : small, v[k] = e[k] >= 0 ? small : large;
        s[k] = mu / u[k], t[k] = mu / v[k], y[k] = e[k] / (mu + root);
    }
    return {u, v, s, t, y};
}

// q, and the complementarity u's + v't.
inline std::tuple<NewRows, double> weigh(Rows u, Rows v, Rows s, Rows t) {
    const int64_t m = rows_of(u, v, s, t);
    auto q = new_vector<double>(m);
    double gap = 0.0;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        q[k] = 1 / (u[k] / s[k] + v[k] / t[k]);
        gap += u[k] * s[k] + v[k] * t[k];
    }
    return {q, gap};
}

// -(y + q g), g = e - (u - v) - (c1/s - u) + (c2/t - v).
inline NewRows aim(STATE, Rows c1, Rows c2) {
    const int64_t m = rows_of(e, u, v, s, t, q, y, c1, c2);
    auto pull = new_vector<double>(m);
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++)
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] / s[k] + c2[k] / t[k]);
    return pull;
}

// c1, c2, and what `aim` does for them: mu, corrected by what the affine step leaves. dy : of the
// affine step; most : of each correction.
inline std::tuple<NewRows, NewRows, NewRows> aim_combined(STATE, Rows dy, double mu, double most) {
    const int64_t m = rows_of(e, u, v, s, t, q, y, dy);
    auto c1 = new_vector<double>(m), c2 = new_vector<double>(m), pull = new_vector<double>(m);
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        const double by_s = 1 / s[k], by_t = 1 / t[k];
        const double of_u = (u[k] * dy[k] * by_s - u[k]) * dy[k];
        const double of_v = (-v[k] * dy[k] * by_t - v[k]) * dy[k];
        c1[k] = mu + std::min(std::max(of_u, -most), most);
        c2[k] = mu - std::min(std::max(of_v, -most), most);
        pull[k] = -y[k] - q[k] * (e[k] - c1[k] * by_s + c2[k] * by_t);
    }
    return {c1, c2, pull};
}

// c1, c2 that bring all products at the end of a step between bounds, and as `aim`. dy, c1, c2 : of
// that step. Meant to become c1 and c2, they end as c1 - du dy and c2 + dv dy. Of those far too
// large no more is taken than the most they may be, or they would rule the step.
inline std::tuple<NewRows, NewRows, NewRows> aim_centrally(STATE, Rows dy, Rows c1, Rows c2,
                                                           double least, double most) {
    const int64_t m = rows_of(e, u, v, s, t, q, y, dy, c1, c2);
    auto new1 = new_vector<double>(m), new2 = new_vector<double>(m), pull = new_vector<double>(m);
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        const double by_s = 1 / s[k], by_t = 1 / t[k];
        const double end1 = c1[k] - ((c1[k] + u[k] * dy[k]) * by_s - u[k]) * dy[k];
        const double end2 = c2[k] + ((c2[k] - v[k] * dy[k]) * by_t - v[k]) * dy[k];
        new1[k] = c1[k] + std::max(std::min(std::max(end1, least), most) - end1, -most);
        new2[k] = c2[k] + std::max(std::min(std::max(end2, least), most) - end2, -most);
        pull[k] = -y[k] - q[k] * (e[k] - new1[k] * by_s + new2[k] * by_t);
    }
    return {new1, new2, pull};
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

// The step of y that belongs to a step of the residual, the lengths of the primal and the dual
// step, and u's + v't after them. moved : J dx; fraction : of the way to the nearest bound, which
// is never more than the step.
inline std::tuple<NewRows, double, double, double> complete(STATE, Rows c1, Rows c2, Rows moved,
                                                            double fraction) {
    const int64_t m = rows_of(e, u, v, s, t, q, y, c1, c2, moved);
    auto step = new_vector<double>(m);
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
            const double by_s = 1 / s[k], by_t = 1 / t[k];
            const double dy = q[k] * (moved[k] + (e[k] - c1[k] * by_s + c2[k] * by_t));
            const double du = (c1[k] + u[k] * dy) * by_s - u[k];
            const double dv = (c2[k] - v[k] * dy) * by_t - v[k];
            step[k] = dy;
            const double of_u = -du / u[k], of_v = -dv / v[k], of_s = dy * by_s, of_t = -dy * by_t;
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
    return {step, primal, dual, here + primal * by_primal + dual * (by_dual + primal * by_both)};
}

// Move u and v that far along a step, s, t and y that far; s and t stay above `least`.
inline void advance(NewRows u, NewRows v, NewRows s, NewRows t, NewRows y, Rows c1, Rows c2,
                    Rows dy, double primal, double dual, double least) {
    const int64_t m = rows_of(u, v, s, t, y, c1, c2, dy);
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        const double du = (c1[k] + u[k] * dy[k]) / s[k] - u[k];
        const double dv = (c2[k] - v[k] * dy[k]) / t[k] - v[k];
        u[k] += primal * du, v[k] += primal * dv;
        s[k] = std::max(s[k] - dual * dy[k], least), t[k] = std::max(t[k] + dual * dy[k], least);
        y[k] += dual * dy[k];
    }
}

// The complementarity u's + v't, and |e - u + v|_1.
inline std::tuple<double, double> missing(Rows u, Rows v, Rows s, Rows t, Rows e) {
    const int64_t m = rows_of(e, u, v, s, t);
    double gap = 0.0, apart = 0.0;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        gap += u[k] * s[k] + v[k] * t[k];
        apart += std::abs(e[k] - u[k] + v[k]);
    }
    return {gap, apart};
}

// |after|_1 and |after - (e + length moved)|_1.
inline std::tuple<double, double> depart(Rows after, Rows e, Rows moved, double length) {
    const int64_t m = rows_of(e, after, moved);
    double cost = 0.0, departure = 0.0;
    NO_OVERLAP
    for (int64_t k = 0; k < m; k++) {
        cost += std::abs(after[k]);
        departure += std::abs(after[k] - (e[k] + length * moved[k]));
    }
    return {cost, departure};
}

static PyMethodDef methods[] = {
    BY_SIZE(begin, "e, mu"),
    BY_SIZE(weigh, "u, v, s, t"),
    BY_SIZE(aim, STATE_NAMES ", c1, c2"),
    BY_SIZE(aim_combined, STATE_NAMES ", dy, mu, most"),
    BY_SIZE(aim_centrally, STATE_NAMES ", dy, c1, c2, least, most"),
    BY_SIZE(complete, STATE_NAMES ", c1, c2, moved, fraction"),
    BY_SIZE(advance, "u, v, s, t, y, c1, c2, dy, primal, dual, least"),
    BY_SIZE(missing, "u, v, s, t, e"),
    BY_SIZE(depart, "after, e, moved, length"),
    {}};

}  // namespace interior_point
