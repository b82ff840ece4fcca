// SPDX-License-Identifier: Apache-2.0
// Nested dissection: which keyframes hold two halves of a graph together, and so on in the halves.
//
// Eliminated last, these separators keep large graphs from filling in. A good one is found on a
// small graph that is like the large one: nodes are merged in pairs, over and over; the smallest
// graph is cut; and on the way back each graph gets the cut of the one below it, made better by
// moving nodes one by one.
//
// Sources: Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning
// irregular graphs" (1998); Fiduccia and Mattheyses, "A linear-time heuristic for improving
// network partitions" (1982), for the moves, here of separators.
#pragma once
#include <algorithm>
#include <cstdlib>
#include <limits>
#include <vector>

#include "symbolic.hpp"

namespace dissection {

using symbolic::given;
using symbolic::Places;
using Sides = std::vector<int8_t>;

// The sides of a cut, and what is between.
constexpr int8_t LEFT = 0, RIGHT = 1, BETWEEN = 2, NOWHERE = -1;

// A graph of merged nodes.
struct Merged {
    Places start, adjacent, heavy;  // heavy : how many edges of the whole graph one stands for
    Places weight, into;            // how many nodes one stands for, and the one it is merged into
    int32_t size() const { return int32_t(weight.size()); }
    template <class Visit> void each(int32_t k, Visit visit) const {
        for (int32_t at = start[k]; at < start[k + 1]; at++) visit(adjacent[at]);
    }
};

// Merges nodes in pairs, over and over.
class Coarsening {
    // Until so few are left, or until so many of them find no partner.
    static constexpr int FEW = 20;
    static constexpr double STUCK = 0.9;

  public:
    std::vector<Merged> graphs;

    explicit Coarsening(int32_t n) : graphs(1), part(n, -1), local(n) {}

    // Make the first graph of some nodes.
    void take(const int32_t* own, int32_t size, const symbolic::Graph& whole) {
        Merged& graph = graphs[0];
        number++;
        for (int32_t k = 0; k < size; k++) part[own[k]] = number, local[own[k]] = k;
        graph.weight.assign(size, 1);
        graph.start.assign(1, 0), graph.adjacent.clear();
        for (int32_t k = 0; k < size; k++) {
            for (int32_t v : whole.of(own[k]))
                if (part[v] == number) graph.adjacent.push_back(local[v]);
            graph.start.push_back(int32_t(graph.adjacent.size()));
        }
        graph.heavy.assign(graph.adjacent.size(), 1);
    }

    // Merge until no more than `most` nodes are left, or few; return the number of the last graph.
    // attempt : which pairs are merged differs from one to the next
    size_t coarsen(size_t level, int32_t most, int32_t attempt) {
        while (graphs[level].size() > std::max(most, FEW)) {
            if (graphs.size() < level + 2) graphs.emplace_back();
            const int32_t count = match(graphs[level], attempt);
            if (count > STUCK * graphs[level].size()) break;
            merge(graphs[level], count, graphs[level + 1]);
            level++;
        }
        return level;
    }

  private:
    int32_t number = 0;
    Places part, local, order, place, members[2];

    // Find the merged node that each belongs to: heavy edges first; return how many there are.
    int32_t match(Merged& graph, int32_t attempt) {
        const int32_t n = graph.size();
        shuffle(n, attempt);
        const double most = std::max(1.5 * graphs[0].size() / FEW, 2.0);
        int32_t count = 0;
        graph.into.assign(n, -1);
        for (int32_t k : order) {
            if (graph.into[k] >= 0) continue;
            int32_t best = k, heaviest = 0;
            for (int32_t at = graph.start[k]; at < graph.start[k + 1]; at++) {
                const int32_t v = graph.adjacent[at];
                if (graph.into[v] < 0 && graph.heavy[at] > heaviest &&
                    graph.weight[k] + graph.weight[v] <= most)
                    best = v, heaviest = graph.heavy[at];
            }
            graph.into[k] = graph.into[best] = count++;
        }
        return count;
    }

    // Write 0, 1, ... in an order that is always the same and like none of the graph's.
    void shuffle(int32_t n, int32_t attempt) {
        int64_t state = n + attempt;
        order.resize(n);
        for (int32_t k = 0; k < n; k++) order[k] = k;
        for (int32_t k = n - 1; k > 0; k--) {
            state = (state * 1103515245 + 12345) & 0x7fffffff;
            std::swap(order[k], order[(state >> 3) % (k + 1)]);
        }
    }

