// SPDX-License-Identifier: Apache-2.0
// Where a sparse Cholesky factor lies in memory: dense panels, one for each supernode.
#pragma once
#include "arrays.hpp"

// The panels of a factor in blocks of k x k, as `symbolic` lays them out. Entry (r, c) of panel s
// is panels[offset[s] + r stride[s] + c], row after row; first : of its block columns, the
// eliminated positions first[s]:first[s + 1]; its block rows are those of the positions
// pattern[start[s]:start[s + 1]], which begin with its own columns.
struct Panels {
    Vector<const int32_t> first;
    Vector<const int64_t> start;
    Vector<const int32_t> pattern;
    Vector<const int64_t> offset, stride;
    int64_t k;

    Panels(int64_t size, Vector<const int32_t> first, Vector<const int64_t> start,
           Vector<const int32_t> pattern, Vector<const int64_t> offset,
           Vector<const int64_t> stride, int64_t k)
        : first(first), start(start), pattern(pattern), offset(offset), stride(stride), k(k) {
        require(k > 0, "the size of a block must be positive");
        require(first.size() > 0, "first must have an entry for each panel, and one more");
        const int64_t panels = count(), n = positions();
        require(start.size() == panels + 1, "start must have as many entries as first");
        require(offset.size() >= panels, "offset must have an entry for each panel");
        require(stride.size() == panels, "stride must have an entry for each panel");
        bool fits = first[0] == 0 && start[0] == 0 && start[panels] <= pattern.size();
        for (int64_t s = 0; s < panels; s++)
            fits &= columns(s) > 0 && rows(s) >= columns(s) && stride[s] >= columns(s) * k &&
                    offset[s] >= 0 && offset[s] <= size - rows(s) * k * stride[s];
        require(fits, "the panels that first, start, offset and stride tell must lie in panels");
        for (int64_t r = 0; r < pattern.size(); r++) fits &= pattern[r] >= 0 && pattern[r] < n;
        require(fits, "pattern must hold positions that first knows");
    }
    int64_t count() const { return first.size() - 1; }
    int64_t positions() const { return first[count()]; }
    int64_t columns(int64_t s) const { return first[s + 1] - first[s]; }
    int64_t rows(int64_t s) const { return start[s + 1] - start[s]; }
    int64_t tallest() const {
        int64_t most = 0;
        for (int64_t s = 0; s < count(); s++) most = rows(s) > most ? rows(s) : most;
        return most;
    }
};

// Whether `position` tells where each of the eliminated keyframes stands in that order.
inline void check_positions(const Panels& shape, Vector<const int32_t> position) {
    const int64_t n = shape.positions();
    require(position.size() == n, "position must have an entry for each column of blocks");
    bool fits = true;
    for (int64_t f = 0; f < n; f++) fits &= position[f] >= 0 && position[f] < n;
    require(fits, "position must hold positions that first knows");
}

// Its arrays among the arguments of a function, and their names for its signature.
#define PANELS_ARGUMENTS \
    Vector<const int32_t> first, Vector<const int64_t> start, Vector<const int32_t> pattern, \
    Vector<const int64_t> offset, Vector<const int64_t> stride
#define PANELS_NAMES "first, start, pattern, offset, stride"
