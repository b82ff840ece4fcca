// SPDX-License-Identifier: Apache-2.0
// Poses in the plane and in space: the verbs of `core/geometry/manifold.py` for a few of them.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "arrays.hpp"
#include "se2.hpp"
#include "se3.hpp"

namespace poses {

// Small dense matrices, (K, K) row by row, and vectors.
template <int K> using Square = std::array<double, K * K>;
template <int K> using Few = std::array<double, K>;

// Poses x, y, theta of the plane.
struct Plane {
    static constexpr int P = 3, K = 3;
    static void identity(double* pose) { pose[0] = pose[1] = pose[2] = 0.0; }
    static void compose(const double* a, const double* b, double* ab) {
        double c = std::cos(a[2]), s = std::sin(a[2]);
        double x = a[0] + (c * b[0] - s * b[1]), y = a[1] + (s * b[0] + c * b[1]);
        ab[2] = se2::wrapped(a[2] + b[2]);
        ab[0] = x, ab[1] = y;
    }
    static void retract(const double* pose, const Few<K>& step, double* to) {
        compose(pose, step.data(), to);
    }
    static void inverse(const double* a, double* to) {
        double c = std::cos(a[2]), s = std::sin(a[2]);
        to[0] = -c * a[0] - s * a[1], to[1] = s * a[0] - c * a[1];
        to[2] = se2::wrapped(-a[2]);
    }
    static void between(const double* a, const double* b, double* to) {
        double c = std::cos(a[2]), s = std::sin(a[2]), x = b[0] - a[0], y = b[1] - a[1];
        to[0] = c * x + s * y, to[1] = c * y - s * x;
        to[2] = se2::wrapped(b[2] - a[2]);
    }
    static Few<K> step_to(const double* pose) { return {pose[0], pose[1], pose[2]}; }
    static Few<K> residual(const double* z, const double* i, const double* j) {
        double c = std::cos(z[2]), s = std::sin(z[2]);
        se2::Seen t(i, j, std::cos(i[2]), std::sin(i[2]));
        return {c * (t.x - z[0]) + s * (t.y - z[1]), c * (t.y - z[1]) - s * (t.x - z[0]),
                se2::wrapped(j[2] - i[2] - z[2])};
    }
    static void jacobians(const double* z, const double* i, const double* j, Square<K> (&J)[2]) {
        double c = std::cos(z[2]), s = std::sin(z[2]), phi = j[2] - i[2] - z[2];
        se2::Seen t(i, j, std::cos(i[2]), std::sin(i[2]));
        J[0] = {-c, -s, c * t.y - s * t.x, s, -c, -s * t.y - c * t.x, 0, 0, -1};
        J[1] = {std::cos(phi), -std::sin(phi), 0, std::sin(phi), std::cos(phi), 0, 0, 0, 1};
    }
};

// Poses x, y, z, qx, qy, qz, qw of space.
struct Space {
    static constexpr int P = 7, K = 6;
    static void identity(double* pose) { std::fill_n(pose, 6, 0.0), pose[6] = 1.0; }
    static se3::Quaternion opposite(se3::Quaternion q) { return {-q.x, -q.y, -q.z, q.w}; }
    static void set(double* to, se3::Point t, se3::Quaternion q) {
        double square = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w;
        // What was normalised once stays as it is.
        bool is_unit = std::abs(square - 1) <= 4 * std::numeric_limits<double>::epsilon();
        double scale = (is_unit ? 1.0 : 1 / std::sqrt(square)) * (q.w < 0 ? -1 : 1);
        const double pose[7] = {t.x, t.y, t.z, scale * q.x, scale * q.y, scale * q.z, scale * q.w};
        std::copy(pose, pose + 7, to);
    }
    static void move(const double* a, se3::Point step, se3::Quaternion turn, double* to) {
        se3::Quaternion back = opposite(se3::turn_of(a));
        se3::Point t = se3::turned_back(back, step);
        set(to, {a[0] + t.x, a[1] + t.y, a[2] + t.z}, se3::product(back, turn));
    }
    static void compose(const double* a, const double* b, double* ab) {
        move(a, {b[0], b[1], b[2]}, se3::turn_of(b), ab);
    }
    static void retract(const double* pose, const Few<K>& step, double* to) {
        double half = std::sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5]) / 2;
        double share = (half > 0 ? std::sin(half) / half : 1.0) / 2;
        move(pose, {step[0], step[1], step[2]},
             {share * step[3], share * step[4], share * step[5], std::cos(half)}, to);
    }
    static void inverse(const double* a, double* to) {
        se3::Quaternion q = se3::turn_of(a);
        se3::Point t = se3::turned_back(q, {-a[0], -a[1], -a[2]});
        set(to, t, opposite(q));
    }
    static void between(const double* a, const double* b, double* to) {
        se3::Quaternion q = se3::turn_of(a);
        set(to, se3::turned_back(q, {b[0] - a[0], b[1] - a[1], b[2] - a[2]}),
            se3::product(q, se3::turn_of(b)));
    }
    static Few<K> step_to(const double* pose) {
        double sine = std::sqrt(pose[3] * pose[3] + pose[4] * pose[4] + pose[5] * pose[5]);
        double half = std::atan2(sine, pose[6]);
        double share = 2 * (half > 0 ? half / std::sin(half) : 1.0);
        return {pose[0], pose[1], pose[2], share * pose[3], share * pose[4], share * pose[5]};
    }
    static Few<K> residual(const double* z, const double* i, const double* j) {
        se3::Seen at(z, i, j);
        auto t = se3::turned_back(se3::turn_of(z), {at.p.x - z[0], at.p.y - z[1], at.p.z - z[2]});
        return {t.x, t.y, t.z, 2 * at.q.x, 2 * at.q.y, 2 * at.q.z};
    }
    static void jacobians(const double* z, const double* i, const double* j, Square<K> (&J)[2]) {
        se3::Seen at(z, i, j);
        se3::Square R_z = se3::Square::of(se3::turn_of(z)), R_ij = se3::Square::of(at.q_ij);
        se3::Square M = se3::Square::skew({at.q.x, at.q.y, at.q.z}, at.q.w);
        const double p[3] = {at.p.x, at.p.y, at.p.z};
        J[0] = J[1] = {};
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) {
                int a = (c + 1) % 3, b = (c + 2) % 3;
                J[0][r * 6 + c] = -R_z.m[c][r];
                J[0][r * 6 + 3 + c] = R_z.m[a][r] * p[b] - R_z.m[b][r] * p[a];
                J[1][(3 + r) * 6 + 3 + c] = M.m[r][c];
                for (int k = 0; k < 3; k++) {
                    J[1][r * 6 + c] += R_z.m[k][r] * R_ij.m[k][c];
                    J[0][(3 + r) * 6 + 3 + c] -= M.m[r][k] * R_ij.m[c][k];
                }
            }
    }
};

