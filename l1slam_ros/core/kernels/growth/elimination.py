# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What of an elimination order is as good once nodes or neighbours have come in."""

import numpy as np

from l1slam_ros.core.kernels.compiled import loop


@loop('(i4[::1], i4[::1], i4[::1], i8[::1], i4[::1])')
def untouched(start, adjacent, order, column, rows):
    """
    Return what stays of an elimination of fewer nodes or neighbours: order, column and rows.

    start, adjacent : the neighbours of each node by now; others as of `symbolic.postorder`. What
    stays is a column that has all neighbours of its node, if all below it in the tree do.
    """
    n, old = len(start) - 1, len(order)
    place, seen = np.empty(n, np.int32), np.empty(n, np.int32)
    for k in range(n):
        place[k], seen[k] = old, -1
    for step in range(old):
        place[order[step]] = step
    touched = np.zeros(old + 1, np.bool_)
    kept = np.empty(old, np.int32)
    count, end = 0, 0
    for step in range(old):
        v, above = order[step], old
        for k in rows[column[step]:column[step + 1]]:
            seen[k] = step
            above = min(above, place[k])
        for k in adjacent[start[v]:start[v + 1]]:
            if place[k] > step and seen[k] != step:
                touched[step] = touched[place[k]] = True
        if touched[step]:
            touched[above] = True
        else:
            kept[count] = step
            count += 1
            end += column[step + 1] - column[step]
    own_order, own_column = np.empty(count, np.int32), np.empty(count + 1, np.int64)
    own_rows, own_column[0] = np.empty(end, np.int32), 0
    for at in range(count):
        step = kept[at]
        own_order[at] = order[step]
        own_column[at + 1] = own_column[at] + column[step + 1] - column[step]
        for k in range(column[step + 1] - column[step]):
            own_rows[own_column[at] + k] = rows[column[step] + k]
    return own_order, own_column, own_rows
