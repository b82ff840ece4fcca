// SPDX-License-Identifier: Apache-2.0
// A factored map bordered by later factors: Woodbury's identity, row by row.
//
// H = L L' of the keyframes there were is factored; points are the keyframes that later factors
// name. With C the covariance of all points and A, W^-1 the blocks and the noise of the factors
// of the border, x = m + C A' lambda solves the least squares problem of all,
//
//     S lambda = -(r + A m),    S = W^-1 + A C A' = F F',    F lower triangular.
//
// A point of an old keyframe p has L^-1 e_p, which is zero except on the path from p to the root
// of the elimination tree: the covariance of two is the product of what both paths share, the
// end of both. A new keyframe hangs on the point from which its first factor leads to it:
// x = turn x_parent + own + noise. What the border tells of a point e is R = F^-1 A C_e, a
// triangular solve. That of a keyframe which hangs on a point is the parent's, turned, and a
// factor that is appended adds K rows to it: so the newest keyframes have theirs at hand.
//
// Hager, "Updating the inverse of a matrix", SIAM Review 31, 1989.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <unordered_map>
#include <vector>

#include "arrays.hpp"
#include "lanes.hpp"
#include "poses.hpp"

namespace border {

constexpr int64_t FIXED = -1;
// So many new keyframes, the newest of some robots, have R at hand.
constexpr size_t TIPS = 4;

using poses::Few;
using poses::Square;

template <int K> Square<K> product(const Square<K>& a, const Square<K>& b) {
    Square<K> c{};
    for (int r = 0; r < K; r++)
        for (int e = 0; e < K; e++)
            for (int k = 0; k < K; k++) c[r * K + k] += a[r * K + e] * b[e * K + k];
    return c;
}
template <int K> Few<K> product(const Square<K>& a, const Few<K>& x) {
    Few<K> y{};
    for (int r = 0; r < K; r++)
        for (int c = 0; c < K; c++) y[r] += a[r * K + c] * x[c];
    return y;
}
template <int K> Square<K> transposed(const Square<K>& a) {
    Square<K> t;
    for (int r = 0; r < K; r++)
        for (int c = 0; c < K; c++) t[c * K + r] = a[r * K + c];
    return t;
}

// By Gauss-Jordan elimination with row pivots; false: it is singular.
template <int K> bool invert(Square<K> a, Square<K>& inverse) {
    inverse = {};
    for (int r = 0; r < K; r++) inverse[r * K + r] = 1.0;
    for (int k = 0; k < K; k++) {
        int best = k;
        for (int r = k + 1; r < K; r++)
            if (std::abs(a[r * K + k]) > std::abs(a[best * K + k])) best = r;
        if (!(std::abs(a[best * K + k]) > 0.0)) return false;
        for (int c = 0; c < K; c++) {
            std::swap(a[k * K + c], a[best * K + c]);
            std::swap(inverse[k * K + c], inverse[best * K + c]);
        }
        double scale = 1 / a[k * K + k];
        for (int c = 0; c < K; c++) a[k * K + c] *= scale, inverse[k * K + c] *= scale;
        for (int r = 0; r < K; r++) {
            if (r == k) continue;
            double factor = a[r * K + k];
            for (int c = 0; c < K; c++) {
                a[r * K + c] -= factor * a[k * K + c];
                inverse[r * K + c] -= factor * inverse[k * K + c];
            }
        }
    }
    return true;
}

// A = P P', P lower triangular; false: beyond double precision.
template <int K> bool root_of(const Square<K>& a, Square<K>& pivot) {
    pivot = {};
    for (int r = 0; r < K; r++)
        for (int c = 0; c <= r; c++) {
            double left = a[r * K + c];
            for (int e = 0; e < c; e++) left -= pivot[r * K + e] * pivot[c * K + e];
            if (r == c && !(left > 0.0)) return false;
            pivot[r * K + c] = r == c ? std::sqrt(left) : left / pivot[c * K + c];
        }
    return true;
}
template <int K> void solve_lower(const Square<K>& pivot, Few<K>& x) {
    for (int r = 0; r < K; r++) {
        for (int c = 0; c < r; c++) x[r] -= pivot[r * K + c] * x[c];
        x[r] /= pivot[r * K + r];
    }
}
template <int K> void solve_upper(const Square<K>& pivot, Few<K>& x) {  // by P'
    for (int r = K; r-- > 0;) {
        for (int c = r + 1; c < K; c++) x[r] -= pivot[c * K + r] * x[c];
        x[r] /= pivot[r * K + r];
    }
}

// Rows of K numbers side by side, each as one vector of so many lanes.
template <int K> constexpr int PAD = K == 3 ? 4 : 8;

// R rows of a matrix times rows X[from:to], subtracted from R rows.
template <int R, int K>
INLINE void subtract_products(const double* lines, int64_t stride, int64_t from, int64_t to,
                              const double* X, double* rows) {
    using Row = Lanes<PAD<K>>;
    Row even[R], odd[R];
    UNROLL for (int a = 0; a < R; a++) {
        even[a] = Row::load(rows + a * PAD<K>);
        odd[a] = Row::zero();
    }
    int64_t c = from;
    for (; c + 1 < to; c += 2) {
        Row x = Row::load(X + c * PAD<K>), y = Row::load(X + (c + 1) * PAD<K>);
        UNROLL for (int a = 0; a < R; a++) {
            even[a].take(lines[a * stride + c], x);
            odd[a].take(lines[a * stride + c + 1], y);
        }
    }
    if (c < to) {
        Row x = Row::load(X + c * PAD<K>);
        UNROLL for (int a = 0; a < R; a++) even[a].take(lines[a * stride + c], x);
    }
    UNROLL for (int a = 0; a < R; a++) (even[a] + odd[a]).store(rows + a * PAD<K>);
}

// K rows X divided by the lower triangle beside them, line a at lines + a stride.
template <int K> INLINE void divide_by(const double* lines, int64_t stride, double* X) {
    using Row = Lanes<PAD<K>>;
    for (int a = 0; a < K; a++) {
        Row row = Row::load(X + a * PAD<K>);
        for (int e = 0; e < a; e++) row.take(lines[a * stride + e], Row::load(X + e * PAD<K>));
        (row * (1 / lines[a * stride + a])).store(X + a * PAD<K>);
    }
}

// K rows of numbers that grow at their ends.
template <int K> struct Wide {
    std::vector<double> data;
    int64_t count = 0, stride = 0;

    double* operator[](int64_t r) { return data.data() + r * stride; }
    const double* operator[](int64_t r) const { return data.data() + r * stride; }
    void resize(int64_t columns) {
        if (columns > stride) {
            const int64_t wider = std::max(columns, 2 * stride);
            std::vector<double> moved(K * wider);
            for (int r = 0; r < K; r++) std::copy_n((*this)[r], count, moved.data() + r * wider);
            data.swap(moved);
            stride = wider;
        }
        count = columns;
    }
};

// Lines (K, stride) times rows of as many numbers, subtracted from (K, K).
template <int K>
INLINE void subtract_dots(const double* lines, int64_t stride, const Wide<K>& rows, int64_t count,
                          Square<K>& from) {
    constexpr int AT_ONCE = K == 3 ? 3 : 2;  // more would not fit into the registers
    using Part = Lanes<WIDTH>;
    for (int first = 0; first < K; first += AT_ONCE) {
        Part sums[AT_ONCE][K];
        UNROLL for (int a = 0; a < AT_ONCE; a++)
            UNROLL for (int r = 0; r < K; r++) sums[a][r] = Part::zero();
        int64_t c = 0;
        for (; c + WIDTH <= count; c += WIDTH) {
            Part x[K];
            UNROLL for (int r = 0; r < K; r++) x[r] = Part::load(rows[r] + c);
            UNROLL for (int a = 0; a < AT_ONCE; a++) {
                Part line = Part::load(lines + (first + a) * stride + c);
                UNROLL for (int r = 0; r < K; r++)
                    sums[a][r].part[0] += line.part[0] * x[r].part[0];
            }
        }
        for (int a = 0; a < AT_ONCE; a++)
            for (int r = 0; r < K; r++) {
                double total = 0.0;
                for (int l = 0; l < WIDTH; l++) total += sums[a][r][l];
                for (int64_t e = c; e < count; e++)
                    total += lines[(first + a) * stride + e] * rows[r][e];
                from[(first + a) * K + r] -= total;
            }
    }
}

// (K, K) divided by the lower triangle on its left.
template <int K> void divide(const Square<K>& pivot, Square<K>& x) {
    for (int a = 0; a < K; a++)
        for (int r = 0; r < K; r++) {
            for (int e = 0; e < a; e++) x[a * K + r] -= pivot[a * K + e] * x[e * K + r];
            x[a * K + r] /= pivot[a * K + a];
        }
}

// A sparse Cholesky factor in supernodes, as `cholesky` lays it out; Python owns the arrays.
class Factor {
  public:
    Vector<const double> panels;
    Vector<const int32_t> first, rows, position, owner;
    Vector<const int64_t> start, offset, stride;
    std::vector<int32_t> parent;  // of each supernode in the elimination tree, -1: a root

