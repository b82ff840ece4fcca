// SPDX-License-Identifier: Apache-2.0
// Search for a scan in a likelihood grid by shifts and turns; see `l1slam_ros.core.scans.search`.
// Source: Hess, Kohler, Rapp, Andor, "Real-time loop closure in 2D LIDAR SLAM", 2016, Algorithm 3.
//
// The scan's points are cells of the grid for each turn, at the lowest shift; a shift is so many
// cells from there. Scores are sums of likelihoods over the points.
#pragma once
#include <algorithm>
#include <cmath>
#include <memory>
#include <tuple>
#include <vector>

#include "arrays.hpp"

namespace branch_and_bound {

// The widest bounds are over so many shifts each way, a power of two: wider ones are sooner added
// up, and so loose that ten times as many squares must be looked into.
constexpr int64_t WIDTH = 8;
// A search has at most so many squares each way; most have no more than `FEW`.
constexpr int64_t ACROSS = 32, FEW = 16;

struct Cell {
    int32_t u, v;
};
// The square of shifts from column, row on, 2^level each way, at a turn, and its bound.
struct Node {
    int32_t turn, column, row, bound, level;
};

struct Search {
    Array<const uint8_t, 3> levels;
    Array<const uint8_t, 4> blocks;
    int64_t turns, count, across;  // of turns, of points, of squares each way
    std::unique_ptr<Cell[]> cells;
    std::unique_ptr<uint16_t[]> bounds;

    // Cells of the points for each turn; `start` is where the scan's (0, 0) lies, in cells.
    void place(Matrix<const double> points, Matrix<const double> rotations,
               Vector<const double> start) {
        cells.reset(new Cell[turns * count]);
        auto whole = [](double x) {
            return int32_t(std::floor(x > -1e9 ? std::min(x, 1e9) : -1e9));
        };
        for (int64_t t = 0; t < turns; t++) {
            const double c = rotations(t, 0), s = rotations(t, 1);
            for (int64_t k = 0; k < count; k++) {
                const double x = points(k, 0), y = points(k, 1);
                cells[t * count + k] = {whole(c * x - s * y + start[0]),
                                        whole(s * x + c * y + start[1])};
            }
        }
    }

    // Bounds of the scores of all shifts, by squares: of each turn and W squares each way. Of more
    // than `across` nobody asks, but so many are added in one step of the processor.
    template <int64_t W> void add_widest_bounds() {
        const int64_t columns = blocks.shape[2], rows = blocks.shape[3];
        bounds.reset(new uint16_t[turns * across * W]());
        for (int64_t t = 0; t < turns; t++) {
            uint16_t* sums = bounds.get() + t * across * W;
            for (int64_t k = 0; k < count; k++) {
                const Cell cell = cells[t * count + k];
                // Quotients rounded down, as shifts of what is negative are.
                const int64_t first = cell.u >> 3, left = (cell.v >> 3) + ACROSS;
                const int64_t end = std::min(across, columns - first);
                int64_t a = std::max<int64_t>(-first, 0);
                if (a >= end) continue;
                const int64_t plane = (cell.u & 7) * WIDTH + (cell.v & 7);
                const uint8_t* line = blocks.data + (plane * columns + first + a) * rows +
                                      std::clamp<int64_t>(left, 0, rows - ACROSS);
                for (; a < end; a++, line += rows)
                    for (int64_t b = 0; b < W; b++)
                        sums[a * W + b] = uint16_t(sums[a * W + b] + line[b]);
            }
        }
    }

    // The squares whose bounds are above `least`, the best first; of equal ones, the first.
    template <int64_t W> std::vector<Node> sorted(double least) const {
        const int top = int(levels.shape[0]) - 1;
        std::vector<int32_t> place(255 * size_t(count) + 2, 0);
        auto each = [&](auto&& visit) {
            for (int64_t line = 0; line < turns * across; line++)
                for (int64_t b = 0; b < across; b++) {
                    const uint16_t bound = bounds[line * W + b];
                    if (bound > least) visit(line, b, bound);
                }
        };
        each([&](int64_t, int64_t, uint16_t bound) { place[bound]++; });
        int32_t total = 0;
        for (size_t bound = place.size(); bound-- > 0;) {
            const int32_t those = place[bound];
            place[bound] = total;
            total += those;
        }
        std::vector<Node> nodes(size_t(total), Node{});
        each([&](int64_t line, int64_t b, uint16_t bound) {
            nodes[size_t(place[bound]++)] = {int32_t(line / across),
                                             int32_t(WIDTH * (line % across)),
                                             int32_t(WIDTH * b), bound, top};
        });
        return nodes;
    }

