# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Numbers of the lines of a text file.

They are converted in bulk, so a graph of 700,000 edges is read in seconds. Only when the
conversion fails is the malformed line searched for, to be named.
"""

import warnings
from collections.abc import Iterable

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.core.graph.measurements import QUATERNION_NORM_ERROR
from l1slam_ros.io.files import LARGEST, TextLines, counted, first_failure, quoted


def parse_rows(path: object, name: str, lines: TextLines, ids: int,
               values: int) -> tuple[Indices, Array]:
    """
    Convert lines of `ids` whole numbers followed by `values` finite numbers, none beyond 1e30.

    Returns
    -------
    ids (m, ids) and values (m, values).

    Raises
    ------
    FileError : naming the first malformed line; `name` says what kind of line was expected.

    """
    dtype = np.dtype([('ids', np.int64, (ids,)), ('values', np.float64, (values,))])
    rows = _convert(lines.texts, dtype)
    if rows is None:
        k = first_failure(len(lines.texts),
                          lambda part: _convert(lines.texts[part], dtype) is not None)
        found = _complaint(lines.texts[k], ids, values)
        finite = f' and {values} finite' if values else ''
        raise FileError(path, f'{name}: {found}; expected {ids} whole{finite} numbers',
                        lines.numbers[k])
    return rows['ids'], rows['values']


def refuse_quaternions(path: object, quaternions: Array, numbers: list[int]) -> None:
    """Raise for the first of the quaternions (m, 4) whose norm is not 1; numbers : their lines."""
    far = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > QUATERNION_NORM_ERROR
    if far.any():
        k = int(np.argmax(far))
        raise FileError(path, f'quaternion {quaternions[k].tolist()}; expected one of norm 1',
                        numbers[k])


def _convert(texts: list[str], dtype: np.dtype) -> np.ndarray | None:
    """Return the rows as a structured array, or None if any of them is malformed."""
    end = _shared_end(texts, dtype['values'].shape[0])
    rows = _with_end(texts, end, dtype) if end else _numbers(texts, len(texts), dtype)
    # Written so that NaN fails, too.
    if rows is None or not (np.abs(rows['values']) <= LARGEST).all():
        return None
    return rows


def _shared_end(texts: list[str], most: int) -> list[str]:
    """
    Return the last fields, `most` at most, if all lines end alike in them, a space before each.

    Mostly that is the information matrix: half of what is to be read.
    """
    if not texts:
        return []
    first, last = texts[0].split(), texts[-1].split()
    count = 0
    while count < min(most, len(first), len(last)) and first[-1 - count] == last[-1 - count]:
        count += 1
    end = first[len(first) - count:]
    tail = _tail(end)
    # What follows a `#` is no number, but it may look like one.
    alike = count > 0 and all(text.endswith(tail) and '#' not in text for text in texts)
    return end if alike else []


def _tail(end: list[str]) -> str:
    return ''.join(f' {field}' for field in end)


def _with_end(texts: list[str], end: list[str], dtype: np.dtype) -> np.ndarray | None:
    """Return the rows of lines that end alike; the end is converted once."""
    before = dtype['values'].shape[0] - len(end)
    short = np.dtype([('ids', dtype['ids']), ('values', np.float64, (before,))])
    length = len(_tail(end))
    begins = _numbers((text[:-length] for text in texts), len(texts), short)
    shared = _numbers([_tail(end)], 1, np.dtype([('values', np.float64, (len(end),))]))
    if begins is None or shared is None:
        return None
    rows = np.empty(len(texts), dtype)
    rows['ids'] = begins['ids']
    rows['values'][:, :before] = begins['values']
    rows['values'][:, before:] = shared['values']
    return rows


def _numbers(texts: Iterable[str], count: int, dtype: np.dtype) -> np.ndarray | None:
    """Return `count` rows as a structured array, or None if any of them has other fields."""
    if not count:
        return np.empty(0, dtype)
    with warnings.catch_warnings():
        # NumPy only warns about missing data and, before 2.0, about an id such as 1.5.
        warnings.simplefilter('error')
        try:
            rows: np.ndarray = np.loadtxt(texts, dtype, ndmin=1, encoding=None)
        except (ValueError, Warning):
            return None
    # `loadtxt` skips rows without any field.
    return rows if len(rows) == count else None


def _complaint(text: str, ids: int, values: int) -> str:
    """Say what is wrong with one line."""
    fields = text.split('#', 1)[0].split()
    if len(fields) != ids + values:
        return counted(len(fields), 'field')
    for field in fields[:ids]:
        if _numbers([field], 1, np.dtype([('values', np.int64, (1,))])) is None:
            return f'{quoted(field)} is not a whole number of 64 bits'
    for field in fields[ids:]:
        number = _numbers([field], 1, np.dtype([('values', np.float64, (1,))]))
        if number is None or not np.isfinite(number['values']).all():
            return f'{quoted(field)} is not a finite number'
        if np.abs(number['values']) > LARGEST:
            return f'{quoted(field)} is beyond {LARGEST:g}'
    return f'{quoted(text)} is not understood'
