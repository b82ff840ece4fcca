// SPDX-License-Identifier: Apache-2.0
// Breadth-first trees of a graph, and products along them.
#pragma once
#include <algorithm>
#include <vector>

#include "arrays.hpp"
#include "se2.hpp"
#include "se3.hpp"

namespace spanning_tree {

using Indices = Vector<const int64_t>;

// The parent of each of n nodes in breadth-first trees, one after the other, each root its own;
// -1: no path leads there. Edges (i, j); of a node first those that leave it are followed, by
// ascending j, then those that end there, by ascending i.
inline Vector<int64_t> parents(Indices i, Indices j, int64_t n, Indices roots) {
    const int64_t m = i.size();
    require(j.size() == m, "j must have as many entries as i");
    bool fits = n >= 0;
    for (int64_t e = 0; e < m; e++) fits &= i[e] >= 0 && i[e] < n && j[e] >= 0 && j[e] < n;
    for (int64_t r = 0; r < roots.size(); r++) fits &= roots[r] >= 0 && roots[r] < n;
    require(fits, "i, j and roots must hold nodes below n");
    std::vector<int64_t> leaves(n + 1), begin(n + 1), next(n), other(2 * m);
    for (int64_t e = 0; e < m; e++) begin[i[e] + 1]++, begin[j[e] + 1]++;
    for (int64_t v = 0; v < n; v++) begin[v + 1] += begin[v], next[v] = begin[v];
    for (int64_t e = 0; e < m; e++) other[next[i[e]]++] = j[e];
    std::copy(next.begin(), next.end(), leaves.begin());
    for (int64_t e = 0; e < m; e++) other[next[j[e]]++] = i[e];
    auto parent = new_vector<int64_t>(n);
    std::fill_n(parent.data, n, int64_t(-1));
    std::vector<int64_t> reached;
    reached.reserve(n);
    for (int64_t r = 0; r < roots.size(); r++) {
        if (parent[roots[r]] >= 0) continue;
        parent[roots[r]] = roots[r];
        reached.assign(1, roots[r]);
        for (size_t at = 0; at < reached.size(); at++) {
            const int64_t v = reached[at];
            std::sort(other.data() + begin[v], other.data() + leaves[v]);
            std::sort(other.data() + leaves[v], other.data() + begin[v + 1]);
            for (int64_t e = begin[v]; e < begin[v + 1]; e++)
                if (parent[other[e]] < 0) parent[other[e]] = v, reached.push_back(other[e]);
        }
    }
    return parent;
}

// Poses as the product of relative ones from their root down. parent : (n,), a root is its own;
// relative : (n, p) as seen from the parent, of roots their poses.
inline Matrix<double> compose(Indices parent, Matrix<const double> relative) {
    const int64_t n = parent.size(), p = relative.shape[1];
    require(relative.size() == n, "relative must have a row for each entry of parent");
    require(p == 3 || p == 7, "relative must be poses, (n, 3) or (n, 7)");
    bool fits = true;
    for (int64_t v = 0; v < n; v++) fits &= parent[v] >= 0 && parent[v] < n;
    require(fits, "parent must hold rows of relative");
    auto poses = new_array<double, 2>({n, p});
    std::vector<bool> known(n), seen(n);
    std::vector<int64_t> way;
    for (int64_t last = 0; last < n; last++) {
        for (int64_t v = last; !seen[v]; v = parent[v]) seen[v] = true, way.push_back(v);
        for (; !way.empty(); way.pop_back()) {
            const int64_t v = way.back(), up = parent[v];
            require(known[up] || up == v, "parent must be that of trees");
            if (up == v) std::copy_n(relative[v], p, poses[v]);
            else if (p == 3) se2::compose(poses[up], relative[v], poses[v]);
            else se3::compose(poses[up], relative[v], poses[v]);
            known[v] = true;
        }
    }
    return poses;
}

static PyMethodDef methods[] = {
    BY_SIZE(parents, "i, j, n, roots"),
    BY_SIZE(compose, "parent, relative"),
    {}};

}  // namespace spanning_tree