    // Put the quarters of a node on the stack from `stack` on, the best on top; return its end.
    Node* branch(Node node, int64_t most, int64_t best, Node* stack) const {
        const int level = node.level - 1, half = 1 << level;
        const auto rows = size_t(levels.shape[2]);
        const auto last_column = uint32_t(levels.shape[1] - 1), last_row = uint32_t(rows - 1);
        const uint8_t* grid = levels[level];
        const Cell* own = cells.get() + node.turn * count;
        int32_t sums[4] = {0, 0, 0, 0};
        for (int64_t k = 0; k < count; k++) {
            // Beyond the edge there is nothing, as on it; unsigned, what is negative is beyond.
            const auto u = uint32_t(own[k].u + node.column), v = uint32_t(own[k].v + node.row);
            const uint8_t* near = grid + std::min(u, last_column) * rows;
            const uint8_t* far = grid + std::min(u + uint32_t(half), last_column) * rows;
            const uint32_t low = std::min(v, last_row);
            const uint32_t high = std::min(v + uint32_t(half), last_row);
            sums[0] += near[low], sums[1] += near[high];
            sums[2] += far[low], sums[3] += far[high];
        }
        Node* end = stack;
        for (int q = 0; q < 4; q++) {
            const int32_t u = node.column + half * (q >> 1), v = node.row + half * (q & 1);
            if (sums[q] <= best || u > most || v > most) continue;
            Node* place = end++;
            for (; place > stack && place[-1].bound > sums[q]; place--) *place = place[-1];
            *place = {node.turn, u, v, sums[q], level};
        }
        return end;
    }

    // The best shift above `least` that counts; turn -1: there is none.
    template <class Counts>
    Node best_of(const std::vector<Node>& nodes, int64_t most, int64_t least,
                 Counts&& counts) const {
        std::vector<Node> stack(4 * size_t(levels.shape[0]));
        Node found{-1, 0, 0, 0, 0};
        int64_t best = least;
        for (const Node& node : nodes) {
            if (node.bound <= best) break;
            stack[0] = node;
            Node* end = stack.data() + 1;
            while (end != stack.data()) {
                const Node next = *--end;
                if (next.bound <= best) continue;
                if (next.level > 0) end = branch(next, most, best, end);
                else if (counts(next)) found = next, best = next.bound;
            }
        }
        return found;
    }
};

// Where the points fit best, and how well at the best other place: score, turn, column, row, and
// the other's score. Turn -1: nowhere above `least`; the other's score is 0 where it is not above
// `rival` of the best. Scores are of 255 for each point.
inline std::tuple<int64_t, int64_t, int64_t, int64_t, int64_t> search(
    Array<const uint8_t, 3> levels, Array<const uint8_t, 4> blocks, Matrix<const double> points,
    Matrix<const double> rotations, Vector<const double> start, int64_t most, double least,
    double rival, Vector<const double> same) {
    require(levels.shape[0] >= 1 && levels.shape[0] <= 16 && levels.shape[1] >= 1 &&
                levels.shape[2] >= 1,
            "levels must have cells");
    require(blocks.shape[0] == WIDTH && blocks.shape[1] == WIDTH && blocks.shape[2] >= 1 &&
                blocks.shape[3] >= 2 * ACROSS,
            "blocks must be (8, 8, c, r) with c of 1 and r of 64 at least");
    require(points.shape[1] == 2 && points.size() <= 257, "points must be (n, 2), n at most 257");
    require(rotations.shape[1] == 2 && rotations.size() < (1 << 20),
            "rotations must be (t, 2), t less than 2^20");
    require(start.size() == 2, "start must have two entries");
    require(same.size() == 3, "same must have three entries");
    require(most >= 0 && most / WIDTH < ACROSS, "most must be from 0 to 255");
    require(least >= 0 && least < 1e9 && rival >= 0 && rival < 1e9,
            "least and rival must be from 0 to 10^9");
    Search of{levels, blocks, rotations.size(), points.size(), most / WIDTH + 1, {}, {}};
    of.place(points, rotations, start);
    std::vector<Node> nodes;
    if (of.across <= FEW) of.add_widest_bounds<FEW>(), nodes = of.sorted<FEW>(rival * least);
    else of.add_widest_bounds<ACROSS>(), nodes = of.sorted<ACROSS>(rival * least);
    const Node best =
        of.best_of(nodes, most, int64_t(least), [](const Node&) { return true; });
    if (best.turn < 0) return {0, -1, 0, 0, 0};
    const Node other = of.best_of(nodes, most, int64_t(rival * best.bound), [&](const Node& node) {
        const double turned = std::abs(node.turn - best.turn);
        return std::min(turned, same[2] - turned) > same[0] ||
               std::abs(node.column - best.column) > same[1] ||
               std::abs(node.row - best.row) > same[1];
    });
    return {best.bound, best.turn, best.column, best.row, other.turn < 0 ? 0 : other.bound};
}

static PyMethodDef methods[] = {
    FUNCTION(search, "levels, blocks, points, rotations, start, most, least, rival, same"),
    {}};

}  // namespace branch_and_bound
