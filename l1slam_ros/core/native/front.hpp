// SPDX-License-Identifier: Apache-2.0
// The bordered front: the L1 and the L2 map of the same factors, each with a border of what came
// since. In the L2 map the innovation of a loop has a known distribution, which is what gates it.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "arrays.hpp"
#include "border.hpp"
#include "poses.hpp"

namespace front {

using namespace border;
using poses::Plane;
using poses::Space;

// The maps.
enum { L1, L2, MAPS };

// Both maps of a front, and the factors that it has taken.
class Front {
  public:
    static constexpr const char* NAME = "l1slam_ros.core.native.front.Front";
    virtual ~Front() = default;
    virtual int64_t keyframes() const = 0;
    virtual int64_t rows() const = 0;
    virtual int64_t points() const = 0;
    virtual bool append_keyframe(int64_t i, int64_t j, Vector<const double> z,
                                 Matrix<const double> root) = 0;
    virtual std::tuple<double, double, double> predict(int64_t i, int64_t j,
                                                       Vector<const double> z,
                                                       Matrix<const double> root) = 0;
    virtual bool append() = 0;
    virtual void refuse() = 0;
    virtual Matrix<double> poses(int64_t map, Vector<const int64_t> keyframes) = 0;
    virtual Matrix<double> covariance(int64_t keyframe, int64_t other,
                                      Matrix<const double> turn) = 0;
    virtual std::tuple<Vector<int64_t>, Matrix<double>, Vector<int64_t>, Array<double, 3>,
                       Matrix<double>, Matrix<double>>
    moment(int64_t map) = 0;
};

// What of a front depends on the group G that its poses are of.
template <class G> class FrontOf : public Front {
    using System = border::System<G::K>;
    static constexpr int K = G::K, P = G::P;
    using Pose = std::array<double, P>;

  public:
    FrontOf(Matrix<const double> l1, Matrix<const double> l2, int64_t fixed, double usual,
            double mu, double of_odometry, double of_loops, int64_t longest,
            std::unique_ptr<Factor> first, std::unique_ptr<Factor> second)
        : fixed(fixed), known(l1.size()), usual(usual), mu(mu), begun{l1, l2},
          system{{std::move(first), longest}, {std::move(second), longest}} {
        of_keyframes[L1].fill(usual), of_keyframes[L2].fill(of_odometry);
        variance.fill(of_loops);
        Py_INCREF(l1.object), Py_INCREF(l2.object);
    }
    ~FrontOf() override { Py_DECREF(begun[L1].object), Py_DECREF(begun[L2].object); }

    int64_t keyframes() const override { return fixed + system[L1].keyframes(); }
    int64_t rows() const override { return system[L1].rows(); }
    int64_t points() const override { return system[L2].points(); }

    bool append_keyframe(int64_t i, int64_t j, Vector<const double> z,
                         Matrix<const double> root) override {
        const int own = j == keyframes() ? 1 : 0, other = 1 - own;
        const int64_t seen_from = own ? i : j;
        require_factor(z, root);
        require((own ? j : i) == keyframes() && seen_from >= FIXED && seen_from < keyframes(),
                "i or j the next keyframe, the other one a keyframe there is");
        Pose to_new;
        own ? (void)std::copy_n(z.data, P, to_new.begin()) : G::inverse(z.data, to_new.data());
        struct Hung { int64_t parent; Pose first; Square<K> turn, noise; Few<K> mean; } hung[MAPS];
        for (int map : {L1, L2}) {
            Hung& one = hung[map];
            one.parent = system[map].of(end_of(seen_from));
            const Few<K> step = system[map].step(one.parent);
            Pose first[2], now[2];
            first[other] = first_of(map, seen_from);
            G::retract(first[other].data(), step, now[other].data());
            G::compose(now[other].data(), to_new.data(), one.first.data());
            first[own] = now[own] = one.first;
            Square<K> blocks[2], inverse;
            Few<K> residual = linearised(z, root, first, now, blocks);
            if (!invert<K>(blocks[own], inverse)) return false;
            const Few<K> moved = product<K>(blocks[other], step);
            for (int r = 0; r < K; r++) residual[r] -= moved[r];
            one.mean = product<K>(inverse, residual);
            one.turn = product<K>(inverse, blocks[other]);
            for (double& entry : one.mean) entry = -entry;
            for (double& entry : one.turn) entry = -entry;
            Square<K> scaled = inverse;
            for (int r = 0; r < K; r++)
                for (int c = 0; c < K; c++) scaled[r * K + c] *= of_keyframes[map][c];
            one.noise = product<K>(scaled, transposed<K>(inverse));
        }
        for (int map : {L1, L2}) {
            system[map].hang(hung[map].parent, hung[map].turn, hung[map].mean, hung[map].noise);
            came[map].push_back(hung[map].first);
        }
        return true;
    }

    std::tuple<double, double, double> predict(int64_t i, int64_t j, Vector<const double> z,
                                               Matrix<const double> root) override {
        require_factor(z, root);
        require(std::min(i, j) >= FIXED && std::max(i, j) < keyframes(),
                "i and j keyframes there are");
        refuse();
        asked = {i, j};
        std::copy_n(z.data, P, asked_z.begin());
        std::copy_n(root.data, K * K, asked_root.begin());
        innovation = look(L2);
        Square<K> whole = innovation.covariance, pivot;
        for (int r = 0; r < K; r++) whole[r * K + r] += variance[r];
        constexpr double NONE = std::numeric_limits<double>::quiet_NaN();
        if (!root_of<K>(whole, pivot)) return {NONE, NONE, NONE};
        Few<K> whitened = innovation.expected;
        solve_lower<K>(pivot, whitened);
        double nis = 0.0, log_likelihood = 0.0, square = 0.0;
        for (int r = 0; r < K; r++) {
            nis += whitened[r] * whitened[r];
            log_likelihood += std::log(std::abs(root(r, r))) - std::log(pivot[r * K + r]);
        }
        solve_upper<K>(pivot, whitened);
        for (int r = 0; r < K; r++) {
            remaining[r] = variance[r] * whitened[r];
            square += remaining[r] * whitened[r];
        }
        has_innovation = true;
        return {nis, log_likelihood - nis / 2, std::sqrt(square)};
    }

    bool append() override {
        require(has_innovation, "predict before append");
        has_innovation = false;
        if (!system[L2].append(innovation, variance)) return false;
        Few<K> noise;
        for (int r = 0; r < K; r++) noise[r] = std::sqrt(usual * std::hypot(remaining[r], mu));
        auto in_l1 = look(L1);
        return system[L1].append(in_l1, noise);
    }

    void refuse() override {
        if (has_innovation)
            for (int map : {L1, L2}) system[map].forget(before[map]);
        has_innovation = false;
        for (int map : {L1, L2}) before[map] = system[map].points();
    }

    Matrix<double> poses(int64_t map, Vector<const int64_t> of) override {
        require(map == L1 || map == L2, "map 0 or 1");
        for (int64_t k = 0; k < of.size(); k++)
            require(of[k] >= 0 && of[k] < keyframes(), "keyframes there are");
        auto found = new_array<double, 2>({of.size(), P});
        for (int64_t k = 0; k < of.size(); k++) {
            const Pose first = first_of(int(map), of[k]);
            G::retract(first.data(), system[map].step_of_any(system[map].of(end_of(of[k]))),
                       found[k]);
        }
        return found;
    }

    Matrix<double> covariance(int64_t keyframe, int64_t other,
                              Matrix<const double> turn) override {
        require(std::min(keyframe, other) >= FIXED && std::max(keyframe, other) < keyframes(),
                "keyframe and other keyframes there are");
        require(turn.size() == K && turn.shape[1] == K, "turn of (k, k)");
        refuse();
        auto& of_l2 = system[L2];
        Square<K> blocks[2] = {};
        for (int r = 0; r < K; r++) {
            blocks[0][r * K + r] = 1.0;
            for (int c = 0; c < K; c++) blocks[1][r * K + c] = -turn(r, c);
        }
        const int64_t ends[2] = {of_l2.of(end_of(keyframe)), of_l2.of(end_of(other))};
        const Square<K> found = of_l2.predict(ends, blocks, {}).covariance;
        of_l2.forget(before[L2]);
        auto covariance = new_array<double, 2>({K, K});
        std::copy(found.begin(), found.end(), covariance.data);
        return covariance;
    }

    std::tuple<Vector<int64_t>, Matrix<double>, Vector<int64_t>, Array<double, 3>, Matrix<double>,
               Matrix<double>>
    moment(int64_t map) override {
        require(map == L1 || map == L2, "map 0 or 1");
        auto first = new_array<double, 2>({int64_t(came[map].size()), P});
        for (size_t k = 0; k < came[map].size(); k++)
            std::copy(came[map][k].begin(), came[map][k].end(), first[k]);
        return std::tuple_cat(system[map].moment(), std::make_tuple(first));
    }

  private:
    int64_t end_of(int64_t keyframe) const { return std::max(keyframe - fixed, FIXED); }

    Pose first_of(int map, int64_t keyframe) const {
        Pose pose;
        if (keyframe < 0) G::identity(pose.data());  // the world
        else if (keyframe >= known) pose = came[map][keyframe - known];
        else std::copy_n(begun[map][keyframe], P, pose.begin());
        return pose;
    }

    static void require_factor(Vector<const double> z, Matrix<const double> root) {
        require(z.size() == P, "z of (p,)");
        require(root.size() == K && root.shape[1] == K, "root of (k, k)");
    }

    // Whitened: the residual where the keyframes are now, the Jacobians where they were first
    // linearised.
    static Few<K> linearised(Vector<const double> z, Matrix<const double> root,
                             const Pose (&first)[2], const Pose (&now)[2],
                             Square<K> (&blocks)[2]) {
        Square<K> R;
        std::copy_n(root.data, K * K, R.begin());
        double both[2 * K * K];
        G::jacobians(z.data, first[0].data(), first[1].data(), both);
        for (int side : {0, 1}) {
            Square<K> J;
            std::copy_n(both + side * K * K, K * K, J.begin());
            blocks[side] = product<K>(R, J);
        }
        return product<K>(R, G::residual(z.data, now[0].data(), now[1].data()));
    }

    // What a map predicts of the factor that is asked for.
    typename System::Innovation look(int map) {
        int64_t ends[2];
        Pose first[2], now[2];
        for (int side : {0, 1}) {
            ends[side] = system[map].of(end_of(asked[side]));
            first[side] = first_of(map, asked[side]);
        }
        for (int side : {0, 1})
            G::retract(first[side].data(), system[map].step(ends[side], side), now[side].data());
        Square<K> blocks[2];
        Vector<const double> z(asked_z.data(), nullptr);
        Matrix<const double> root(asked_root.data(), nullptr);
        z.shape[0] = P, root.shape[0] = root.shape[1] = K;
        const Few<K> residual = linearised(z, root, first, now, blocks);
        return system[map].predict(ends, blocks, residual);
    }

    int64_t fixed, known;
    double usual, mu;
    // Noise of the first factor of a keyframe, by map; of loops in the L2 map.
    Few<K> of_keyframes[MAPS], variance, remaining;
    Matrix<const double> begun[MAPS];
    std::vector<Pose> came[MAPS];
    System system[MAPS];
    // The factor predicted last, and how many points there were before it.
    std::array<int64_t, 2> asked;
    Pose asked_z;
    Square<K> asked_root;
    typename System::Innovation innovation;
    bool has_innovation = false;
    int64_t before[MAPS] = {0, 0};
};

inline std::unique_ptr<Front> begin(
    Matrix<const double> l1, Matrix<const double> l2, int64_t fixed, double usual, double mu,
    double of_odometry, double of_loops, int64_t longest,
    Vector<const double> panels_1, Vector<const int32_t> first_1, Vector<const int64_t> start_1,
    Vector<const int32_t> rows_1, Vector<const int64_t> offset_1, Vector<const int64_t> stride_1,
    Vector<const int32_t> position_1, Vector<const int32_t> owner_1,
    Vector<const double> panels_2, Vector<const int32_t> first_2, Vector<const int64_t> start_2,
    Vector<const int32_t> rows_2, Vector<const int64_t> offset_2, Vector<const int64_t> stride_2,
    Vector<const int32_t> position_2, Vector<const int32_t> owner_2) {
    auto of_l1 = std::make_unique<Factor>(panels_1, first_1, start_1, rows_1, offset_1, stride_1,
                                          position_1, owner_1);
    auto of_l2 = std::make_unique<Factor>(panels_2, first_2, start_2, rows_2, offset_2, stride_2,
                                          position_2, owner_2);
    require(l1.size() == l2.size() && l1.shape[1] == l2.shape[1], "l1 and l2 of one shape (n, p)");
    require(fixed >= 0 && of_l1->size() == l1.size() - fixed && of_l2->size() == of_l1->size(),
            "factors of all keyframes but the fixed ones");
    require(l1.shape[1] == Plane::P || l1.shape[1] == Space::P, "poses (n, 3) or (n, 7)");
    if (l1.shape[1] == Plane::P)
        return std::make_unique<FrontOf<Plane>>(l1, l2, fixed, usual, mu, of_odometry, of_loops,
                                                longest, std::move(of_l1), std::move(of_l2));
    return std::make_unique<FrontOf<Space>>(l1, l2, fixed, usual, mu, of_odometry, of_loops,
                                            longest, std::move(of_l1), std::move(of_l2));
}

// Write the steps of new keyframes, the last of all (n, k): x = turn x_parent + shift.
inline void hang(Vector<const int64_t> parent, Array<const double, 3> turn,
                 Matrix<const double> shift, Matrix<double> steps) {
    const int64_t k = steps.shape[1], fresh = parent.size(), known = steps.size() - fresh;
    require(known >= 0 && turn.size() == fresh && turn.shape[1] == k && turn.shape[2] == k &&
                shift.size() == fresh && shift.shape[1] == k,
            "parent (b,), turn (b, k, k) and shift (b, k) of the last of steps (n, k)");
    for (int64_t s = 0; s < fresh; s++) {
        require(parent[s] < known + s, "parent of keyframes before each");
        for (int64_t r = 0; r < k; r++) {
            double total = shift(s, r);
            for (int64_t c = 0; parent[s] >= 0 && c < k; c++)
                total += turn[s][r * k + c] * steps(parent[s], c);
            steps(known + s, r) = total;
        }
    }
}

// The methods of a front, as Python sees them.
inline int64_t keyframes(Front* self) { return self->keyframes(); }
inline int64_t rows(Front* self) { return self->rows(); }
inline int64_t points(Front* self) { return self->points(); }
inline bool append_keyframe(Front* self, int64_t i, int64_t j, Vector<const double> z,
                            Matrix<const double> root) {
    return self->append_keyframe(i, j, z, root);
}
inline std::tuple<double, double, double> predict(Front* self, int64_t i, int64_t j,
                                                  Vector<const double> z,
                                                  Matrix<const double> root) {
    return self->predict(i, j, z, root);
}
inline bool append(Front* self) { return self->append(); }
inline void refuse(Front* self) { self->refuse(); }
inline Matrix<double> poses(Front* self, int64_t map, Vector<const int64_t> keyframes) {
    return self->poses(map, keyframes);
}
inline Matrix<double> covariance(Front* self, int64_t keyframe, int64_t other,
                                 Matrix<const double> turn) {
    return self->covariance(keyframe, other, turn);
}
inline auto moment(Front* self, int64_t map) { return self->moment(map); }

static PyMethodDef methods_of_front[] = {
    METHOD(keyframes, "self"),
    METHOD(rows, "self"),
    METHOD(points, "self"),
    METHOD(append_keyframe, "self, i, j, z, root"),
    METHOD(predict, "self, i, j, z, root"),
    METHOD(append, "self"),
    METHOD(refuse, "self"),
    METHOD(poses, "self, map, keyframes"),
    METHOD(covariance, "self, keyframe, other, turn"),
    METHOD(moment, "self, map"),
    {}};
inline bool add_types(PyObject* module) { return add_type<Front>(module, methods_of_front); }

static PyMethodDef methods[] = {
    BRIEF(begin,
          "l1, l2, fixed, usual, mu, of_odometry, of_loops, longest, panels_1, first_1, start_1, "
          "rows_1, offset_1, stride_1, position_1, owner_1, panels_2, first_2, start_2, rows_2, "
          "offset_2, stride_2, position_2, owner_2"),
    FUNCTION(hang, "parent, turn, shift, steps"),
    {}};

}  // namespace front
