// SPDX-License-Identifier: Apache-2.0
// What the rays of a laser say of a grid's cells, and of another scan's points.
#pragma once
#include <algorithm>
#include <cmath>
#include <tuple>

#include "arrays.hpp"

namespace ray_casting {

constexpr double PI = 3.14159265358979323846;
// Further than this from the grid no ray begins or ends, in cells.
constexpr double FARTHEST = 1e7;

// Add rays to a grid of log odds: each cell is told once by each ray. `free` is taken from the
// cells that a ray passes, `occupied` added to the one it ends in where it `hits`; `most` bounds
// both.
// Source: Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing", 1987.
inline void cast_rays(Matrix<float> log_odds, Vector<const double> origin, double resolution,
                      Matrix<const double> starts, Matrix<const double> ends,
                      Vector<const bool> hits, double free, double occupied, double most) {
    require(origin.size() == 2, "origin must have two entries");
    require(resolution > 0, "resolution must be positive");
    require(starts.shape[1] == 2 && ends.shape[1] == 2, "starts and ends must have two columns");
    require(ends.size() == starts.size() && hits.size() == starts.size(),
            "starts, ends and hits must be as many");
    const auto less = float(free), more = float(occupied), bound = float(most);
    const int64_t columns = log_odds.shape[0], rows = log_odds.shape[1];
    for (int64_t k = 0; k < starts.size(); k++) {
        const double x = (starts(k, 0) - origin[0]) / resolution;
        const double y = (starts(k, 1) - origin[1]) / resolution;
        const double u = (ends(k, 0) - origin[0]) / resolution;
        const double v = (ends(k, 1) - origin[1]) / resolution;
        require(std::abs(x) < FARTHEST && std::abs(y) < FARTHEST && std::abs(u) < FARTHEST &&
                    std::abs(v) < FARTHEST,
                "starts and ends must be finite, and near the grid");
        const double dx = u - x, dy = v - y;
        auto column = int64_t(x), row = int64_t(y);
        const auto last_column = int64_t(u), last_row = int64_t(v);
        const int step_x = dx > 0 ? 1 : -1, step_y = dy > 0 ? 1 : -1;
        const double across_x = dx != 0 ? std::abs(1 / dx) : HUGE_VAL;
        const double across_y = dy != 0 ? std::abs(1 / dy) : HUGE_VAL;
        double next_x = dx != 0 ? (double(column + (step_x > 0)) - x) / dx : HUGE_VAL;
        double next_y = dy != 0 ? (double(row + (step_y > 0)) - y) / dy : HUGE_VAL;
        auto is_inside = [&] {
            return column >= 0 && column < columns && row >= 0 && row < rows;
        };
        const int64_t cells = std::abs(last_column - column) + std::abs(last_row - row);
        for (int64_t n = 0; n < cells; n++) {
            if (is_inside()) {
                float& cell = log_odds(column, row);
                cell = std::max(cell - less, -bound);
            }
            if (next_x < next_y) column += step_x, next_x += across_x;
            else row += step_y, next_y += across_y;
        }
        column = last_column, row = last_row;
        if (hits[k] && is_inside()) {
            float& cell = log_odds(column, row);
            cell = std::min(cell + more, bound);
        }
    }
}

// How many points the rays of some views agree with, and how many they pass through. A view, (b,),
// is the range seen in each of b equal bearings, NaN: none; a ray must pass a point by `off` to
// contradict it. A point that any view's ray passes through is contradicted, unless another view's
// ray ends there.
inline std::tuple<int64_t, int64_t> contradictions(Matrix<const double> points,
                                                   Matrix<const double> views,
                                                   Matrix<const double> poses, double off) {
    require(points.shape[1] == 2, "points must have two columns");
    require(poses.shape[1] == 3, "poses must have three columns");
    require(views.size() == poses.size(), "views must be as many as poses");
    require(views.shape[1] >= 1, "views must have bearings");
    const int64_t bins = views.shape[1];
    int64_t agree = 0, pass_through = 0;
    for (int64_t k = 0; k < points.size(); k++) {
        bool seen = false, through = false;
        for (int64_t v = 0; v < poses.size(); v++) {
            const double dx = points(k, 0) - poses(v, 0), dy = points(k, 1) - poses(v, 1);
            const double distance = std::sqrt(dx * dx + dy * dy);
            double bearing = (std::atan2(dy, dx) - poses(v, 2)) / (2 * PI);
            bearing -= std::floor(bearing);
            if (!(bearing >= 0)) continue;  // no number
            const int64_t at = int64_t(bearing * double(bins)) % bins;
            const double* view = views[v];
            const double range = view[at];
            const double tolerance = off + 0.03 * distance;
            if (std::abs(range - distance) <= tolerance) seen = true;
            else if (range > distance + tolerance) {
                // The neighbours must pass, too: at an edge the ray may miss by its width.
                const double left = view[at ? at - 1 : bins - 1];
                const double right = view[at + 1 < bins ? at + 1 : 0];
                through |= left > distance + tolerance && right > distance + tolerance;
            }
        }
        agree += seen;
        pass_through += through && !seen;
    }
    return {agree, pass_through};
}

static PyMethodDef methods[] = {
    FUNCTION(cast_rays,
             "log_odds, origin, resolution, starts, ends, hits, free, occupied, most"),
    FUNCTION(contradictions, "points, views, poses, off"),
    {}};

}  // namespace ray_casting
