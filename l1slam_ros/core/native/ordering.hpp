// SPDX-License-Identifier: Apache-2.0
// In which order to eliminate keyframes so that little fills in: approximate minimum degree, and
// separators found by levels.
#pragma once
#include <algorithm>
#include <limits>
#include <tuple>
#include <utility>
#include <vector>

#include "symbolic.hpp"

namespace ordering {

using symbolic::Counts;
using symbolic::given;
using symbolic::Graph;
using symbolic::Places;

// An order of all nodes, and the multiplications of blocks that a factorisation takes.
using Order = std::tuple<Vector<int32_t>, double>;

// Approximate minimum degree. Source: Amestoy, Davis, Duff, "An approximate minimum degree
// ordering algorithm" (1996).
//
// What is left of the graph after some eliminations is kept as a quotient graph: each node still
// there has neighbours (variables) and cliques that eliminations made (elements, named by the node
// eliminated). Nodes that have the same of both are one from then on (a supervariable, named by
// one of them), of a weight that counts them: nothing tells them apart any more. Its degree, the
// weight of its neighbours, is bounded from above without merging the cliques.
class Elimination {
  public:
    // stage : nodes of a higher one come later, whatever their degree
    Elimination(const Graph& graph, const int32_t* stage)
        : graph(graph), stage(stage), n(graph.n), weight(n, 1), variables(n), elements(n),
          degree(n), first(n + 1), after(n), before(n), head(n + 1, -1), bucket(n + 1, -1),
          same(n), chained(n, -1), last(n), seen(n, -1), cliques(n) {
        order.reserve(n);
        for (int32_t k = 0; k < n; k++) last[k] = k;
    }

    // Eliminate a node of which all is known: its column is not needed any more, or makes a
    // clique.
    void begin_with(int32_t k) { weight[k] = 0, order.push_back(k); }
    // The nodes, none of them eliminated, that an eliminated one joins.
    void begin_with(int32_t k, const Places& clique) {
        cliques[k] = {int64_t(members.size()), int32_t(clique.size()), int32_t(clique.size())};
        members.insert(members.end(), clique.begin(), clique.end());
        begun.push_back(k);
    }

    Order run() {
        quotient();
        Places by_stage;
        for (int32_t k = 0; k < n; k++)
            if (weight[k]) by_stage.push_back(k);
        left = int32_t(by_stage.size());
        std::stable_sort(by_stage.begin(), by_stage.end(),
                         [this](int32_t a, int32_t b) { return stage[a] < stage[b]; });
        for (size_t at = 0; at < by_stage.size();) {
            now = stage[by_stage[at]];
            for (; at < by_stage.size() && stage[by_stage[at]] == now; at++)
                if (weight[by_stage[at]]) put(by_stage[at]);
            while (listed) eliminate(lowest_node());
        }
        return {given(order), work};
    }

  private:
    struct Clique {
        int64_t begin;
        int32_t count, weight;  // its members, and their weight; count is -1 once it is absorbed
        int32_t counted = -1, outside = 0;
    };
    const Graph& graph;
    const int32_t* stage;
    const int32_t n;
    // 0: eliminated, or one with another node; negative: in the clique of the pivot.
    Places weight;
    // The lists of each node begin at first: variables, and the elements behind them.
    Places variables, elements, degree, first, lists;
    // Nodes of this stage by degree, and those of the clique by the hash of their lists.
    Places after, before, head, bucket, same;
    Places chained, last;  // the next node that is one with it, and the last of these
    Places seen;
    std::vector<Clique> cliques;
    Places members, begun, order;
    int32_t left = 0, listed = 0, lowest = 0, now = 0, stamp = 0;
    double work = 0.0;

    void quotient() {
        auto each = [&](auto visit) {
            for (int32_t k = 0; k < n; k++)
                if (weight[k])
                    for (int32_t v : graph.of(k))
                        if (weight[v] && v != k) visit(k, v);
        };
        auto each_clique = [&](auto visit) {
            for (int32_t e : begun)
                for (int32_t m = 0; m < cliques[e].count; m++)
                    visit(members[cliques[e].begin + m], e);
        };
        each([&](int32_t k, int32_t) { degree[k] = ++variables[k]; });
        each_clique([&](int32_t k, int32_t e) {
            elements[k]++;
            degree[k] = std::min(degree[k] + cliques[e].weight - 1, n - 1);
        });
        for (int32_t k = 0; k < n; k++) first[k + 1] = first[k] + variables[k] + elements[k];
        lists.resize(first[n]);
        Places end(first.begin(), first.end() - 1);
        each([&](int32_t k, int32_t v) { lists[end[k]++] = v; });
        each_clique([&](int32_t k, int32_t e) { lists[end[k]++] = e; });
    }

