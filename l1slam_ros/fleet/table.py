# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The table of a batch: a row for each recording, nothing in it depends on time, place or order.

In: rows, values by the names of columns. Out: the same as CSV and, where pyarrow is installed, as
parquet; bytes, to be written by whoever asked.
"""

import csv
import io
from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

# Names and types, of Python; what a row does not say is empty.
COLUMNS: dict[str, type] = {
    'recording': str, 'status': str, 'exit_code': int, 'poses': int, 'factors': int, 'loops': int,
    'rejected': int, 'suspect': int, 'slips': int, 'parts': int, 'initial_cost': float,
    'final_cost': float, 'sentence': str, 'map': str}

Row = dict[str, Any]


def as_csv(rows: Iterable[Row]) -> bytes:
    """Return rows as CSV in UTF-8, the names of the columns first."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(['' if row.get(name) is None else _printed(row[name])
                         for name in COLUMNS])
    return text.getvalue().encode()


def as_parquet(rows: list[Row]) -> bytes | None:
    """Return rows as parquet; None where pyarrow is not installed."""
    if find_spec('pyarrow') is None:
        return None
    import pyarrow
    import pyarrow.parquet

    types = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    table = pyarrow.table({
        name: pyarrow.array([None if row.get(name) is None else _printed(row[name])
                             for row in rows], types[kind])
        for name, kind in COLUMNS.items()})
    buffer = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table, buffer)
    content: bytes = buffer.getvalue().to_pybytes()
    return content


def _printed(value: Any) -> Any:
    """Return a value such that it can be written: names of files may be no text."""
    return value.encode('utf-8', 'backslashreplace').decode() if isinstance(value, str) else value
