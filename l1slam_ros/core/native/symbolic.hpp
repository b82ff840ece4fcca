// SPDX-License-Identifier: Apache-2.0
// Where the entries of a block Cholesky factor lie: elimination tree, postorder, supernodes.
//
// A supernode is a run of columns with one pattern below, stored as one dense panel. Source:
// Davis, "Direct Methods for Sparse Linear Systems" (2006), chapter 4; Ashcraft and Grimes (1989)
// for the merging of supernodes that costs few zeros.
#pragma once
#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

#include "arrays.hpp"

namespace symbolic {

constexpr double ZEROS = 0.1;  // a panel may hold this part of zeros for the sake of being larger
using Places = std::vector<int32_t>;
using Counts = std::vector<int64_t>;

template <class T> Vector<T> given(const std::vector<T>& values) {
    auto made = new_vector<T>(int64_t(values.size()));
    std::copy(values.begin(), values.end(), made.data);
    return made;
}

// Which nodes are joined: the neighbours of node k are adjacent[start[k]:start[k + 1]].
struct Graph {
    const int32_t *start, *adjacent;
    int32_t n;

    Graph(Vector<const int32_t> start, Vector<const int32_t> adjacent)
        : start(start.data), adjacent(adjacent.data), n(int32_t(start.size() - 1)) {
        bool fits = n >= 0 && start[0] == 0 && start[n] == adjacent.size();
        for (int32_t k = 0; fits && k < n; k++) fits = start[k] <= start[k + 1];
        require(fits, "start must rise from 0 to the size of adjacent");
        for (int64_t at = 0; fits && at < adjacent.size(); at++)
            fits = adjacent[at] >= 0 && adjacent[at] < n;
        require(fits, "adjacent must name nodes of start");
    }
    struct Range {
        const int32_t *from, *to;
        const int32_t* begin() const { return from; }
        const int32_t* end() const { return to; }
    };
    Range of(int32_t k) const { return {adjacent + start[k], adjacent + start[k + 1]}; }
};

// The step at which each node comes in an order of all nodes.
inline Places steps_of(Vector<const int32_t> order, int32_t n) {
    Places step(n, -1);
    bool fits = order.size() == n;
    for (int32_t k = 0; fits && k < n; k++) {
        fits = order[k] >= 0 && order[k] < n && step[order[k]] < 0;
        if (fits) step[order[k]] = k;
    }
    require(fits, "order must name each node of the graph once");
    return step;
}

// The neighbours of each node: adjacent[start[k]:start[k + 1]], each once, ascending.
inline std::tuple<Vector<int32_t>, Vector<int32_t>> neighbours(Matrix<const int64_t> keyframe,
                                                               int64_t size) {
    require(keyframe.shape[1] == 2, "keyframe must have 2 columns");
    require(size >= 0 && size < std::numeric_limits<int32_t>::max() &&
                keyframe.size() < std::numeric_limits<int32_t>::max() / 2,
            "size and the rows of keyframe must be below 2^31 and 2^30");
    Counts begin(size + 1);
    auto each = [&](auto visit) {
        for (int64_t f = 0; f < keyframe.size(); f++) {
            int64_t i = keyframe(f, 0), j = keyframe(f, 1);
            if (i < size && j < size) visit(i, j), visit(j, i);
        }
    };
    for (int64_t f = 0; f < 2 * keyframe.size(); f++)
        require(keyframe.data[f] >= 0, "keyframe must not be negative");
    each([&](int64_t i, int64_t) { begin[i + 1]++; });
    for (int64_t k = 0; k < size; k++) begin[k + 1] += begin[k];
    Places other(begin[size]), sorted(begin[size]), start(size + 1);
    Counts end(begin.begin(), begin.end() - 1);
    each([&](int64_t i, int64_t j) { other[end[i]++] = int32_t(j); });
    // Given to their neighbours in order, nodes come in order.
    std::copy(begin.begin(), begin.end() - 1, end.begin());
    for (int64_t k = 0; k < size; k++)
        for (int64_t at = begin[k]; at < begin[k + 1]; at++) sorted[end[other[at]]++] = int32_t(k);
    int32_t count = 0;
    for (int64_t k = 0; k < size; k++) {
        for (int64_t at = begin[k]; at < begin[k + 1]; at++)
            if (at == begin[k] || sorted[at] != sorted[at - 1]) sorted[count++] = sorted[at];
        start[k + 1] = count;
    }
    sorted.resize(count);
    return {given(start), given(sorted)};
}

// What is eliminated by which step: the parent of a column is its first row below, n for a root.
// Source: Liu, "The role of elimination trees in sparse factorization" (1990).
inline Places elimination_tree(const Graph& graph, Vector<const int32_t> order,
                               const Places& step) {
    const int32_t n = graph.n;
    Places parent(n, n), ancestor(n, n);
    for (int32_t k = 0; k < n; k++)
        for (int32_t v : graph.of(order[k])) {
            // Whatever is on the way up from v is below k from now on: the next way is shorter.
            for (int32_t i = step[v]; i < k;) {
                int32_t next = std::exchange(ancestor[i], k);
                if (next == n) parent[i] = k;
                i = next;
            }
        }
    return parent;
}

// The steps in an order in which every subtree is one run, children before their parents.
inline Places postorder(const Places& parent) {
    const int32_t n = int32_t(parent.size());
    Places child(n + 1, -1), sibling(n), stack(n + 1), old(n);
    // The child that is eliminated last comes last, next to its parent: its column is longest.
    for (int32_t k = n - 1; k >= 0; k--) sibling[k] = std::exchange(child[parent[k]], k);
    int32_t place = 0, top = 0;
    stack[0] = n;
    while (top >= 0) {
        int32_t k = stack[top];
        if (child[k] >= 0) {
            stack[++top] = child[k];
            child[k] = sibling[child[k]];
        } else {
            top--;
            if (k < n) old[place++] = k;
        }
    }
    return old;
}

// How many entries each column has below the diagonal, in a postorder. Row i is in the columns on
// the way up to i from its neighbours, which make a subtree: it is counted once at each leaf, and
// once less where two ways meet, and at i. Source: Gilbert, Ng, Peyton, "An efficient algorithm to
// compute row and column counts for sparse Cholesky factorization" (1994).
inline Counts column_counts(const Graph& graph, const Places& position, const Places& node,
                            const Places& parent) {
    const int32_t n = graph.n;
    Counts below(n);
    Places least(n), last_leaf(n, -1), ancestor(n);
    for (int32_t k = 0; k < n; k++) least[k] = ancestor[k] = k;
    // The first of each subtree.
    for (int32_t k = 0; k < n; k++)
        if (parent[k] < n) least[parent[k]] = std::min(least[parent[k]], least[k]);
    auto meeting = [&](int32_t k) {
        int32_t top = k;
        while (ancestor[top] != top) top = ancestor[top];
        while (k != top) k = std::exchange(ancestor[k], top);
        return top;
    };
    for (int32_t k = 0; k < n; k++) {
        for (int32_t v : graph.of(node[k])) {
            const int32_t row = position[v];
            // No leaf, if the last one is in its subtree.
            if (row <= k || last_leaf[row] >= least[k]) continue;
            below[k]++, below[last_leaf[row] < 0 ? row : meeting(last_leaf[row])]--;
            last_leaf[row] = k;
        }
        if (parent[k] < n) ancestor[k] = parent[k];
    }
    for (int32_t k = 0; k < n; k++)
        if (parent[k] < n) below[parent[k]] += below[k];
    return below;
}

// The first column of each supernode, and n. A run of columns is merged with the run before it
// where that hangs on it and few zeros are stored for it.
inline Places supernodes(const Places& parent, const Counts& below) {
    const int32_t n = int32_t(parent.size());
    int32_t count = 0;
    Places first(n + 1);
    Counts zeros(n);
    for (int32_t k = 0; k < n; k++) {
        first[count] = k, zeros[count++] = 0;
        while (count > 1) {
            int32_t middle = first[count - 1], start = first[count - 2];
            if (parent[middle - 1] > k) break;
            // All columns of the left run get the rows of the merged one.
            int64_t added = (middle - start) * (k + 1 - middle + below[k] - below[middle - 1]);
            int64_t width = k + 1 - start, total = zeros[count - 2] + zeros[count - 1] + added;
            if (double(total) > ZEROS * double(width * (width + 1 + 2 * below[k])) / 2) break;
            zeros[--count - 1] = total;
        }
    }
    first[count] = n;
    first.resize(count + 1);
    return first;
}

// The panel of each position.
inline Places owners(const int32_t* first, int64_t count) {
    Places owner(first[count]);
    for (int64_t s = 0; s < count; s++)
        std::fill(owner.begin() + first[s], owner.begin() + first[s + 1], int32_t(s));
    return owner;
}

// The rows of every panel, positions in order: where those of each begin, and all of them. The
// columns of the supernode themselves come first; those of its last column follow.
inline std::pair<Counts, Places> panel_rows(const Graph& graph, const Places& position,
                                            const Places& node, const Places& parent,
                                            const Counts& below, const Places& first,
                                            const Places& owner) {
    const int64_t count = int64_t(first.size()) - 1;
    Counts start(count + 1);
    for (int64_t s = 0; s < count; s++)
        start[s + 1] = start[s] + first[s + 1] - first[s] + below[first[s + 1] - 1];
    Places pattern(start[count]), seen(count, -1);
    Counts end(count);
    Places above(count);
    for (int64_t s = 0; s < count; s++) {
        const int32_t up = parent[first[s + 1] - 1];
        above[s] = up < graph.n ? owner[up] : -1;
        end[s] = start[s];
        for (int32_t k = first[s]; k < first[s + 1]; k++) pattern[end[s]++] = k;
    }
    // A row is in the panels on the way up to it from those of its neighbours.
    for (int32_t row = 0; row < graph.n; row++) {
        seen[owner[row]] = row;
        for (int32_t u : graph.of(node[row])) {
            if (position[u] > row) continue;
            for (int32_t s = owner[position[u]]; seen[s] != row; s = above[s])
                seen[s] = row, pattern[end[s]++] = row;
        }
    }
    return {std::move(start), std::move(pattern)};
}

// What to factorise at the same time, 0 and 1, and what after both, 2. A cut through the postorder
// leaves whole subtrees on either side; the supernodes with descendants on both are 2. Of all cuts
// the one that takes least time.
inline std::vector<int8_t> halves(const Places& first, const Counts& start, const Places& pattern,
                                  const Places& owner) {
    const int64_t count = int64_t(first.size()) - 1;
    Counts lowest(count);
    std::vector<double> own(count), crossing(count + 2);
    double whole = 0.0, least = std::numeric_limits<double>::infinity(), left = 0.0, after = 0.0;
    for (int64_t s = 0; s < count; s++) lowest[s] = s;
    for (int64_t s = 0; s < count; s++) {
        double width = first[s + 1] - first[s], height = double(start[s + 1] - start[s]);
        own[s] = width * (height - width / 2) * (height - width / 2);
        int64_t below = start[s] + first[s + 1] - first[s];
        if (below < start[s + 1]) {
            int64_t above = owner[pattern[below]];
            lowest[above] = std::min(lowest[above], lowest[s]);
        }
        // The first of its subtree is known by now.
        crossing[lowest[s] + 1] += own[s], crossing[s + 1] -= own[s], whole += own[s];
    }
    int64_t cut = 0;
    for (int64_t s = 0; s <= count; s++) {
        after += crossing[s];
        double longest = std::max(left, whole - left - after) + after;
        if (longest < least) cut = s, least = longest;
        if (s < count) left += own[s];
    }
    std::vector<int8_t> sides(count);
    for (int64_t s = cut; s < count; s++) sides[s] = lowest[s] >= cut ? 1 : 2;
    return sides;
}

// The layout of a factor whose columns are eliminated in an order.
inline std::tuple<Vector<int32_t>, Vector<int32_t>, Vector<int64_t>, Vector<int32_t>,
                  Vector<int8_t>, double>
lay_out(Vector<const int32_t> start, Vector<const int32_t> adjacent,
        Vector<const int32_t> order) {
    const Graph graph(start, adjacent);
    const int32_t n = graph.n;
    const Places step = steps_of(order, n), above = elimination_tree(graph, order, step);
    const Places old = postorder(above);
    Places fresh(n + 1), position(n), node(n), parent(n);
    fresh[n] = n;
    for (int32_t k = 0; k < n; k++) fresh[old[k]] = k;
    for (int32_t k = 0; k < n; k++) {
        node[k] = order[old[k]], parent[k] = fresh[above[old[k]]];
        position[node[k]] = k;
    }
    const Counts below = column_counts(graph, position, node, parent);
    const Places first = supernodes(parent, below);
    const Places owner = owners(first.data(), int64_t(first.size()) - 1);
    const auto [begin, pattern] = panel_rows(graph, position, node, parent, below, first, owner);
    double work = 0.0;
    for (int64_t rows : below) work += double(rows + 1) * double(rows + 1) / 2;
    return {given(position), given(first), given(begin), given(pattern),
            given(halves(first, begin, pattern, owner)), work};
}

// Panels as they come from Python.
struct Panels {
    Vector<const int32_t> position, first;
    Vector<const int64_t> start;
    Vector<const int32_t> rows;
    int64_t count;