    void put(int32_t k) {
        const int32_t at = degree[k];
        after[k] = head[at], before[k] = -1;
        if (head[at] >= 0) before[head[at]] = k;
        head[at] = k;
        lowest = std::min(lowest, at);
        listed++;
    }

    void take(int32_t k) {
        if (stage[k] != now) return;
        if (before[k] >= 0) after[before[k]] = after[k];
        else head[degree[k]] = after[k];
        if (after[k] >= 0) before[after[k]] = before[k];
        listed--;
    }

    int32_t lowest_node() {
        while (head[lowest] < 0) lowest++;
        return head[lowest];
    }

    void eliminate(int32_t pivot) {
        take(pivot);
        int32_t own = std::exchange(weight[pivot], 0);
        int32_t around = gather(pivot);
        count_outside(pivot);
        const int64_t begin = cliques[pivot].begin;
        const int64_t end = int64_t(members.size());
        left -= own;
        for (int64_t at = begin; at < end; at++) {
            const int32_t k = members[at], size = -weight[k];
            int64_t hash;
            const int32_t outside = reduce(k, pivot, hash);
            if (!outside) {
                // It has no neighbour but the pivot's. Next to it nothing fills in, also if it
                // was to come later.
                join(pivot, k);
                own += size, around -= size, left -= size, weight[k] = 0;
                continue;
            }
            degree[k] = std::min(degree[k], outside);
            const int32_t b = int32_t(hash % n);
            same[k] = bucket[b], bucket[b] = k;
            hashes.push_back(b);
        }
        for (int32_t b : hashes) find_same(b);
        hashes.clear();
        int64_t write = begin;
        for (int64_t at = begin; at < end; at++) {
            const int32_t k = members[at];
            if (!weight[k]) continue;
            members[write++] = k;
            weight[k] = -weight[k];
            // Less itself. What is left bounds it as well.
            degree[k] = std::min(degree[k] + around, left) - weight[k];
            if (stage[k] == now) put(k);
        }
        members.resize(write);
        cliques[pivot].count = int32_t(write - begin), cliques[pivot].weight = around;
        for (int32_t k = pivot; k >= 0; k = chained[k]) order.push_back(k);
        for (int32_t rows = around + own; rows > around; rows--)
            work += double(rows) * double(rows) / 2;
    }

    // Write the pivot's neighbours as its clique, their weights negative; return the weight of
    // all. Its elements are absorbed.
    int32_t gather(int32_t pivot) {
        int32_t around = 0;
        cliques[pivot].begin = int64_t(members.size());
        auto add = [&](int32_t k) {
            if (weight[k] <= 0) return;
            around += weight[k];
            weight[k] = -weight[k];
            take(k);
            members.push_back(k);
        };
        const int32_t *own = lists.data() + first[pivot], *element = own + variables[pivot];
        for (; own < element; own++) add(*own);
        for (const int32_t* end = element + elements[pivot]; element < end; element++) {
            Clique& clique = cliques[*element];
            for (int32_t m = 0; m < clique.count; m++) add(members[clique.begin + m]);
            clique.count = -1;
        }
        return around;
    }

    // Weigh, for every element that touches the pivot's clique, its members outside of it.
    void count_outside(int32_t pivot) {
        for (int64_t at = cliques[pivot].begin; at < int64_t(members.size()); at++) {
            const int32_t k = members[at];
            const int32_t* e = lists.data() + first[k] + variables[k];
            for (const int32_t* end = e + elements[k]; e < end; e++) {
                Clique& clique = cliques[*e];
                if (clique.count < 0) continue;
                if (clique.counted != pivot)
                    clique.counted = pivot, clique.outside = clique.weight;
                clique.outside += weight[k];
            }
        }
    }