    Factor(Vector<const double> panels, Vector<const int32_t> first, Vector<const int64_t> start,
           Vector<const int32_t> rows, Vector<const int64_t> offset, Vector<const int64_t> stride,
           Vector<const int32_t> position, Vector<const int32_t> owner)
        : panels(panels), first(first), rows(rows), position(position), owner(owner), start(start),
          offset(offset), stride(stride), parent(first.size() - 1) {
        const int64_t count = first.size() - 1;
        require(count >= 0 && start.size() == count + 1 && offset.size() == count + 1 &&
                    stride.size() == count && owner.size() == position.size() &&
                    panels.size() >= offset[count] && rows.size() >= start[count] &&
                    first[count] == position.size(),
                "arrays of one Cholesky factor");
        for (int64_t s = 0; s < count; s++) {
            int64_t below = start[s] + columns(s);
            parent[s] = below < start[s + 1] ? owner[rows[below]] : -1;
        }
        for (auto* object : objects()) Py_INCREF(object);
    }
    ~Factor() {
        for (auto* object : objects()) Py_DECREF(object);
    }
    Factor(const Factor&) = delete;
    int64_t columns(int64_t s) const { return first[s + 1] - first[s]; }
    int64_t size() const { return position.size(); }

  private:
    std::array<PyObject*, 8> objects() const {
        return {panels.object, first.object, rows.object, position.object, owner.object,
                start.object, offset.object, stride.object};
    }
};

// The bordered system of one weighting; its keyframes are those of H, new ones follow.
template <int K> class System {
    static constexpr int WIDE = PAD<K>;
    using Row = Lanes<WIDE>;

    struct Point {
        int64_t keyframe, parent = FIXED;
        bool is_new = false, used = false;
        Few<K> mean{}, own{};
        Square<K> turn{}, noise{};
        // With all points up to itself, (K, K) each: (of that one, of this one).
        std::unique_ptr<double[]> covariance;
        // L^-1 e_p along the path to the root, (length, K, K), null: it is too long to be kept.
        std::unique_ptr<double[]> columns;
        int64_t length = 0;
    };
    struct Appended {
        int64_t ends[2];
        Square<K> blocks[2];
        std::unique_ptr<double[]> rows;  // of F, (K, rows before)
        Square<K> pivot;
    };
    // R' of a new keyframe, (K, rows).
    struct Tip {
        int64_t point;
        Wide<K> reduced;
    };

  public:
    // What the map predicts of a factor without it: r + J x, and the covariance of that.
    struct Innovation {
        int64_t ends[2];
        Square<K> blocks[2], covariance;
        Few<K> expected;
        std::unique_ptr<double[]> rows;
    };

    // longest : where the path to the root has more keyframes, L^-1 e_p is not kept, and H^-1 e_p
    // is solved for.
    System(std::unique_ptr<Factor> of, int64_t longest)
        : factor(std::move(of)), longest(longest), where(factor->size()),
          left(factor->parent.size()) {}

    int64_t rows() const { return int64_t(border.size()) * K; }
    int64_t points() const { return int64_t(point.size()); }
    int64_t keyframes() const { return factor->size() + int64_t(of_new.size()); }

    // The point that a keyframe is, or becomes.
    int64_t of(int64_t keyframe) {
        if (keyframe < 0) return FIXED;
        if (keyframe >= factor->size()) return of_new[keyframe - factor->size()];
        auto found = of_old.find(keyframe);
        return found != of_old.end() ? found->second : reach(keyframe);
    }

    // Take back the points that came since there were so many, if no factor keeps them.
    void forget(int64_t since) {
        while (points() > since && !point.back().used && !point.back().is_new) {
            of_old.erase(point.back().keyframe);
            point.pop_back();
        }
        known_pulls = std::min(known_pulls, points());
        solved[0] = solved[1] = FIXED;
    }

    // The step of a point by R; side : of a factor, whose other end is not forgotten for it.
    Few<K> step(int64_t p, int side = 0) {
        Few<K> x{};
        if (p < 0) return x;
        const Wide<K>& R = reduced(p, side);
        for (int r = 0; r < K; r++) {
            double total = 0.0;
            for (int64_t c = 0; c < R.count; c++) total += R[r][c] * right[c];
            x[r] = point[p].mean[r] + total;
        }
        return x;
    }

    // The step of a point: by R where it is at hand, else by A' lambda, which serves all points.
    Few<K> step_of_any(int64_t p) {
        if (p < 0 || tip_of(p)) return step(p);
        const Few<K>* g = pulls();
        Few<K> x = point[p].mean;
        for (int64_t other = 0; other < points(); other++) {
            Few<K> added = product<K>(between(p, other), g[other]);
            for (int r = 0; r < K; r++) x[r] += added[r];
        }
        return x;
    }

    // Append a keyframe: x = turn x_parent + own + noise.
    void hang(int64_t parent, const Square<K>& turn, const Few<K>& own, const Square<K>& noise) {
        const int64_t t = points();
        Point one;
        one.keyframe = keyframes();
        one.is_new = one.used = true;
        one.parent = parent, one.turn = turn, one.own = one.mean = own, one.noise = noise;
        one.covariance.reset(new double[(t + 1) * K * K]);
        double* to = one.covariance.get();
        std::fill_n(to, t * K * K, 0.0);
        std::copy(noise.begin(), noise.end(), to + t * K * K);
        if (parent >= 0) {
            Few<K> moved = product<K>(turn, point[parent].mean);
            for (int r = 0; r < K; r++) one.mean[r] += moved[r];
            Square<K> with_parent{};
            for (int64_t s = 0; s < t; s++) {
                Square<K> with = product<K>(turn, between(parent, s));  // (new, s)
                Square<K> block = transposed<K>(with);
                std::copy(block.begin(), block.end(), to + s * K * K);
                if (s == parent) with_parent = block;
            }
            Square<K> own_part = product<K>(turn, with_parent);
            for (int k = 0; k < K * K; k++) to[t * K * K + k] += own_part[k];
        }
        pass_on_tip(parent, t, turn);
        if (parent >= 0) point[parent].used = true;
        of_new.push_back(t);
        point.push_back(std::move(one));
    }

    // r + J_i x_i + J_j x_j of points; `expected` at the steps there are.
    Innovation predict(const int64_t (&ends)[2], const Square<K> (&blocks)[2],
                       const Few<K>& expected) {
        const int64_t n = rows();
        Innovation all{{ends[0], ends[1]}, {blocks[0], blocks[1]}, {}, expected, nullptr};
        all.rows.reset(new double[K * n]);
        std::fill_n(all.rows.get(), K * n, 0.0);
        for (int side = 0; side < 2; side++) {
            if (ends[side] < 0) continue;
            const Wide<K>& R = reduced(ends[side], side);
            const Square<K>& J = blocks[side];
            for (int a = 0; a < K; a++)
                for (int r = 0; r < K; r++) {
                    double* row = all.rows.get() + a * n;
                    const double *from = R[r], entry = J[a * K + r];
                    for (int64_t c = 0; c < n; c++) row[c] += entry * from[c];
                }
            for (int other = 0; other < 2; other++) {
                if (ends[other] < 0) continue;
                Square<K> part = product<K>(product<K>(J, between(ends[side], ends[other])),
                                            transposed<K>(blocks[other]));
                for (int k = 0; k < K * K; k++) all.covariance[k] += part[k];
            }
        }
        for (int r = 0; r < K; r++)
            for (int c = 0; c <= r; c++) {
                double total = (all.covariance[r * K + c] + all.covariance[c * K + r]) / 2;
                const double *one = all.rows.get() + r * n, *other = all.rows.get() + c * n;
                double taken = 0.0;
                for (int64_t e = 0; e < n; e++) taken += one[e] * other[e];
                all.covariance[r * K + c] = all.covariance[c * K + r] = total - taken;
            }
        return all;
    }

    // Append a factor just predicted; false: beyond double precision, nothing is appended.
    bool append(Innovation& of, const Few<K>& noise) {
        const int64_t n = rows();
        Square<K> whole = of.covariance;
        for (int r = 0; r < K; r++) whole[r * K + r] += noise[r];
        Appended one{{of.ends[0], of.ends[1]}, {of.blocks[0], of.blocks[1]}, nullptr, {}};
        if (!root_of<K>(whole, one.pivot)) return false;
        for (Tip& tip : tips) {
            // Its covariance with the factor, less what the border has told of it.
            Square<K> X{};
            for (int side = 0; side < 2; side++) {
                if (of.ends[side] < 0) continue;
                Square<K> with = product<K>(of.blocks[side], between(of.ends[side], tip.point));
                for (int k = 0; k < K * K; k++) X[k] += with[k];
            }
            subtract_dots<K>(of.rows.get(), n, tip.reduced, n, X);
            divide<K>(one.pivot, X);
            tip.reduced.resize(n + K);
            write(X, tip.reduced, n);
        }
        one.rows = std::move(of.rows);
        Few<K> to_right;
        for (int r = 0; r < K; r++) to_right[r] = -of.expected[r];
        solve_lower<K>(one.pivot, to_right);
        right.insert(right.end(), to_right.begin(), to_right.end());
        for (int64_t end : one.ends)
            if (end >= 0) point[end].used = true;
        border.push_back(std::move(one));
        known_pulls = 0;
        return true;
    }

    // What pulls at keyframes of H once all has been passed on to what hangs on them; and of the
    // new ones what they hang on, and x = turn x_parent + shift.
    std::tuple<Vector<int64_t>, Matrix<double>, Vector<int64_t>, Array<double, 3>, Matrix<double>>
    moment() {
        const Few<K>* known = pulls();
        std::vector<Few<K>> g(known, known + points());
        for (int64_t s = points(); s-- > 0;)
            if (int64_t parent = point[s].parent; parent >= 0) {
                Few<K> passed = product<K>(transposed<K>(point[s].turn), g[s]);
                for (int r = 0; r < K; r++) g[parent][r] += passed[r];
            }
        const int64_t fresh = int64_t(of_new.size()), old = points() - fresh;
        auto named = new_vector<int64_t>(old), parents = new_vector<int64_t>(fresh);
        auto pulled = new_array<double, 2>({old, K}), shifts = new_array<double, 2>({fresh, K});
        auto turns = new_array<double, 3>({fresh, K, K});
        int64_t a = 0, b = 0;
        for (int64_t s = 0; s < points(); s++) {
            const Point& one = point[s];
            if (one.is_new) {
                Few<K> shift = product<K>(one.noise, g[s]);
                for (int r = 0; r < K; r++) shifts(b, r) = shift[r] + one.own[r];
                std::copy(one.turn.begin(), one.turn.end(), turns[b]);
                parents[b++] = one.parent < 0 ? FIXED : point[one.parent].keyframe;
            } else {
                std::copy(g[s].begin(), g[s].end(), pulled[a]);
                named[a++] = one.keyframe;
            }
        }
        return {named, pulled, parents, turns, shifts};
    }

  private:
    // The covariance of two points, (of s, of t).
    Square<K> between(int64_t s, int64_t t) const {
        Square<K> block;
        std::copy_n(point[std::max(s, t)].covariance.get() + std::min(s, t) * K * K, K * K,
                    block.begin());
        return s <= t ? block : transposed<K>(block);
    }

    Tip* tip_of(int64_t p) {
        for (Tip& tip : tips)
            if (tip.point == p) return &tip;
        return nullptr;
    }

    static void write(const Square<K>& block, Wide<K>& R, int64_t at) {
        for (int a = 0; a < K; a++)
            for (int r = 0; r < K; r++) R[r][at + a] = block[a * K + r];
    }

    // R' of a point, (K, rows): at hand, or solved for.
    const Wide<K>& reduced(int64_t p, int side) {
        if (Tip* tip = tip_of(p)) return tip->reduced;
        Wide<K>& R = spare[side];
        if (solved[side] == p && R.count == rows()) return R;
        solved[side] = p;
        R.resize(rows());
        for (size_t f = 0; f < border.size(); f++) {
            const Appended& one = border[f];
            const int64_t n = int64_t(f) * K;
            Square<K> X{};
            for (int side = 0; side < 2; side++) {
                if (one.ends[side] < 0) continue;
                Square<K> with = product<K>(one.blocks[side], between(one.ends[side], p));
                for (int k = 0; k < K * K; k++) X[k] += with[k];
            }
            subtract_dots<K>(one.rows.get(), n, R, n, X);
            divide<K>(one.pivot, X);
            write(X, R, n);
        }
        return R;
    }

    // R of a new keyframe, that of its parent turned; the parent's is given up.
    void pass_on_tip(int64_t parent, int64_t p, const Square<K>& turn) {
        Tip passed{p, {}};
        if (Tip* tip = parent < 0 ? nullptr : tip_of(parent)) {
            passed.reduced = std::move(tip->reduced);
            tips.erase(tips.begin() + (tip - tips.data()));
        } else if (parent >= 0) {
            passed.reduced = reduced(parent, 0);
        } else {
            passed.reduced.resize(rows());  // zeros
        }
        Wide<K>& R = passed.reduced;
        double* row[K];
        for (int r = 0; r < K; r++) row[r] = R[r];
        for (int64_t c = 0; parent >= 0 && c < R.count; c++) {
            double before[K];
            for (int r = 0; r < K; r++) before[r] = row[r][c];
            for (int r = 0; r < K; r++) {
                double total = 0.0;
                for (int e = 0; e < K; e++) total += turn[r * K + e] * before[e];
                row[r][c] = total;
            }
        }
        if (tips.size() == TIPS) tips.erase(tips.begin());
        tips.push_back(std::move(passed));
    }

    // A' lambda, F' lambda = right, at all points; nothing pulls at those that came since.
    const Few<K>* pulls() {
        if (!known_pulls || !border.size()) {
            gradient.assign(points(), Few<K>{});
            std::vector<double> x(right);
            for (size_t f = border.size(); f-- > 0;) {
                const Appended& one = border[f];
                const int64_t n = int64_t(f) * K;
                Few<K> own;
                std::copy_n(&x[n], K, own.begin());
                solve_upper<K>(one.pivot, own);
                for (int a = 0; a < K; a++) {
                    const double *line = one.rows.get() + a * n, value = own[a];
                    for (int64_t c = 0; c < n; c++) x[c] -= line[c] * value;
                }
                for (int side = 0; side < 2; side++)
                    if (one.ends[side] >= 0)
                        for (int r = 0; r < K; r++)
                            for (int c = 0; c < K; c++)
                                gradient[one.ends[side]][c] +=
                                    one.blocks[side][r * K + c] * own[r];
            }
        }
        gradient.resize(points());
        for (int64_t s = std::max<int64_t>(known_pulls, 0); known_pulls && s < points(); s++)
            gradient[s] = {};
        known_pulls = points();
        return gradient.data();
    }

    int64_t reach(int64_t keyframe);
    void descend();

    std::unique_ptr<Factor> factor;
    int64_t longest;
    std::vector<Point> point;
    std::vector<Appended> border;
    std::vector<double> right;  // F^-1 times the right hand side
    std::vector<int64_t> of_new;
    std::unordered_map<int64_t, int64_t> of_old;
    std::vector<Tip> tips;
    std::vector<Few<K>> gradient;
    int64_t known_pulls = 0;
    // R of the ends of a factor, and of which points they are.
    Wide<K> spare[2];
    int64_t solved[2] = {FIXED, FIXED};
    // In the values on the way of a point: the place of a position, how much of the way is left
    // from a supernode on, 0: it is not on it.
    std::vector<int32_t> where;
    std::vector<int64_t> left;
    std::vector<int32_t> way;
    std::vector<double> values;
    int64_t length = 0;
};

// Append an old keyframe, its covariances with all points; return its point.
template <int K> int64_t System<K>::reach(int64_t keyframe) {
    const Factor& L = *factor;
    const int64_t t = points(), last = L.position[keyframe];
    Point one;
    one.keyframe = keyframe;
    // L^-1 e_p for its K columns, side by side, up to the root.
    way.clear();
    length = 0;
    for (int64_t s = L.owner[last]; s >= 0; s = L.parent[s]) {
        way.push_back(int32_t(s));
        for (int64_t q = L.first[s]; q < L.first[s + 1]; q++) where[q] = int32_t(length++);
    }
    values.assign(length * K * WIDE, 0.0);
    for (int q = 0; q < K; q++) values[(where[last] * K + q) * WIDE + q] = 1.0;
    for (int64_t s : way) {
        const double* panel = &L.panels[L.offset[s]];
        const int64_t stride = L.stride[s], columns = L.columns(s);
        const int64_t count = L.start[s + 1] - L.start[s];
        const int32_t* rows = L.rows.data + L.start[s];
        const int64_t skip = std::max<int64_t>(L.first[s], last) - L.first[s];
        double* own = &values[where[L.first[s]] * K * WIDE];
        for (int64_t b = skip; b < columns; b++) {
            const double* lines = panel + b * K * stride;
            subtract_products<K, K>(lines, stride, skip * K, b * K, own, own + b * K * WIDE);
            divide_by<K>(lines + b * K, stride, own + b * K * WIDE);
        }
        for (int64_t b = columns; b < count; b++)
            subtract_products<K, K>(panel + b * K * stride, stride, skip * K, columns * K, own,
                                    &values[where[rows[b]] * K * WIDE]);
    }
    int64_t before = 0;
    for (int64_t s : way) left[s] = length - before, before += L.columns(s);
    // Loads of whole vectors go beyond the last row.
    std::unique_ptr<double[]> columns(new double[length * K * K + WIDE]);
    for (int64_t r = 0; r < length * K; r++)
        std::copy_n(&values[r * WIDE], K, columns.get() + r * K);
    std::fill_n(columns.get() + length * K * K, WIDE, 0.0);

    one.covariance.reset(new double[(t + 1) * K * K]);
    double* to = one.covariance.get();
    auto multiply_ends = [](const double* a, const double* b, int64_t count, double* block) {
        Row even[K], odd[K];
        UNROLL for (int r = 0; r < K; r++) even[r] = Row::zero(), odd[r] = Row::zero();
        int64_t c = 0;
        for (; c + 1 < count; c += 2) {
            Row x = Row::load(b + c * K), y = Row::load(b + (c + 1) * K);
            UNROLL for (int r = 0; r < K; r++) {
                even[r].add(a[c * K + r], x);
                odd[r].add(a[(c + 1) * K + r], y);
            }
        }
        if (c < count) {
            Row x = Row::load(b + c * K);
            UNROLL for (int r = 0; r < K; r++) even[r].add(a[c * K + r], x);
        }
        for (int r = 0; r < K; r++) {
            Row row = even[r] + odd[r];
            for (int e = 0; e < K; e++) block[r * K + e] = row[e];
        }
    };
    bool all_kept = true;
    for (int64_t s = 0; s < t; s++) {
        const Point& other = point[s];
        double* block = to + s * K * K;
        if (other.is_new) {
            std::fill_n(block, K * K, 0.0);
        } else if (other.columns) {
            int64_t above = L.owner[L.position[other.keyframe]];
            while (above >= 0 && !left[above]) above = L.parent[above];
            const int64_t shared = above < 0 ? 0 : left[above];
            multiply_ends(other.columns.get() + (other.length - shared) * K * K,
                          columns.get() + (length - shared) * K * K, shared * K, block);
        } else {
            all_kept = false;
        }
    }
    multiply_ends(columns.get(), columns.get(), length * K, to + t * K * K);
    for (int64_t s : way) left[s] = 0;
    one.length = length;
    if (!all_kept) {
        descend();
        for (int64_t s = 0; s < t; s++)
            if (!point[s].is_new && !point[s].columns)
                for (int r = 0; r < K; r++)
                    std::copy_n(&values[(where[L.position[point[s].keyframe]] * K + r) * WIDE], K,
                                to + (s * K + r) * K);
    }
    if (length <= longest) one.columns = std::move(columns);
    // In the order they came: each after what it hangs on.
    for (int64_t s = 0; s < t; s++)
        if (int64_t parent = point[s].parent; parent >= 0) {
            Square<K> with;
            std::copy_n(to + parent * K * K, K * K, with.begin());
            with = product<K>(point[s].turn, with);
            std::copy(with.begin(), with.end(), to + s * K * K);
        }
    of_old[keyframe] = t;
    point.push_back(std::move(one));
    return t;
}

// Solve with L' on the ways of all points without columns, from L^-1 e_p in `values`.
template <int K> void System<K>::descend() {
    const Factor& L = *factor;
    std::vector<char> seen(L.parent.size(), 0), own(L.parent.size(), 0);
    for (int64_t s : way) own[s] = 1;
    std::vector<int32_t> ways, branch;
    for (const Point& other : point) {
        if (other.is_new || other.columns) continue;
        branch.clear();
        for (int64_t s = L.owner[L.position[other.keyframe]]; s >= 0 && !seen[s]; s = L.parent[s])
            seen[s] = 1, branch.push_back(int32_t(s));
        ways.insert(ways.end(), branch.rbegin(), branch.rend());  // each after the one above it
    }
    for (int64_t s : ways)
        if (!own[s])
            for (int64_t q = L.first[s]; q < L.first[s + 1]; q++) where[q] = int32_t(length++);
    values.resize(length * K * WIDE, 0.0);
    for (int64_t s : ways) {
        const double* panel = &L.panels[L.offset[s]];
        const int64_t stride = L.stride[s], columns = L.columns(s), width = columns * K;
        const int64_t count = L.start[s + 1] - L.start[s];
        const int32_t* rows = L.rows.data + L.start[s];
        double* X = &values[where[L.first[s]] * K * WIDE];
        auto subtract = [&](const double* line, int64_t to, Row x) {
            for (int64_t c = 0; c < to; c++) {
                Row row = Row::load(X + c * WIDE);
                row.take(line[c], x);
                row.store(X + c * WIDE);
            }
        };
        for (int64_t b = columns; b < count; b++)
            for (int a = 0; a < K; a++)
                subtract(panel + (b * K + a) * stride, width,
                         Row::load(&values[(where[rows[b]] * K + a) * WIDE]));
        for (int64_t r = width; r-- > 0;) {
            const double* line = panel + r * stride;
            Row x = Row::load(X + r * WIDE) * (1 / line[r]);
            x.store(X + r * WIDE);
            subtract(line, r, x);
        }
    }
}

}  // namespace border
