// SPDX-License-Identifier: Apache-2.0
// Poses in the plane and in space: the verbs of `core/geometry/manifold.py` for a few of them.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>

#include "arrays.hpp"
#include "se2.hpp"
#include "se3.hpp"

namespace poses {

// Small dense matrices, (K, K) row by row, and vectors.
template <int K> using Square = std::array<double, K * K>;
template <int K> using Few = std::array<double, K>;

// Poses x, y, theta of the plane; J : (2, K, K), as `se2` has it.
struct Plane {
    static constexpr int P = 3, K = 3;
    static void identity(double* pose) { pose[0] = pose[1] = pose[2] = 0.0; }
    static void compose(const double* a, const double* b, double* ab) { se2::compose(a, b, ab); }
    static void retract(const double* pose, const Few<K>& step, double* to) {
        se2::compose(pose, step.data(), to);
    }
    static void inverse(const double* a, double* to) {
        const auto [c, s] = se2::turn_of(a[2]);
        to[0] = -c * a[0] - s * a[1], to[1] = s * a[0] - c * a[1];
        to[2] = se2::wrapped(-a[2]);
    }
    static void between(const double* a, const double* b, double* to) {
        const se2::Seen t(a, b, se2::turn_of(a[2]));
        to[0] = t.x, to[1] = t.y;
        to[2] = se2::wrapped(b[2] - a[2]);
    }
    static Few<K> step_to(const double* pose) { return {pose[0], pose[1], pose[2]}; }
    static Few<K> residual(const double* z, const double* i, const double* j) {
        Few<K> e;
        se2::write_residual(z, i, j, se2::turn_of(z[2]), se2::turn_of(i[2]), e.data());
        return e;
    }
    static void jacobians(const double* z, const double* i, const double* j, double* J) {
        se2::write_jacobians(i, j, se2::turn_of(z[2]), se2::turn_of(i[2]), se2::turn_of(j[2]), J);
    }
};

// Poses x, y, z, qx, qy, qz, qw of space.
struct Space {
    static constexpr int P = 7, K = 6;
    static void identity(double* pose) { std::fill_n(pose, 6, 0.0), pose[6] = 1.0; }
    static void compose(const double* a, const double* b, double* ab) { se3::compose(a, b, ab); }
    static void retract(const double* pose, const Few<K>& step, double* to) {
        se3::move(pose, step.data(), to);
    }
    static void inverse(const double* a, double* to) {
        se3::Quaternion q = se3::turn_of(a);
        se3::Point t = se3::turned_back(q, {-a[0], -a[1], -a[2]});
        se3::write(t, {-q.x, -q.y, -q.z, q.w}, to);
    }
    static void between(const double* a, const double* b, double* to) {
        se3::Quaternion q = se3::turn_of(a);
        se3::write(se3::turned_back(q, {b[0] - a[0], b[1] - a[1], b[2] - a[2]}),
                   se3::product(q, se3::turn_of(b)), to);
    }
    static Few<K> step_to(const double* pose) {
        double sine = std::sqrt(pose[3] * pose[3] + pose[4] * pose[4] + pose[5] * pose[5]);
        double half = std::atan2(sine, pose[6]);
        double share = 2 * (half > 0 ? half / std::sin(half) : 1.0);
        return {pose[0], pose[1], pose[2], share * pose[3], share * pose[4], share * pose[5]};
    }
    static Few<K> residual(const double* z, const double* i, const double* j) {
        Few<K> e;
        se3::write_residual(z, i, j, e.data());
        return e;
    }
    static void jacobians(const double* z, const double* i, const double* j, double* J) {
        se3::write_jacobians(z, i, j, J);
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

// A verb of two poses that makes a third, of each row.
template <class G, class Verb> Matrix<double> of_pairs(const Rows& a, const Rows& b, Verb verb) {
    require(b.shape[1] == G::P, "b of (n, p)");
    const int64_t count = rows_of(a, b);
    auto made = new_array<double, 2>({count, G::P});
    for (int64_t n = 0; n < count; n++)
        verb(row_of<G::P>(a, n).data(), row_of<G::P>(b, n).data(), made[n]);
    return made;
}
inline Matrix<double> compose(Rows a, Rows b) {
    require_poses(a);
    return a.shape[1] == Plane::P ? of_pairs<Plane>(a, b, Plane::compose)
                                  : of_pairs<Space>(a, b, Space::compose);
}
inline Matrix<double> between(Rows a, Rows b) {
    require_poses(a);
    return a.shape[1] == Plane::P ? of_pairs<Plane>(a, b, Plane::between)
                                  : of_pairs<Space>(a, b, Space::between);
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