// One pose for each row, or the one row of what has no more.
inline int64_t rows_of(const Rows& a, const Rows& b) {
    require(a.shape[0] == b.shape[0] || a.shape[0] == 1 || b.shape[0] == 1,
            "as many rows, or one");
    return a.shape[0] == 1 ? b.shape[0] : a.shape[0];
}
template <int N> std::array<double, N> row_of(const Rows& rows, int64_t n) {
    std::array<double, N> row;
    const char* at = rows.data + (rows.shape[0] == 1 ? 0 : n) * rows.step[0];
    for (int c = 0; c < N; c++) row[c] = *reinterpret_cast<const double*>(at + c * rows.step[1]);
    return row;
}

// Call a template for the group that poses of so many numbers are of.
#define OF_GROUP(numbers, function, ...) \
    ((numbers) == Plane::P ? function<Plane>(__VA_ARGS__) : function<Space>(__VA_ARGS__))
inline void require_poses(const Rows& a) {
    require(a.shape[1] == Plane::P || a.shape[1] == Space::P, "poses (n, 3) or (n, 7)");
}

template <class G> Matrix<double> compose_of(const Rows& a, const Rows& b) {
    require(b.shape[1] == G::P, "b of (n, p)");
    const int64_t count = rows_of(a, b);
    auto made = new_array<double, 2>({count, G::P});
    for (int64_t n = 0; n < count; n++)
        G::compose(row_of<G::P>(a, n).data(), row_of<G::P>(b, n).data(), made[n]);
    return made;
}
inline Matrix<double> compose(Rows a, Rows b) {
    require_poses(a);
    return OF_GROUP(a.shape[1], compose_of, a, b);
}