    void merge(const Merged& graph, int32_t count, Merged& merged) {
        members[0].assign(count, -1), members[1].resize(count), place.assign(count, -1);
        merged.weight.assign(count, 0);
        for (int32_t k = 0; k < graph.size(); k++) {
            const int32_t c = graph.into[k];
            members[1][c] = k;
            if (members[0][c] < 0) members[0][c] = k;
            merged.weight[c] += graph.weight[k];
        }
        merged.start.assign(1, 0), merged.adjacent.clear(), merged.heavy.clear();
        for (int32_t c = 0; c < count; c++) {
            const int32_t begin = merged.start[c];
            auto add = [&](int32_t k) {
                for (int32_t at = graph.start[k]; at < graph.start[k + 1]; at++) {
                    const int32_t v = graph.into[graph.adjacent[at]];
                    if (v == c) continue;
                    if (place[v] < begin) {
                        place[v] = int32_t(merged.adjacent.size());
                        merged.adjacent.push_back(v), merged.heavy.push_back(0);
                    }
                    merged.heavy[place[v]] += graph.heavy[at];
                }
            };
            add(members[0][c]);
            if (members[1][c] != members[0][c]) add(members[1][c]);
            merged.start.push_back(int32_t(merged.adjacent.size()));
        }
    }
};

// Moves nodes out of a separator, and their neighbours into it, while it gets lighter.
class Improvement {
    // Passes of moves over each graph, and moves that one goes on without a lighter separator.
    static constexpr int PASSES = 3, HOPE = 100;
    // No side may be a larger share of what is cut. Of a sphere it pays to cut off a cap.
    static constexpr double MOST = 0.72;

  public:
    void improve(const Merged& of, Sides& sides) {
        graph = &of, side = sides.data();
        int64_t total = 0;
        std::fill_n(weights, 3, 0);
        for (int32_t k = 0; k < of.size(); k++)
            weights[side[k]] += of.weight[k], total += of.weight[k];
        most = MOST * double(total);
        locked.assign(of.size(), -1);
        for (auto& own : pulled) own.resize(of.size());
        for (turn = 0; turn < PASSES && pass(); turn++) {}
    }

  private:
    const Merged* graph = nullptr;
    int8_t* side = nullptr;
    int64_t weights[3];
    double most = 0.0;
    int turn = 0;
    Places pulled[2];  // what each node in the separator would pull into it, to either side
    Places locked;     // in which pass each was moved
    Places moves;      // nodes that were moved, each before those that it pulled in, -1 - v
    std::vector<int64_t> heaps[2];  // those that wait, the highest gain on top

    int64_t unevenness() const { return std::abs(weights[LEFT] - weights[RIGHT]); }
    int32_t gain(int32_t k, int to) const { return graph->weight[k] - pulled[to][k]; }

    // Do one pass of moves and undo those behind the best; false: it found nothing better.
    bool pass() {
        for (auto& heap : heaps) heap.clear();
        moves.clear();
        for (int32_t k = 0; k < graph->size(); k++)
            if (side[k] == BETWEEN) enter(k);
        int64_t least = weights[BETWEEN], uneven = unevenness();
        size_t kept = 0;
        for (int since = 0; since < HOPE; since++) {
            const int to = choose();
            if (to < 0) break;
            const int32_t k = node_of(heaps[to].front());
            locked[k] = turn;
            move(k, to);
            if (weights[BETWEEN] < least ||
                (weights[BETWEEN] == least && unevenness() < uneven)) {
                least = weights[BETWEEN], uneven = unevenness();
                kept = moves.size(), since = -1;
            }
        }
        undo(kept);
        return kept > 0;
    }