    // Drop from k's lists what the pivot's clique covers and add that; return the weight of, at
    // most, all other neighbours.
    int32_t reduce(int32_t k, int32_t pivot, int64_t& hash) {
        int32_t* const own = lists.data() + first[k];
        int32_t *from = own, *write = own;
        const int32_t *middle = own + variables[k], *end = middle + elements[k];
        int64_t bound = 0;
        hash = pivot;
        for (; from < middle; from++)
            if (weight[*from] > 0) bound += weight[*from], hash += *from, *write++ = *from;
        variables[k] = int32_t(write - own);
        for (; from < end; from++) {
            Clique& clique = cliques[*from];
            if (clique.count < 0) continue;
            if (!clique.outside) {
                clique.count = -1;
                continue;
            }
            bound += clique.outside, hash += *from, *write++ = *from;
        }
        *write++ = pivot;
        elements[k] = int32_t(write - own) - variables[k];
        return int32_t(std::min<int64_t>(bound, n));
    }

    // Make one of those nodes of a bucket that have the same lists.
    void find_same(int32_t b) {
        for (int32_t k = std::exchange(bucket[b], -1); k >= 0; k = same[k]) {
            if (same[k] < 0) return;
            const int32_t *own = lists.data() + first[k], length = variables[k] + elements[k];
            stamp++;
            for (int32_t at = 0; at < length; at++) seen[own[at]] = stamp;
            for (int32_t previous = k, other = same[k]; other >= 0; other = same[other]) {
                const int32_t* its = lists.data() + first[other];
                bool alike = stage[other] == stage[k] && variables[other] == variables[k] &&
                             elements[other] == elements[k];
                for (int32_t at = 0; alike && at < length; at++) alike = seen[its[at]] == stamp;
                if (!alike) {
                    previous = other;
                    continue;
                }
                degree[k] = std::min(degree[k], degree[other]);
                weight[k] += std::exchange(weight[other], 0);
                join(k, other);
                same[previous] = same[other];
            }
        }
    }

    void join(int32_t k, int32_t other) { chained[last[k]] = other, last[k] = last[other]; }
    Places hashes;
};

inline Order minimum_degree(Vector<const int32_t> start, Vector<const int32_t> adjacent,
                            Vector<const int32_t> stage) {
    const Graph graph(start, adjacent);
    require(stage.size() == graph.n, "stage must have an entry for each node");
    return Elimination(graph, stage.data).run();
}

// The order of a graph that has grown: of the panels of a factor, found when there were fewer
// nodes or neighbours, those stay that have all neighbours of their nodes, if all below them in
// the tree do. What is above comes anew.
inline Vector<int32_t> resume(Vector<const int32_t> start, Vector<const int32_t> adjacent,
                              Vector<const int32_t> position, Vector<const int32_t> first,
                              Vector<const int64_t> begin, Vector<const int32_t> rows) {
    const Graph graph(start, adjacent);
    const symbolic::Panels panels(position, first, begin, rows);
    const int32_t before = int32_t(position.size());
    require(before <= graph.n, "position must have no more entries than there are nodes");
    const Places owner = symbolic::owners(first.data, panels.count);
    Places node(before), seen(before, -1), clique;
    std::vector<char> touched(panels.count);
    for (int32_t v = 0; v < before; v++) node[position[v]] = v;
    const Places stage(graph.n);
    Elimination elimination(graph, stage.data());
    auto above = [&](int64_t s) {
        const int64_t below = begin[s] + first[s + 1] - first[s];
        return below < begin[s + 1] ? owner[rows[below]] : -1;
    };
    for (int64_t s = 0; s < panels.count; s++) {
        for (int64_t at = begin[s]; at < begin[s + 1]; at++) {
            require(rows[at] >= first[s] && rows[at] < before, "rows must be positions below");
            seen[rows[at]] = int32_t(s);
        }
        for (int32_t k = first[s]; k < first[s + 1]; k++)
            for (int32_t v : graph.of(node[k])) {
                if (v >= before) touched[s] = true;
                else if (position[v] > k && seen[position[v]] != s)
                    touched[s] = touched[owner[position[v]]] = true;
            }
        if (touched[s] && above(s) >= 0) touched[above(s)] = true;
    }
    for (int64_t s = 0; s < panels.count; s++) {
        if (touched[s]) continue;
        for (int32_t k = first[s]; k < first[s + 1]; k++) elimination.begin_with(node[k]);
        if (above(s) < 0 || !touched[above(s)]) continue;
        clique.clear();
        for (int64_t at = begin[s] + first[s + 1] - first[s]; at < begin[s + 1]; at++)
            clique.push_back(node[rows[at]]);
        elimination.begin_with(node[first[s]], clique);
    }
    return std::get<0>(elimination.run());
}

// Separators found by levels from a node at the edge, in halves of halves.
//
// Nodes are put in levels by how many factors they are from one at the edge; those of one level
// that touch the next separate what is before from what is behind. Graphs that are alike
// everywhere (a sphere) fill in less where these come last. Source: George and Liu, "Computer
// Solution of Large Sparse Positive Definite Systems" (1981), chapter 8.
class Levels {
    // Parts of no more nodes are not halved: from 30 to 300, a sphere and a torus fill in alike. A
    // half has this part of the nodes at least. Searches for a node at the edge.
    static constexpr int WHOLE = 120, SEARCHES = 4;
    static constexpr double LEAST = 0.2;