template <class G> Matrix<double> between_of(const Rows& a, const Rows& b) {
    require(b.shape[1] == G::P, "b of (n, p)");
    const int64_t count = rows_of(a, b);
    auto made = new_array<double, 2>({count, G::P});
    for (int64_t n = 0; n < count; n++)
        G::between(row_of<G::P>(a, n).data(), row_of<G::P>(b, n).data(), made[n]);
    return made;
}
inline Matrix<double> between(Rows a, Rows b) {
    require_poses(a);
    return OF_GROUP(a.shape[1], between_of, a, b);
}

template <class G> Matrix<double> inverse_of(const Rows& a) {
    auto made = new_array<double, 2>({a.shape[0], G::P});
    for (int64_t n = 0; n < a.shape[0]; n++) G::inverse(row_of<G::P>(a, n).data(), made[n]);
    return made;
}
inline Matrix<double> inverse(Rows a) {
    require_poses(a);
    return OF_GROUP(a.shape[1], inverse_of, a);
}

template <class G> Matrix<double> retract_of(const Rows& pose, const Rows& step) {
    require(step.shape[1] == G::K, "step of (n, k)");
    const int64_t count = rows_of(pose, step);
    auto made = new_array<double, 2>({count, G::P});
    for (int64_t n = 0; n < count; n++)
        G::retract(row_of<G::P>(pose, n).data(), row_of<G::K>(step, n), made[n]);
    return made;
}
inline Matrix<double> retract(Rows pose, Rows step) {
    require_poses(pose);
    return OF_GROUP(pose.shape[1], retract_of, pose, step);
}

template <class G> Matrix<double> local_of(const Rows& a, const Rows& b) {
    require(b.shape[1] == G::P, "b of (n, p)");
    const int64_t count = rows_of(a, b);
    auto made = new_array<double, 2>({count, G::K});
    for (int64_t n = 0; n < count; n++) {
        std::array<double, G::P> seen;
        G::between(row_of<G::P>(a, n).data(), row_of<G::P>(b, n).data(), seen.data());
        Few<G::K> step = G::step_to(seen.data());
        std::copy(step.begin(), step.end(), made[n]);
    }
    return made;
}
inline Matrix<double> local(Rows a, Rows b) {
    require_poses(a);
    return OF_GROUP(a.shape[1], local_of, a, b);
}

// The length [m] and the angle [rad] of steps.
inline std::tuple<Vector<double>, Vector<double>> motion(Rows step) {
    require(step.shape[1] == Plane::K || step.shape[1] == Space::K, "steps (n, 3) or (n, 6)");
    auto length = new_vector<double>(step.shape[0]), angle = new_vector<double>(step.shape[0]);
    for (int64_t n = 0; n < step.shape[0]; n++) {
        if (step.shape[1] == Plane::K) {
            auto s = row_of<3>(step, n);
            length[n] = std::hypot(s[0], s[1]), angle[n] = std::abs(s[2]);
        } else {
            auto s = row_of<6>(step, n);
            length[n] = std::sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
            angle[n] = std::sqrt(s[3] * s[3] + s[4] * s[4] + s[5] * s[5]);
        }
    }
    return {length, angle};
}