    // The side that the best node is to go to, -1: none may move.
    int choose() {
        int best = -1;
        int64_t highest = 0;
        for (int to : {LEFT, RIGHT}) {
            auto& heap = heaps[to];
            for (; !heap.empty(); std::pop_heap(heap.begin(), heap.end()), heap.pop_back()) {
                const int32_t k = node_of(heap.front());
                const int64_t its = heap.front() >> 32;
                const bool fits = double(weights[to] + graph->weight[k]) <= most ||
                                  weights[to] < weights[1 - to];
                if (side[k] != BETWEEN || locked[k] == turn || !fits || its != gain(k, to))
                    continue;
                if (best < 0 || its > highest ||
                    (its == highest && weights[to] < weights[1 - to]))
                    best = to, highest = its;
                break;
            }
        }
        return best;
    }

    // Let a node leave to a side; what it touches on the other side comes in.
    void move(int32_t k, int to) {
        const Places& weight = graph->weight;
        weights[BETWEEN] -= weight[k], weights[to] += weight[k];
        side[k] = int8_t(to);
        moves.push_back(k);
        graph->each(k, [&](int32_t v) {
            if (side[v] == BETWEEN) {
                pulled[1 - to][v] += weight[k];
            } else if (side[v] == 1 - to) {
                side[v] = BETWEEN;
                weights[1 - to] -= weight[v], weights[BETWEEN] += weight[v];
                moves.push_back(-1 - v);
                enter(v);
                graph->each(v, [&](int32_t u) {
                    if (side[u] != BETWEEN || u == v) return;
                    pulled[to][u] -= weight[v];
                    wait(u, to);
                });
            }
        });
    }

    // Take the moves behind `kept` back, the last one first: a node, and those it pulled in.
    void undo(size_t kept) {
        const Places& weight = graph->weight;
        for (size_t at = moves.size(), first; at > kept; at = first) {
            for (first = at - 1; moves[first] < 0;) first--;
            const int32_t k = moves[first];
            const int to = side[k];
            for (size_t which = first + 1; which < at; which++) {
                const int32_t v = -1 - moves[which];
                side[v] = int8_t(1 - to);
                weights[BETWEEN] -= weight[v], weights[1 - to] += weight[v];
            }
            side[k] = BETWEEN;
            weights[to] -= weight[k], weights[BETWEEN] += weight[k];
        }
    }

    // Let a node that came into the separator wait for its turn to leave it.
    void enter(int32_t k) {
        pulled[LEFT][k] = pulled[RIGHT][k] = 0;
        graph->each(k, [&](int32_t v) {
            if (side[v] < BETWEEN) pulled[1 - side[v]][k] += graph->weight[v];
        });
        wait(k, LEFT), wait(k, RIGHT);
    }

    static int32_t node_of(int64_t entry) { return int32_t(entry & 0xffffffff); }
    void wait(int32_t k, int to) {
        heaps[to].push_back(int64_t(gain(k, to)) * (int64_t(1) << 32) + k);
        std::push_heap(heaps[to].begin(), heaps[to].end());
    }
};

class Dissection {
    // Parts of no more nodes are not cut: minimum degree orders them as well. Nor are those of
    // which a separator would be so large a share.
    static constexpr int32_t WHOLE = 120;
    static constexpr double CUT = 0.3;
    // The cuts of a part are made of a graph that is so many times smaller; so many cuts of each
    // smallest graph.
    static constexpr int32_t SMALLER = 5, TRIES = 5;
    // Of a part of more than so many nodes so many cuts are made, by merging on in different ways.
    // One cut alone costs a third more work; most of the work is in the separators of large parts,
    // most of the time to find them goes to small ones.
    static int32_t cuts(int32_t size) { return size > 2000 ? 7 : size > 500 ? 4 : 3; }

  public:
    explicit Dissection(const symbolic::Graph& graph)
        : graph(graph), n(graph.n), coarsening(n) {}

    Vector<int32_t> run() {
        struct Part { int32_t begin, end, depth; };
        Places nodes(n), depth(n), sorted;
        for (int32_t k = 0; k < n; k++) nodes[k] = k;
        std::vector<Part> parts{{0, n, 1}};
        int32_t deepest = 0;
        while (!parts.empty()) {
            const auto [low, high, below] = parts.back();
            parts.pop_back();
            const int32_t size = high - low;
            if (size <= WHOLE) continue;
            int32_t* own = nodes.data() + low;
            coarsening.take(own, size, graph);
            const Sides& side = cut(size);
            int32_t count[3] = {};
            for (int8_t its : side) count[its]++;
            if (count[BETWEEN] > CUT * size || !count[LEFT] || !count[RIGHT]) continue;
            int32_t at[3] = {0, count[LEFT], count[LEFT] + count[RIGHT]};
            sorted.resize(size);
            for (int32_t k = 0; k < size; k++) sorted[at[side[k]]++] = own[k];
            std::copy(sorted.begin(), sorted.end(), own);
            const int32_t middle = low + count[LEFT], end = high - count[BETWEEN];
            for (int32_t k = end; k < high; k++) depth[nodes[k]] = below;
            deepest = std::max(deepest, below);
            parts.push_back({low, middle, below + 1});
            parts.push_back({middle, end, below + 1});
        }
        for (auto& its : depth) its = its ? deepest + 1 - its : 0;
        return given(depth);
    }

