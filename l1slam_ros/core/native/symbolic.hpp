// SPDX-License-Identifier: Apache-2.0
// Where the entries of a block Cholesky factor lie: elimination tree, postorder, supernodes.
#pragma once
#include <algorithm>
#include <limits>
#include <vector>

#include "arrays.hpp"

namespace symbolic {

constexpr double ZEROS = 0.1;  // a panel may hold this part of zeros for the sake of being larger
using Places = std::vector<int32_t>;
using Counts = std::vector<int64_t>;

template <class T> Vector<T> given(const std::vector<T>& values) {
    auto made = new_array<T, 1>({int64_t(values.size())});
    std::copy(values.begin(), values.end(), made.data);
    return made;
}

// The neighbours of each node: adjacent[start[k]:start[k + 1]], each once, ascending.
inline std::tuple<Vector<int32_t>, Vector<int32_t>> neighbours(Matrix<int64_t> keyframe,
                                                               int64_t size) {
    Counts begin(size + 1);
    auto each = [&](auto visit) {
        for (int64_t f = 0; f < keyframe.size(); f++)
            if (keyframe(f, 0) < size && keyframe(f, 1) < size)
                visit(keyframe(f, 0), keyframe(f, 1)), visit(keyframe(f, 1), keyframe(f, 0));
    };
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

struct Postorder {
    Places position, parent, old;
    Counts below;
};

// Renumber an elimination so that every subtree of the elimination tree is one run.
inline Postorder postorder(Vector<int32_t> order, Vector<int64_t> column, Vector<int32_t> rows) {
    int32_t n = int32_t(order.size());
    Places step(n), parent(n), child(n + 1, -1), sibling(n), old(n), stack(n + 1), fresh(n + 1);
    for (int32_t k = 0; k < n; k++) step[order[k]] = k;
    for (int32_t k = n - 1; k >= 0; k--) {
        parent[k] = n;
        for (int64_t at = column[k]; at < column[k + 1]; at++)
            parent[k] = std::min(parent[k], step[rows[at]]);
        // The child with the longest column comes last, next to its parent.
        sibling[k] = child[parent[k]], child[parent[k]] = k;
    }
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
    fresh[n] = n;
    for (int32_t k = 0; k < n; k++) fresh[old[k]] = k;
    Postorder made{Places(n), Places(n), old, Counts(n)};
    for (int32_t k = 0; k < n; k++) {
        made.position[order[k]] = fresh[k];
        made.parent[k] = fresh[parent[old[k]]];
        made.below[k] = column[old[k] + 1] - column[old[k]];
    }
    return made;
}

// The first column of each supernode, and n.
inline Places supernodes(const Postorder& of) {
    int32_t n = int32_t(of.parent.size()), count = 0;
    Places first(n + 1);
    Counts zeros(n);
    for (int32_t k = 0; k < n; k++) {
        first[count] = k, zeros[count++] = 0;
        while (count > 1) {
            int32_t middle = first[count - 1], start = first[count - 2];
            if (of.parent[middle - 1] > k) break;
            // All columns of the left run get the rows of the merged one.
            int64_t added = (middle - start) * (k + 1 - middle + of.below[k] - of.below[middle - 1]);
            int64_t width = k + 1 - start, total = zeros[count - 2] + zeros[count - 1] + added;
            if (total > ZEROS * width * (width + 1 + 2 * of.below[k]) / 2) break;
            zeros[--count - 1] = total;
        }
    }
    first[count] = n;
    first.resize(count + 1);
    return first;
}

// The rows of every panel: where those of each begin, and the positions, sorted.
inline void panel_rows(const Places& first, Vector<int64_t> column, Vector<int32_t> rows,
                       const Postorder& of, Counts& start, Places& pattern) {
    int64_t count = first.size() - 1, n = of.position.size();
    start.assign(count + 1, 0);
    Counts end(count), member(n + 1);
    for (int64_t s = 0; s < count; s++) {
        int32_t last = of.old[first[s + 1] - 1];
        end[s] = start[s] + first[s + 1] - first[s];
        start[s + 1] = end[s] + column[last + 1] - column[last];
        for (int64_t at = column[last]; at < column[last + 1]; at++)
            member[of.position[rows[at]] + 1]++;
    }
    for (int64_t k = 0; k < n; k++) member[k + 1] += member[k];
    Places owner(member[n]);
    for (int64_t s = 0; s < count; s++) {
        int32_t last = of.old[first[s + 1] - 1];
        for (int64_t at = column[last]; at < column[last + 1]; at++)
            owner[member[of.position[rows[at]]]++] = int32_t(s);
    }
    pattern.resize(start[count]);
    for (int64_t s = 0; s < count; s++)
        for (int32_t k = first[s]; k < first[s + 1]; k++) pattern[start[s] + k - first[s]] = k;
    int64_t at = 0;
    for (int64_t row = 0; row < n; row++)
        for (; at < member[row]; at++) pattern[end[owner[at]]++] = int32_t(row);
}

// What to factorise at the same time, 0 and 1, and what after both, 2.
inline std::vector<int8_t> halves(const Places& first, const Counts& start, const Places& pattern) {
    int64_t count = first.size() - 1;
    Counts owner(first[count]), lowest(count);
    std::vector<double> own(count), crossing(count + 2);
    for (int64_t s = 0; s < count; s++) {
        lowest[s] = s;
        std::fill(owner.begin() + first[s], owner.begin() + first[s + 1], s);
        double width = first[s + 1] - first[s], height = double(start[s + 1] - start[s]);
        own[s] = width * (height - width / 2) * (height - width / 2);
    }
    double whole = 0.0, least = std::numeric_limits<double>::infinity(), left = 0.0, after = 0.0;
    for (int64_t s = 0; s < count; s++) {
        int64_t below = start[s] + first[s + 1] - first[s];
        if (below < start[s + 1]) {
            int64_t above = owner[pattern[below]];
            lowest[above] = std::min(lowest[above], lowest[s]);
        }
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

inline std::tuple<Vector<int32_t>, Vector<int32_t>, Vector<int64_t>, Vector<int32_t>,
                  Vector<int8_t>, double>
lay_out(Vector<int32_t> order, Vector<int64_t> column, Vector<int32_t> rows) {
    auto of = postorder(order, column, rows);
    auto first = supernodes(of);
    Counts start;
    Places pattern;
    panel_rows(first, column, rows, of, start, pattern);
    double work = 0.0;
    for (auto below : of.below) work += (below + 1.0) * (below + 1.0) / 2;
    return {given(of.position), given(first), given(start), given(pattern),
            given(halves(first, start, pattern)), work};
}

// Where the blocks of a matrix of k x k blocks lie in the panels.
inline std::tuple<Vector<int64_t>, Vector<int64_t>, Vector<bool>, Vector<int64_t>, Vector<int64_t>>
block_addresses(Matrix<int64_t> keyframe, Vector<int32_t> position, Vector<int32_t> first,
                Vector<int64_t> start, Vector<int32_t> pattern, Vector<int64_t> offset,
                Vector<int64_t> stride, int64_t k) {
    int64_t n = position.shape[0], m = keyframe.shape[0];
    auto corner = new_array<int64_t, 1>({n}), own = new_array<int64_t, 1>({n});
    auto address = new_array<int64_t, 1>({m}), width = new_array<int64_t, 1>({m});
    auto turned = new_array<bool, 1>({m});
    Counts owner(n);
    for (int64_t s = 0; s < first.size() - 1; s++)
        std::fill(owner.begin() + first[s], owner.begin() + first[s + 1], s);
    for (int64_t v = 0; v < n; v++) {
        int64_t s = owner[position[v]];
        own[v] = stride[s];
        corner[v] = offset[s] + (position[v] - first[s]) * k * (own[v] + 1);
    }
    for (int64_t f = 0; f < m; f++) {
        int64_t i = keyframe(f, 0), j = keyframe(f, 1);
        address[f] = -1, width[f] = 0, turned[f] = false;
        if (i >= n || j >= n) continue;
        turned[f] = position[i] > position[j];
        int64_t v = turned[f] ? j : i;
        int32_t row = position[turned[f] ? i : j];
        int64_t s = owner[position[v]];
        const int32_t *low = &pattern[start[s]], *high = pattern.data + start[s + 1];
        int64_t at = std::lower_bound(low, high, row) - low;
        width[f] = own[v];
        address[f] = offset[s] + at * k * own[v] + (position[v] - first[s]) * k;
    }
    return {address, width, turned, corner, own};
}

static PyMethodDef methods[] = {
    FUNCTION(neighbours, "keyframe, size"),
    FUNCTION(lay_out, "order, column, rows"),
    FUNCTION(block_addresses, "keyframe, position, first, start, pattern, offset, stride, k"),
    {}};

}  // namespace symbolic