  public:
    explicit Levels(const Graph& graph)
        : graph(graph), n(graph.n), part(n), level(n), queue(n) {}

    Vector<int32_t> run() {
        struct Part { int32_t begin, end, depth; };
        Places cut(n), nodes(n);
        for (int32_t k = 0; k < n; k++) nodes[k] = k;
        std::vector<Part> parts{{0, n, 0}};
        int32_t deepest = 0;
        while (!parts.empty()) {
            const auto [low, high, depth] = parts.back();
            parts.pop_back();
            const int32_t below = depth + 1, size = high - low;
            int32_t* own = nodes.data() + low;
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
                const int32_t begin = low + at;
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
    const Graph& graph;
    const int32_t n;
    int32_t number = 0;
    Places part, level, queue;

    // Put nodes in levels from one at the edge of the part; return how many are tied to it.
    int32_t edge(const int32_t* own, int32_t size) {
        const int32_t reached = levels(own[0], own, size);
        for (int search = 0; search < SEARCHES; search++) {
            const int32_t farthest = queue[reached - 1], before = level[farthest];
            levels(farthest, own, size);
            if (level[queue[reached - 1]] <= before) break;
        }
        return reached;
    }

    // Write the part and level of own nodes, and those tied to the root to the queue, in order.
    int32_t levels(int32_t root, const int32_t* own, int32_t size) {
        const int32_t far = n + 1;
        int32_t at = 0, end = 1;
        for (int32_t k = 0; k < size; k++) part[own[k]] = number, level[own[k]] = far;
        level[root] = 0, queue[0] = root;
        while (at < end) {
            const int32_t k = queue[at++];
            for (int32_t v : graph.of(k))
                if (part[v] == number && level[v] == far)
                    level[v] = level[k] + 1, queue[end++] = v;
        }
        return end;
    }

    // The level that separates with the fewest nodes, and evenly; -1: none does.
    int32_t best_level(int32_t size) {
        int32_t best = -1, at = 0;
        double least = std::numeric_limits<double>::infinity();
        while (at < size) {
            const int32_t own = level[queue[at]];
            int32_t touching = 0;
            for (; at < size && level[queue[at]] == own; at++) touching += touches(queue[at]);
            const int32_t before = at - touching, behind = size - at;
            const double uneven = double(before - behind) / size;
            const double costs = touching * (1 + uneven * uneven);
            if (std::min(before, behind) >= LEAST * size && costs < least)
                best = own, least = costs;
        }
        return best;
    }

    // Whether a node has a neighbour in the next level.
    bool touches(int32_t k) const {
        for (int32_t v : graph.of(k))
            if (part[v] == number && level[v] == level[k] + 1) return true;
        return false;
    }
};

inline Vector<int32_t> levels(Vector<const int32_t> start, Vector<const int32_t> adjacent) {
    const Graph graph(start, adjacent);
    return Levels(graph).run();
}

static PyMethodDef methods[] = {
    FUNCTION(minimum_degree, "start, adjacent, stage"),
    FUNCTION(resume, "start, adjacent, position, first, begin, rows"),
    FUNCTION(levels, "start, adjacent"),
    {}};

}  // namespace ordering
