// SPDX-License-Identifier: Apache-2.0
// From the rays of a laser to points with normals; see `l1slam_ros.core.scans.points`.
#pragma once
#include <algorithm>
#include <cmath>
#include <tuple>
#include <vector>

#include "arrays.hpp"

namespace scan_points {

constexpr double PI = 3.14159265358979323846;
// [m] Points are at least so far apart along a scan.
constexpr double SPACING = 0.05;
// [m] A normal is of the line through neighbours within so much; RMS distance to that line.
constexpr double NORMAL_REACH = 0.25, OFF_LINE = 0.03;
// The same by the noise of the ranges, and the most that is taken for noise [m].
constexpr double REACH_OF_NOISE = 8.0, OFF_OF_NOISE = 1.5, MOST_NOISE = 0.08;
// Far away rays are wide apart: neighbours within so many rays' distance.
constexpr double RAYS = 10.0;
// Neighbourhoods of a point that are tried for a line, each half as wide as the one before.
constexpr int WINDOWS = 3;
// Of second differences the lower quartile, which corners and stray rays do not reach; by how much
// it is less than the noise, where that is normal.
constexpr double SMOOTH = 0.25, OF_SMOOTH = 0.3186 * 2.449489742783178;
// Of fewer rays that are as near to each other as points may be, nobody can tell their noise.
constexpr size_t FEWEST = 20;

struct Point {
    double x, y;
    Point operator-(Point other) const { return {x - other.x, y - other.y}; }
    double length() const { return std::sqrt(x * x + y * y); }
};
using Points = std::vector<Point>;

inline bool is_near(Point a, Point b, double reach) {
    const Point d = a - b;
    return d.x * d.x + d.y * d.y <= reach * reach;
}

// The entry that would be number k if they were in order.
inline double ranked(std::vector<double>& entries, size_t k) {
    std::nth_element(entries.begin(), entries.begin() + std::ptrdiff_t(k), entries.end());
    return entries[k];
}

// The standard deviation of ranges, by how far they are off their neighbours [m].
inline double noise_of(Vector<const double> ranges, const std::vector<bool>& hit,
                       double increment) {
    std::vector<double> off;
    off.reserve(hit.size());
    for (size_t k = 1; k + 1 < hit.size(); k++) {
        const auto at = int64_t(k);
        if (hit[k - 1] && hit[k] && hit[k + 1] && ranges[at] * increment < SPACING)
            off.push_back(std::abs(ranges[at - 1] - 2 * ranges[at] + ranges[at + 1]));
    }
    if (off.size() < FEWEST) return 0.0;
    return std::min(ranked(off, size_t(SMOOTH * double(off.size()))) / OF_SMOOTH, MOST_NOISE);
}

// Which points in a row hang together with neither neighbour. They are of no surface, and what is
// on both sides of one may be: rays that go through glass, or end anywhere, would cut walls to
// pieces, too short for a normal. `reach` is within which neighbours are; half as far they hang
// together, as on a surface.
inline std::vector<bool> lone(const Points& points, const std::vector<double>& reach) {
    std::vector<bool> alone(points.size(), true);
    for (size_t k = 1; k < points.size(); k++) {
        const double way = (points[k] - points[k - 1]).length();
        if (!(way > 0.5 * reach[k])) alone[k] = false;
        if (!(way > 0.5 * reach[k - 1])) alone[k - 1] = false;
    }
    return alone;
}

// The least range in each bearing, infinite where the laser looked and nothing was in range, NaN
// where it did not look. A bearing between two rays is seen by both: so far as the nearer one.
inline Vector<double> view_of(Vector<const double> ranges, Vector<const double> angles,
                              Vector<const int64_t> bearings, const std::vector<bool>& looked,
                              const std::vector<bool>& hit, int64_t bins) {
    auto view = new_vector<double>(bins);
    std::fill_n(view.data, bins, std::nan(""));
    std::vector<double> spacings;
    spacings.reserve(hit.size());
    double before = std::nan("");
    for (int64_t k = 0; k < ranges.size(); k++) {
        if (!looked[size_t(k)]) continue;
        double& least = view[bearings[k]];
        least = std::fmin(least, hit[size_t(k)] ? ranges[k] : HUGE_VAL);
        const double spacing = std::abs(angles[k] - before);
        if (spacing < HUGE_VAL) spacings.push_back(spacing);  // NaN is not
        before = angles[k];
    }
    if (spacings.empty()) return view;
    const size_t half = spacings.size() / 2;
    double spacing = ranked(spacings, half);
    if (spacings.size() % 2 == 0)
        spacing = (spacing + *std::max_element(spacings.begin(),
                                               spacings.begin() + std::ptrdiff_t(half))) / 2;
    const double steps = std::min(double(bins) * spacing / (2 * PI) + 1e-6, double(bins));
    const std::vector<double> seen(view.data, view.data + bins);
    // The range in the first bearing that is seen, from one on; NaN: in none so near.
    auto first_seen = [&](int64_t at, int64_t step) {
        for (int64_t n = int64_t(steps); n > 0; n--) {
            at = at + step < 0 ? bins - 1 : at + step == bins ? 0 : at + step;
            if (!std::isnan(seen[size_t(at)])) return seen[size_t(at)];
        }
        return std::nan("");
    };
    for (int64_t at = 0; at < bins; at++) {
        if (!std::isnan(view[at])) continue;
        const double left = first_seen(at, -1), right = first_seen(at, 1);
        if (!std::isnan(left) && !std::isnan(right)) view[at] = std::min(left, right);
    }
    return view;
}

// The first and the last point around k within reach, none further than `linked` from the next.
struct Window {
    size_t first, last;
    Window(const Points& points, size_t k, double reach, double linked) : first(k), last(k) {
        while (first > 0 && is_near(points[first - 1], points[k], reach) &&
               is_near(points[first - 1], points[first], linked))
            first--;
        while (last + 1 < points.size() && is_near(points[last + 1], points[k], reach) &&
               is_near(points[last + 1], points[last], linked))
            last++;
    }
};

// The line through points: its angle, and their mean squared distance from it.
struct Line {
    double angle, square;
    Line(const Points& points, Window of) {
        const double count = double(of.last - of.first + 1);
        double mx = 0.0, my = 0.0, xx = 0.0, xy = 0.0, yy = 0.0;
        for (size_t j = of.first; j <= of.last; j++) mx += points[j].x, my += points[j].y;
        mx /= count, my /= count;
        for (size_t j = of.first; j <= of.last; j++) {
            const double dx = points[j].x - mx, dy = points[j].y - my;
            xx += dx * dx, xy += dx * dy, yy += dy * dy;
        }
        xx /= count, xy /= count, yy /= count;
        const double half = 0.5 * (xx - yy);
        angle = 0.5 * std::atan2(2 * xy, xx - yy);
        square = 0.5 * (xx + yy) - std::sqrt(half * half + xy * xy);
    }
};

// The normal of point k, seen from the laser and turned to it. To its neighbours on both sides
// that hang together within `least_reach`, or within `widening` of the range, a line is fitted;
// where they are further than `off` from it (RMS), as at a corner, to those within half as much,
// and half of that. Zero: there is no neighbour on one side, or no line.
inline Point normal_of(const Points& away, size_t k, double least_reach, double widening,
                       double off) {
    double reach = std::max(least_reach, widening * away[k].length());
    const double linked = 0.5 * reach;
    for (int n = 0; n < WINDOWS; n++, reach *= 0.5) {
        const Window window(away, k, reach, linked);
        if (window.first == k || window.last == k) break;
        const Line line(away, window);
        if (!(line.square <= off * off)) continue;
        const Point normal{-std::sin(line.angle), std::cos(line.angle)};
        const bool is_turned = normal.x * away[k].x + normal.y * away[k].y > 0;
        return is_turned ? Point{-normal.x, -normal.y} : normal;
    }
    return {0.0, 0.0};
}

// Points at equal distances along what a scan has seen, their normals, and the view in so many
// equal bearings. `ends` is where each ray ends; it looks where its range is above `range_min`,
// and hits below `range_max`.
inline std::tuple<Matrix<double>, Matrix<double>, Vector<double>> points_of(
    Matrix<const double> ends, Vector<const double> ranges, Vector<const double> angles,
    Vector<const int64_t> bearings, int64_t bins, double range_min, double range_max,
    double increment, Vector<const double> centre) {
    require(ends.size() == ranges.size() && angles.size() == ranges.size() &&
                bearings.size() == ranges.size(),
            "ends, ranges, angles and bearings must be as many");
    require(ends.shape[1] == 2, "ends must have two columns");
    require(bins >= 1, "bins must be positive");
    require(centre.size() == 2, "centre must have two entries");
    const auto rays = size_t(ranges.size());
    std::vector<bool> looked(rays), hit(rays);
    for (int64_t k = 0; k < ranges.size(); k++) {
        require(bearings[k] >= 0 && bearings[k] < bins, "bearings must be below bins");
        looked[size_t(k)] = ranges[k] > range_min;  // NaN is not
        hit[size_t(k)] = looked[size_t(k)] && ranges[k] < range_max;
    }
    auto view = view_of(ranges, angles, bearings, looked, hit, bins);
    const double noise = noise_of(ranges, hit, increment), widening = RAYS * increment;
    const double least_reach = std::max(NORMAL_REACH, REACH_OF_NOISE * noise);
    const double off = std::max(OFF_LINE, OFF_OF_NOISE * noise);
    const Point laser{centre[0], centre[1]};
    Points all;
    std::vector<double> reach;
    all.reserve(rays), reach.reserve(rays);
    for (int64_t k = 0; k < ranges.size(); k++) {
        if (!hit[size_t(k)]) continue;
        all.push_back({ends(k, 0), ends(k, 1)});
        reach.push_back(std::max(least_reach, widening * ranges[k]));
    }
    const std::vector<bool> alone = lone(all, reach);
    // What is of surfaces, thinned out; after it what is of none.
    Points kept, stray, away;
    kept.reserve(rays), away.reserve(rays);
    for (size_t k = 0; k < all.size(); k++) {
        if (alone[k]) stray.push_back(all[k]);
        else if (kept.empty() || !is_near(all[k], kept.back(), SPACING)) {
            kept.push_back(all[k]);
            away.push_back(all[k] - laser);
        }
    }
    const auto count = int64_t(kept.size() + stray.size());
    auto xy = new_array<double, 2>({count, 2}), normals = new_array<double, 2>({count, 2});
    kept.insert(kept.end(), stray.begin(), stray.end());
    for (size_t k = 0; k < kept.size(); k++) {
        const Point normal = k < away.size()
            ? normal_of(away, k, least_reach, widening, off) : Point{0.0, 0.0};
        const auto at = int64_t(k);
        xy(at, 0) = kept[k].x, xy(at, 1) = kept[k].y;
        normals(at, 0) = normal.x, normals(at, 1) = normal.y;
    }
    return {xy, normals, view};
}

static PyMethodDef methods[] = {
    FUNCTION(points_of,
             "ends, ranges, angles, bearings, bins, range_min, range_max, increment, centre"),
    {}};

}  // namespace scan_points