    Panels(Vector<const int32_t> position, Vector<const int32_t> first,
           Vector<const int64_t> start, Vector<const int32_t> rows)
        : position(position), first(first), start(start), rows(rows), count(first.size() - 1) {
        const int64_t n = position.size();
        bool fits = count >= 0 && first[0] == 0 && first[count] == n;
        for (int64_t s = 0; fits && s < count; s++) fits = first[s] < first[s + 1];
        require(fits, "first must rise from 0 to the size of position");
        fits = start.size() == count + 1 && start[0] == 0 && start[count] == rows.size();
        for (int64_t s = 0; fits && s < count; s++)
            fits = start[s + 1] - start[s] >= first[s + 1] - first[s];
        require(fits, "start must rise from 0 to the size of rows, no panel less high than wide");
        for (int64_t v = 0; fits && v < n; v++) fits = position[v] >= 0 && position[v] < n;
        require(fits, "position must be below its own size");
    }
};

// Where the blocks of a matrix of k x k blocks lie in the panels.
inline std::tuple<Vector<int64_t>, Vector<int64_t>, Vector<bool>, Vector<int64_t>, Vector<int64_t>>
block_addresses(Matrix<const int64_t> keyframe, Vector<const int32_t> position,
                Vector<const int32_t> first, Vector<const int64_t> start,
                Vector<const int32_t> rows, Vector<const int64_t> offset,
                Vector<const int64_t> stride, int64_t k) {
    const Panels panels(position, first, start, rows);
    require(keyframe.shape[1] == 2, "keyframe must have 2 columns");
    require(offset.size() == panels.count + 1 && stride.size() == panels.count,
            "offset and stride must have an entry for each panel, offset one more");
    const int64_t n = position.size(), m = keyframe.size();
    auto corner = new_vector<int64_t>(n), own = new_vector<int64_t>(n);
    auto address = new_vector<int64_t>(m), width = new_vector<int64_t>(m);
    auto turned = new_vector<bool>(m);
    const Places owner = owners(first.data, panels.count);
    for (int64_t v = 0; v < n; v++) {
        int64_t s = owner[position[v]];
        own[v] = stride[s];
        corner[v] = offset[s] + (position[v] - first[s]) * k * (own[v] + 1);
    }
    for (int64_t f = 0; f < m; f++) {
        int64_t i = keyframe(f, 0), j = keyframe(f, 1);
        require(i >= 0 && j >= 0, "keyframe must not be negative");
        address[f] = -1, width[f] = 0, turned[f] = false;
        if (i >= n || j >= n) continue;
        turned[f] = position[i] > position[j];
        int64_t v = turned[f] ? j : i;
        int32_t row = position[turned[f] ? i : j];
        int64_t s = owner[position[v]];
        const int32_t *low = rows.data + start[s], *high = rows.data + start[s + 1];
        const int32_t* at = std::lower_bound(low, high, row);
        require(at < high && *at == row, "rows must hold the blocks of all factors of keyframe");
        width[f] = own[v];
        address[f] = offset[s] + (at - low) * k * own[v] + (position[v] - first[s]) * k;
    }
    return {address, width, turned, corner, own};
}

static PyMethodDef methods[] = {
    FUNCTION(neighbours, "keyframe, size"),
    FUNCTION(lay_out, "start, adjacent, order"),
    FUNCTION(block_addresses, "keyframe, position, first, start, rows, offset, stride, k"),
    {}};

}  // namespace symbolic
