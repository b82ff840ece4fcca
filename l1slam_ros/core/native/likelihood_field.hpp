// SPDX-License-Identifier: Apache-2.0
// A look-up of the nearest point of a map; see `l1slam_ros.core.scans.field`.
// Source: Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, section 6.4: likelihood fields.
#pragma once
#include <algorithm>
#include <cmath>

#include "arrays.hpp"

namespace likelihood_field {

// For each cell the point nearest to its centre: `nearest` and its squared distance `best` are
// changed where a point is nearer than `best`, of cells within `reach` along each axis.
inline void nearest_points(Matrix<const double> points, Vector<const double> origin,
                           double resolution, double reach, Matrix<int32_t> nearest,
                           Matrix<double> best) {
    require(points.shape[1] == 2, "points must have two columns");
    require(points.size() <= INT32_MAX, "points must be fewer than 2^31");
    require(origin.size() == 2, "origin must have two entries");
    require(resolution > 0 && reach >= 0 && reach / resolution < 1e6,
            "resolution must be positive, and reach less than a million cells");
    require(nearest.shape[0] == best.shape[0] && nearest.shape[1] == best.shape[1],
            "nearest and best must be of one shape");
    const int64_t columns = nearest.shape[0], rows = nearest.shape[1];
    const auto radius = int64_t(std::ceil(reach / resolution));
    for (int64_t k = 0; k < points.size(); k++) {
        const double px = points(k, 0), py = points(k, 1);
        const double u = (px - origin[0]) / resolution, v = (py - origin[1]) / resolution;
        // What is so far outside reaches no cell.
        if (!(std::abs(u) < 1e9 && std::abs(v) < 1e9)) continue;
        const int64_t column = int64_t(u), row = int64_t(v);
        const int64_t first = std::max<int64_t>(row - radius, 0);
        const auto count = int(std::min(row + radius + 1, rows) - first);
        const int64_t end = std::min(column + radius + 1, columns);
        const double left = origin[1] + (double(first) + 0.5) * resolution - py;
        for (int64_t a = std::max<int64_t>(column - radius, 0); a < end; a++) {
            const double dx = origin[0] + (double(a) + 0.5) * resolution - px;
            double* square = best[a] + first;
            int32_t* of = nearest[a] + first;
            for (int b = 0; b < count; b++) {
                const double dy = left + b * resolution, found = dx * dx + dy * dy;
                const bool nearer = found < square[b];
                square[b] = nearer ? found : square[b];
                of[b] = nearer ? int32_t(k) : of[b];
            }
        }
    }
}

static PyMethodDef methods[] = {
    FUNCTION(nearest_points, "points, origin, resolution, reach, nearest, best"),
    {}};

}  // namespace likelihood_field
