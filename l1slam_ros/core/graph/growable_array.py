# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""An array that grows at its end."""

import mmap
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

# Memory of this process alone; elsewhere it is so anyway.
_PRIVATE = ({'flags': mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, 'MAP_PRIVATE')
            else {})
# [bytes] To move what is as large may take many milliseconds, so it is moved once more, to where
# there is room for so many times what it would need next.
_LARGE = 2**17
_AHEAD = 64


class GrowingArray:
    """
    Rows of one shape, appended in amortised constant time.

    What `view` returned is not written to by `extend`, so it stays valid while the array grows.

    Parameters
    ----------
    shape : the shape of one row
    dtype : the type of one entry
    room : rows that come without moving those before; they take no memory until they do

    """

    def __init__(self, shape: tuple[int, ...] = (), dtype: DTypeLike = np.float64,
                 room: int = 0):
        self._data = _reserved((room, *shape), dtype) if room else np.empty((0, *shape), dtype)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def __getstate__(self) -> dict[str, Any]:
        """Return the rows without the room for more."""
        return {'_data': self.view(), '_length': self._length}

    def extend(self, rows: np.ndarray) -> None:
        """Append rows, (k, *shape)."""
        end = self._length + len(rows)
        if end > len(self._data):
            self._move(end)
        self._data[self._length:end] = rows
        self._length = end

    def append(self, row: np.ndarray | float) -> None:
        """Append one row, (*shape)."""
        end = self._length + 1
        if end > len(self._data):
            self._move(end)
        self._data[end - 1] = row
        self._length = end

    def _move(self, end: int) -> None:
        """Move all rows to where there is room for so many, and more."""
        capacity = max(end, 2 * len(self._data), 16)
        shape, dtype = self._data.shape[1:], self._data.dtype
        grown = None
        if self._length and self._data.nbytes >= _LARGE and _PRIVATE:
            with suppress(OSError, MemoryError):
                grown = _reserved((_AHEAD * capacity, *shape), dtype)
        if grown is None:
            grown = np.empty((capacity, *shape), dtype)
        grown[:self._length] = self.view()
        self._data = grown

    def shorten(self, length: int) -> None:
        """Take back all rows but the first ones; views of those taken back are void."""
        self._length = length

    def replace(self, start: int, rows: np.ndarray) -> None:
        """Let rows (k, *shape) stand from `start` on; views of what stood there are void."""
        self._length = start
        self.extend(rows)

    def view(self) -> np.ndarray:
        """Return all rows so far, (n, *shape), without copying."""
        return self._data[: self._length]

    def copy(self) -> 'GrowingArray':
        """Return an equal array that shares these rows; without spare room, it moves to grow."""
        clone = GrowingArray(self._data.shape[1:], self._data.dtype)
        clone._data = self.view()
        clone._length = self._length
        return clone


def _reserved(shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """
    Return an array of zeros whose small pages come as they are written to.

    For large arrays NumPy asks for huge pages, and the first write to one may wait for
    milliseconds, until the system has found one.
    """
    count = int(np.prod(shape))
    memory = mmap.mmap(-1, max(count, 1) * np.dtype(dtype).itemsize, **_PRIVATE)
    if hasattr(mmap, 'MADV_NOHUGEPAGE'):
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype, count).reshape(shape)


def few_rows(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """
    Return a few rows of an array, (k, *shape), as `array[rows]` does.

    That lets go of the interpreter's lock, which a thread that computes may keep for 5 ms then.
    """
    some = np.empty((len(rows), *array.shape[1:]), array.dtype)
    for place, row in enumerate(rows.tolist()):
        some[place] = array[row]
    return some
