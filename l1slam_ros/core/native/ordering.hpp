// SPDX-License-Identifier: Apache-2.0
// In which order to eliminate keyframes so that little fills in: approximate minimum degree, and
// separators found by levels.
#pragma once
#include <algorithm>
#include <limits>
#include <vector>

#include "symbolic.hpp"

namespace ordering {

using symbolic::Counts;
using symbolic::given;
using symbolic::Places;

// The quotient graph: what is left, and cliques (elements) that eliminations made.
class Elimination {
  public:
    Elimination(Vector<int32_t> start, Vector<int32_t> adjacent, int64_t limit,
                Vector<int32_t> stage, Vector<int32_t> order, Vector<int64_t> column,
                Vector<int32_t> rows)
        : n(int32_t(start.size() - 1)), limit(limit), stage(stage.data), order(n), column(n + 1),
          rows(), place(n, -1), absorbed(n), seen(n, -1), counted(n, -1), outside(n), after(n),
          before(n), variables(n), elements(n), degree(n), first(n + 1) {
        int64_t highest = n ? *std::max_element(stage.data, stage.data + n) : 0;
        head.assign(n * (1 + highest), -1);
        done = int32_t(order.size());
        for (int32_t step = 0; step < done; step++) {
            this->order[step] = order[step], this->column[step + 1] = column[step + 1];
            place[order[step]] = step;
        }
        this->rows.assign(rows.data, rows.data + this->column[done]);
        for (int32_t step = 0; step < done; step++)
            for (int64_t at = column[step]; at < column[step + 1]; at++)
                absorbed[order[step]] |= place[rows[at]] >= 0;
        quotient(start, adjacent);
    }

    std::tuple<Vector<int32_t>, Vector<int64_t>, Vector<int32_t>> run() {
        for (int32_t k = 0; k < n; k++)
            if (place[k] < 0) put(k);
        int64_t lowest = 0;
        int32_t step = done;
        for (; step < n; step++) {
            while (head[lowest] < 0) lowest++;
            int32_t pivot = head[lowest];
            take(pivot);
            order[step] = pivot, place[pivot] = step, seen[pivot] = pivot;
            if (!gather(pivot)) break;
            column[step + 1] = rows.size();
            int32_t size = int32_t(column[step + 1] - column[step]);
            count_outside(pivot, step);
            for (int64_t at = column[step]; at < column[step + 1]; at++) {
                int32_t k = rows[at];
                take(k);
                int32_t bound = reduce(k, pivot);
                degree[k] = std::min({n - step - 2, degree[k] + size - 1, bound + size - 1});
                lowest = std::min(lowest, put(k));
            }
        }
        order.resize(step), rows.resize(column[step]), column.resize(step + 1);
        return {given(order), given(column), given(rows)};
    }

  private:
    int32_t n, done;
    int64_t limit;
    const int32_t* stage;
    Places order;
    Counts column;
    Places rows, place;
    std::vector<char> absorbed;
    Places seen, counted, outside, head, after, before, variables, elements, degree, first, lists;

    // Where the lists of each node that is left begin, the lists, and its degree.
    void quotient(Vector<int32_t> start, Vector<int32_t> adjacent) {
        for (int32_t k = 0; k < n; k++) {
            for (int32_t at = start[k]; at < start[k + 1]; at++)
                variables[k] += place[adjacent[at]] < 0;
            degree[k] = variables[k];
        }
        auto each_clique = [&](auto visit) {
            for (int32_t step = 0; step < done; step++)
                if (!absorbed[order[step]])
                    for (int64_t at = column[step]; at < column[step + 1]; at++)
                        visit(step, rows[at]);
        };
        each_clique([&](int32_t step, int32_t k) {
            elements[k]++;
            degree[k] = int32_t(std::min<int64_t>(
                degree[k] + column[step + 1] - column[step] - 1, n - done - 1));
        });
        for (int32_t k = 0; k < n; k++) first[k + 1] = first[k] + variables[k] + elements[k];
        lists.resize(first[n]);
        Places end(first.begin(), first.end() - 1);
        for (int32_t k = 0; k < n; k++)
            for (int32_t at = start[k]; at < start[k + 1]; at++)
                if (place[adjacent[at]] < 0) lists[end[k]++] = adjacent[at];
        each_clique([&](int32_t step, int32_t k) { lists[end[k]++] = order[step]; });
    }

    int64_t put(int32_t k) {
        int64_t at = int64_t(stage[k]) * n + degree[k];
        after[k] = head[at], before[k] = -1;
        if (head[at] >= 0) before[head[at]] = k;
        head[at] = k;
        return at;
    }

    void take(int32_t k) {
        if (before[k] >= 0) after[before[k]] = after[k];
        else head[int64_t(stage[k]) * n + degree[k]] = after[k];
        if (after[k] >= 0) before[after[k]] = before[k];
    }

    // Write the pivot's neighbours; its elements are absorbed.
    bool gather(int32_t pivot) {
        auto add = [&](int32_t k) {
            if (place[k] < 0 && seen[k] != pivot) seen[k] = pivot, rows.push_back(k);
        };
        const int32_t *own = &lists[first[pivot]], *element = own + variables[pivot];
        for (; own < element; own++) add(*own);
        for (const int32_t* end = element + elements[pivot]; element < end; element++) {
            int32_t e = *element;
            if (absorbed[e]) continue;
            absorbed[e] = true;
            for (int64_t at = column[place[e]]; at < column[place[e] + 1]; at++) add(rows[at]);
        }
        return int64_t(rows.size()) <= limit;
    }

