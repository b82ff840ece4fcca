// SPDX-License-Identifier: Apache-2.0
// Clouds of points as one cloud, of each cell one point; see `l1slam_ros.core.scans.submaps`.
#pragma once
#include <cmath>
#include <tuple>
#include <vector>

#include "arrays.hpp"

namespace voxel_grid {

// The keys seen so far, by open addressing.
class Keys {
    std::vector<uint64_t> table;
    size_t mask;
    static constexpr uint64_t NONE = ~uint64_t(0);

  public:
    explicit Keys(int64_t most) {
        size_t size = 16;
        while (size < 2 * size_t(most)) size *= 2;
        table.assign(size, NONE);
        mask = size - 1;
    }
    // Whether it is new; from then on it is not.
    bool add(uint64_t key) {
        size_t at = size_t((key * 0x9E3779B97F4A7C15u) >> 20) & mask;
        for (; table[at] != NONE; at = (at + 1) & mask)
            if (table[at] == key) return false;
        table[at] = key;
        return true;
    }
};

// Number of the cell that a coordinate is in, from 0 to 2^31; no map is so wide.
inline uint64_t cell_of(double x, double width) {
    const double cell = std::floor(x / width);
    return std::abs(cell) < 0x3fffffff ? uint64_t(int64_t(cell) + 0x40000000) : 0;
}

// The points with normals of clouds, `counts` of them each, seen from the frame that `poses` are
// in: of each cell and each of four sides of a surface there the first.
inline std::tuple<Matrix<double>, Matrix<double>> merge(
    Matrix<const double> points, Matrix<const double> normals, Vector<const int64_t> counts,
    Matrix<const double> poses, double width) {
    require(points.shape[1] == 2 && normals.shape[1] == 2,
            "points and normals must have two columns");
    require(normals.size() == points.size(), "normals must be as many as points");
    require(poses.shape[1] == 3, "poses must have three columns");
    require(poses.size() == counts.size(), "poses must be as many as counts");
    require(width > 0, "width must be positive");
    int64_t left = points.size();
    for (int64_t c = 0; c < counts.size(); c++) {
        require(counts[c] >= 0 && counts[c] <= left, "counts must add up to that of points");
        left -= counts[c];
    }
    require(left == 0, "counts must add up to that of points");
    struct Oriented {
        double x, y, nx, ny;
    };
    std::vector<Oriented> kept;
    kept.reserve(size_t(points.size()));
    Keys keys(points.size());
    for (int64_t cloud = 0, k = 0; cloud < counts.size(); cloud++) {
        const double *pose = poses[cloud], c = std::cos(pose[2]), s = std::sin(pose[2]);
        for (const int64_t end = k + counts[cloud]; k < end; k++) {
            const double px = points(k, 0), py = points(k, 1);
            const double ux = normals(k, 0), uy = normals(k, 1);
            if (ux == 0 && uy == 0) continue;
            const Oriented to{c * px - s * py + pose[0], s * px + c * py + pose[1],
                              c * ux - s * uy, s * ux + c * uy};
            const bool is_along_x = std::abs(to.nx) >= std::abs(to.ny);
            const uint64_t side = is_along_x ? (to.nx > 0 ? 0 : 2) : (to.ny > 0 ? 1 : 3);
            const uint64_t column = cell_of(to.x, width), row = cell_of(to.y, width);
            if (keys.add((column << 33 | row << 2) | side)) kept.push_back(to);
        }
    }
    const auto count = int64_t(kept.size());
    auto xy = new_array<double, 2>({count, 2}), normal = new_array<double, 2>({count, 2});
    for (int64_t k = 0; k < count; k++) {
        const Oriented& from = kept[size_t(k)];
        xy(k, 0) = from.x, xy(k, 1) = from.y;
        normal(k, 0) = from.nx, normal(k, 1) = from.ny;
    }
    return {xy, normal};
}

static PyMethodDef methods[] = {
    FUNCTION(merge, "points, normals, counts, poses, width"),
    {}};

}  // namespace voxel_grid