  private:
    const symbolic::Graph& graph;
    const int32_t n;
    Coarsening coarsening;
    Improvement improvement;
    Sides best, side, other;
    Places queue;

    // The side of each node of the first graph: the lightest of some cuts of a smaller one.
    const Sides& cut(int32_t size) {
        const size_t top = coarsening.coarsen(0, size / SMALLER, 0);
        double least = std::numeric_limits<double>::infinity();
        for (int32_t attempt = 0; attempt < cuts(size); attempt++) {
            const size_t bottom = coarsening.coarsen(top, 0, attempt);
            first_cut(coarsening.graphs[bottom]);
            bring_back(bottom, top);
            keep_lighter(coarsening.graphs[top], best, least);
        }
        side = best;
        bring_back(top, 0);
        return side;
    }

    // Keep `side` if it costs less than what was kept.
    void keep_lighter(const Merged& of, Sides& kept, double& least) const {
        const double costs = costs_of(of);
        if (costs < least) least = costs, kept = side;
    }

    // Make `side` that of a larger graph.
    void bring_back(size_t level, size_t to) {
        for (; level > to; level--) {
            const Merged& larger = coarsening.graphs[level - 1];
            other.resize(larger.size());
            for (int32_t k = 0; k < larger.size(); k++) other[k] = side[larger.into[k]];
            side.swap(other);
            improvement.improve(larger, side);
        }
    }

    // Make `side` the best of some cuts of a small graph, each grown around a node anywhere.
    void first_cut(const Merged& of) {
        double least = std::numeric_limits<double>::infinity();
        Sides lightest;
        for (int64_t attempt = 0; attempt < TRIES; attempt++) {
            grow(of, int32_t(attempt * 7919 % of.size()));
            improvement.improve(of, side);
            keep_lighter(of, lightest, least);
        }
        side = lightest;
    }

    // The weight of the separator, a little more where it cuts unevenly.
    double costs_of(const Merged& of) const {
        int64_t weights[3] = {};
        for (int32_t k = 0; k < of.size(); k++) weights[side[k]] += of.weight[k];
        const double uneven = double(weights[LEFT] - weights[RIGHT]) /
                              double(weights[LEFT] + weights[RIGHT] + weights[BETWEEN]);
        return double(weights[BETWEEN]) * (1 + uneven * uneven);
    }

    // Make a cut: half of the weight around a root, and the nodes behind that touch it.
    void grow(const Merged& of, int32_t root) {
        int64_t total = 0, grown = 0;
        for (int32_t weight : of.weight) total += weight;
        side.assign(of.size(), NOWHERE);
        queue.clear();
        int32_t other_root = 0;
        for (size_t at = 0; 2 * grown < total; at++) {
            if (at == queue.size()) {
                // Nothing more is tied to the root.
                int32_t k = root;
                while (side[k] >= 0) k = other_root++;
                queue.push_back(k);
            }
            const int32_t k = queue[at];
            side[k] = LEFT;
            grown += of.weight[k];
            of.each(k, [&](int32_t v) {
                if (side[v] == NOWHERE) side[v] = BETWEEN, queue.push_back(v);
            });
        }
        for (auto& its : side)
            if (its == NOWHERE) its = RIGHT;
    }
};

inline Vector<int32_t> dissect(Vector<const int32_t> start, Vector<const int32_t> adjacent) {
    const symbolic::Graph graph(start, adjacent);
    return Dissection(graph).run();
}

static PyMethodDef methods[] = {FUNCTION(dissect, "start, adjacent"), {}};

}  // namespace dissection
