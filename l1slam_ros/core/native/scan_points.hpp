// SPDX-License-Identifier: Apache-2.0
// From the rays of a laser to points with normals; see `l1slam_ros.core.scans.points`.
#pragma once
#include <algorithm>
#include <cmath>

#include "arrays.hpp"

namespace scan_points {

// Neighbourhoods of a point that are tried for a line, each half as wide as the one before.
constexpr int WINDOWS = 3;

inline bool is_near(const double* a, const double* b, double reach) {
    const double dx = a[0] - b[0], dy = a[1] - b[1];
    return dx * dx + dy * dy <= reach * reach;
}

// The first and the last point around k within reach, none further than `linked` from the next.
struct Window {
    int64_t first, last;
    Window(Matrix<const double> points, int64_t count, int64_t k, double reach, double linked)
        : first(k), last(k) {
        while (first > 0 && is_near(points[first - 1], points[k], reach) &&
               is_near(points[first - 1], points[first], linked))
            first--;
        while (last < count - 1 && is_near(points[last + 1], points[k], reach) &&
               is_near(points[last + 1], points[last], linked))
            last++;
    }
};

// The line through points: its angle, and their mean squared distance from it.
struct Line {
    double angle, square;
    Line(Matrix<const double> points, Window of) {
        const double count = double(of.last - of.first + 1);
        double mx = 0.0, my = 0.0, xx = 0.0, xy = 0.0, yy = 0.0;
        for (int64_t j = of.first; j <= of.last; j++) mx += points(j, 0), my += points(j, 1);
        mx /= count, my /= count;
        for (int64_t j = of.first; j <= of.last; j++) {
            const double dx = points(j, 0) - mx, dy = points(j, 1) - my;
            xx += dx * dx, xy += dx * dy, yy += dy * dy;
        }
        xx /= count, xy /= count, yy /= count;
        const double half = 0.5 * (xx - yy);
        angle = 0.5 * std::atan2(2 * xy, xx - yy);
        square = 0.5 * (xx + yy) - std::sqrt(half * half + xy * xy);
    }
};

// Thin out the points of a scan, which follow each other, and find their normals; returns how many
// are left. Those at least `spacing` from the last one kept come to the front of `points`. To their
// neighbours on both sides that hang together within `least_reach`, or within `widening` of the
// range, a line is fitted; where they are further than `off` from it (RMS), as at a corner, to
// those within half as much, and half of that. `away` takes the points as seen from `centre`, the
// laser; `normals`, of zeros, takes what is found, turned to the laser.
inline int64_t surface_along(Matrix<double> points, Vector<const double> centre, double spacing,
                             double least_reach, double widening, double off, Matrix<double> away,
                             Matrix<double> normals) {
    require(points.shape[1] == 2 && away.shape[1] == 2 && normals.shape[1] == 2,
            "points, away and normals must have two columns");
    require(away.size() == points.size() && normals.size() == points.size(),
            "points, away and normals must be as many");
    require(centre.size() == 2, "centre must have two entries");
    int64_t count = 0;
    for (int64_t k = 0; k < points.size(); k++) {
        if (count && is_near(points[k], points[count - 1], spacing)) continue;
        for (int axis = 0; axis < 2; axis++) {
            points(count, axis) = points(k, axis);
            away(count, axis) = points(k, axis) - centre[axis];
        }
        count++;
    }
    for (int64_t k = 0; k < count; k++) {
        const double* to = away[k];
        double reach = std::max(least_reach, widening * std::sqrt(to[0] * to[0] + to[1] * to[1]));
        const double linked = 0.5 * reach;
        for (int n = 0; n < WINDOWS; n++, reach *= 0.5) {
            const Window window(away, count, k, reach, linked);
            if (window.first == k || window.last == k) break;
            const Line line(away, window);
            if (!(line.square <= off * off)) continue;
            const double nx = -std::sin(line.angle), ny = std::cos(line.angle);
            const double turn = nx * to[0] + ny * to[1] > 0 ? -1.0 : 1.0;
            normals(k, 0) = turn * nx, normals(k, 1) = turn * ny;
            break;
        }
    }
    return count;
}

static PyMethodDef methods[] = {
    FUNCTION(surface_along,
             "points, centre, spacing, least_reach, widening, off, away, normals"),
    {}};

}  // namespace scan_points