    // Count, for every element that touches the clique, its members outside of it.
    void count_outside(int32_t pivot, int32_t step) {
        for (int64_t at = column[step]; at < column[step + 1]; at++) {
            const int32_t* e = &lists[first[rows[at]] + variables[rows[at]]];
            for (const int32_t* end = e + elements[rows[at]]; e < end; e++) {
                if (absorbed[*e]) continue;
                if (counted[*e] != pivot) {
                    counted[*e] = pivot;
                    outside[*e] = int32_t(column[place[*e] + 1] - column[place[*e]]);
                }
                outside[*e]--;
            }
        }
    }

    // Drop from k's lists what the new element covers, add it, and bound k's other neighbours.
    int32_t reduce(int32_t k, int32_t pivot) {
        int32_t *from = &lists[first[k]], *write = from, bound = 0;
        const int32_t *middle = from + variables[k], *end = middle + elements[k];
        for (; from < middle; from++)
            if (place[*from] < 0 && seen[*from] != pivot) *write++ = *from, bound++;
        variables[k] = int32_t(write - &lists[first[k]]);
        for (; from < end; from++) {
            if (absorbed[*from]) continue;
            if (outside[*from] == 0) { absorbed[*from] = true; continue; }
            bound += outside[*from];
            *write++ = *from;
        }
        *write++ = pivot;
        elements[k] = int32_t(write - &lists[first[k]]) - variables[k];
        return bound;
    }
};

inline std::tuple<Vector<int32_t>, Vector<int64_t>, Vector<int32_t>> minimum_degree(
    Vector<int32_t> start, Vector<int32_t> adjacent, int64_t limit, Vector<int32_t> stage,
    Vector<int32_t> order, Vector<int64_t> column, Vector<int32_t> rows) {
    return Elimination(start, adjacent, limit, stage, order, column, rows).run();
}

// Separators found by levels from a node at the edge, in halves of halves.
class Levels {
    // Parts of no more nodes are not halved; a half has this part of the nodes at least.
    static constexpr int WHOLE = 120, SEARCHES = 4;
    static constexpr double LEAST = 0.2;

  public:
    Levels(Vector<int32_t> start, Vector<int32_t> adjacent)
        : start(start.data), adjacent(adjacent.data), n(int32_t(start.size() - 1)), part(n),
          level(n), queue(n) {}

    Vector<int32_t> run() {
        struct Part { int32_t begin, end, depth; };
        Places cut(n), nodes(n);
        for (int32_t k = 0; k < n; k++) nodes[k] = k;
        std::vector<Part> parts{{0, n, 0}};
        int32_t deepest = 0;
        while (!parts.empty()) {
            auto [low, high, depth] = parts.back();
            parts.pop_back();
            int32_t below = depth + 1, size = high - low, *own = &nodes[low];
            if (size <= WHOLE) continue;
            number++;
            int32_t reached = edge(own, size), middle = n;
            if (reached == size) {
                middle = best_level(reached);
                if (middle < 0) continue;
                for (int32_t k = 0; k < size; k++)
                    if (level[own[k]] == middle && touches(own[k])) cut[own[k]] = below;
                deepest = std::max(deepest, below);
            }
            int32_t at = 0;
            for (bool behind : {false, true}) {
                int32_t begin = low + at;
                for (int32_t k = 0; k < size; k++)
                    if (!cut[own[k]] && (level[own[k]] > middle) == behind) queue[at++] = own[k];
                parts.push_back({begin, low + at, below});
            }
            std::copy_n(queue.begin(), at, own);
        }
        for (auto& depth : cut) depth = depth ? deepest + 1 - depth : 0;
        return given(cut);
    }

  private:
    const int32_t *start, *adjacent;
    int32_t n, number = 0;
    Places part, level, queue;

    int32_t edge(const int32_t* own, int32_t size) {
        int32_t reached = levels(own[0], own, size);
        for (int search = 0; search < SEARCHES; search++) {
            int32_t farthest = queue[reached - 1], before = level[farthest];
            levels(farthest, own, size);
            if (level[queue[reached - 1]] <= before) break;
        }
        return reached;
    }

    int32_t levels(int32_t root, const int32_t* own, int32_t size) {
        int32_t far = n + 1, at = 0, end = 1;
        for (int32_t k = 0; k < size; k++) part[own[k]] = number, level[own[k]] = far;
        level[root] = 0, queue[0] = root;
        while (at < end) {
            int32_t k = queue[at++];
            for (int32_t e = start[k]; e < start[k + 1]; e++) {
                int32_t v = adjacent[e];
                if (part[v] == number && level[v] == far)
                    level[v] = level[k] + 1, queue[end++] = v;
            }
        }
        return end;
    }

    int32_t best_level(int32_t size) {
        int32_t best = -1, at = 0;
        double least = std::numeric_limits<double>::infinity();
        while (at < size) {
            int32_t own = level[queue[at]], touching = 0;
            for (; at < size && level[queue[at]] == own; at++) touching += touches(queue[at]);
            int32_t before = at - touching, behind = size - at;
            double uneven = double(before - behind) / size;
            double costs = touching * (1 + uneven * uneven);
            if (std::min(before, behind) >= LEAST * size && costs < least)
                best = own, least = costs;
        }
        return best;
    }

    bool touches(int32_t k) const {
        for (int32_t e = start[k]; e < start[k + 1]; e++)
            if (part[adjacent[e]] == number && level[adjacent[e]] == level[k] + 1) return true;
        return false;
    }
};

inline Vector<int32_t> dissect(Vector<int32_t> start, Vector<int32_t> adjacent) {
    return Levels(start, adjacent).run();
}

static PyMethodDef methods[] = {
    FUNCTION(minimum_degree, "start, adjacent, limit, stage, order, column, rows"),
    FUNCTION(dissect, "start, adjacent"),
    {}};

}  // namespace ordering