// x, y and the yaw of poses (n, 7).
inline Matrix<double> onto_plane(Rows pose3) {
    require(pose3.shape[1] == Space::P, "poses (n, 7)");
    auto made = new_array<double, 2>({pose3.shape[0], Plane::P});
    for (int64_t n = 0; n < pose3.shape[0]; n++) {
        auto p = row_of<Space::P>(pose3, n);
        made(n, 0) = p[0], made(n, 1) = p[1];
        made(n, 2) = std::atan2(2 * (p[6] * p[5] + p[3] * p[4]),
                                p[6] * p[6] + p[3] * p[3] - p[4] * p[4] - p[5] * p[5]);
    }
    return made;
}

// How many of the times, ascending, are before each that is asked for; to : or equal to it. What
// NumPy calls searchsorted lets go of the interpreter's lock each time.
inline Vector<int64_t> places(Vector<const int64_t> times, Vector<const int64_t> asked, bool to) {
    auto found = new_vector<int64_t>(asked.size());
    const int64_t *begin = times.data, *end = begin + times.size();
    for (int64_t k = 0; k < asked.size(); k++)
        found[k] = (to ? std::upper_bound(begin, end, asked[k])
                       : std::lower_bound(begin, end, asked[k])) - begin;
    return found;
}

template <class G>
Matrix<double> interpolate_of(Vector<const int64_t> times, Matrix<const double> poses,
                              Vector<const int64_t> first, Vector<const int64_t> end,
                              Vector<const int64_t> asked) {
    auto found = new_array<double, 2>({asked.size(), G::P});
    for (int64_t k = 0; k < asked.size(); k++) {
        const int64_t from = first[first.size() == 1 ? 0 : k], to = end[end.size() == 1 ? 0 : k];
        require(from >= 0 && from < to && to <= times.size(), "first and end of parts of times");
        int64_t after = std::lower_bound(times.data, times.data + times.size(), asked[k]) -
                        times.data;
        after = std::min(std::max(after, std::min(from + 1, to - 1)), to - 1);
        const int64_t before = std::max(after - 1, from);
        const double span = double(std::max<int64_t>(times[after] - times[before], 1));
        const double fraction = std::min(double(asked[k] - times[before]) / span, 1.0);
        std::array<double, G::P> seen;
        G::between(poses[before], poses[after], seen.data());
        Few<G::K> step = G::step_to(seen.data());
        for (double& entry : step) entry *= fraction;
        G::retract(poses[before], step, found[k]);
    }
    return found;
}
// Poses at the times asked for, between samples at `times`, ascending, of a part each.
inline Matrix<double> interpolate(Vector<const int64_t> times, Matrix<const double> poses,
                                  Vector<const int64_t> first, Vector<const int64_t> end,
                                  Vector<const int64_t> asked) {
    require(poses.shape[1] == Plane::P || poses.shape[1] == Space::P, "poses (n, 3) or (n, 7)");
    require(poses.size() == times.size(), "as many poses as times");
    require((first.size() == 1 || first.size() == asked.size()) &&
                (end.size() == 1 || end.size() == asked.size()),
            "first and end of all, or of each asked for");
    return OF_GROUP(poses.shape[1], interpolate_of, times, poses, first, end, asked);
}

static PyMethodDef methods[] = {
    BRIEF(compose, "a, b"),
    BRIEF(between, "a, b"),
    BRIEF(inverse, "a"),
    BRIEF(retract, "pose, step"),
    BRIEF(local, "a, b"),
    BRIEF(motion, "step"),
    BRIEF(onto_plane, "pose3"),
    BRIEF(places, "times, asked, to"),
    BRIEF(interpolate, "times, poses, first, end, asked"),
    {}};

}  // namespace poses
