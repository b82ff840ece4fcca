# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Rows read leaf by leaf are those that SQLite gives."""

import sqlite3

import pytest

from l1slam_ros.io.bags.damaged.walk_sqlite import is_cut, leaf_rows

SIZES = [0, 1, 40, 430, 470, 480, 490, 900, 1000, 5_000, 70_000]
NUMBERS = [0, 1, -1, 127, 128, -129, 2**15, -2**23, 2**31, 2**40, -2**47, 2**62]


def database(path, page_size, count, rng):
    """Write tables as rosbag2 does; return what SQLite says is in them."""
    connection = sqlite3.connect(path)
    connection.execute(f'PRAGMA page_size = {page_size}')
    connection.executescript("""
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, format TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                              data BLOB);
        CREATE INDEX timestamp_idx ON messages (timestamp ASC);
        INSERT INTO topics VALUES(1, '/a', 'b', 'cdr'), (2, '/b', 'b', 'cdr');
    """)
    for k in range(count):
        connection.execute('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)', (
            k % 300, NUMBERS[k % len(NUMBERS)], rng.bytes(SIZES[k % len(SIZES)])))
    connection.commit()
    rows = list(connection.execute('SELECT topic_id, timestamp, data FROM messages ORDER BY id'))
    connection.close()
    return rows


@pytest.mark.parametrize('page_size', [512, 1024, 4096, 65536])
def test_all_rows_of_all_sizes(tmp_path, rng, page_size):
    rows = database(tmp_path / 'a.db3', page_size, 300, rng)
    assert list(leaf_rows(tmp_path / 'a.db3')) == rows
    assert not is_cut(tmp_path / 'a.db3')


def test_of_a_cut_database_the_rows_that_are_all_there(tmp_path, rng):
    rows = database(tmp_path / 'a.db3', 512, 300, rng)
    whole = (tmp_path / 'a.db3').read_bytes()
    path = tmp_path / 'cut.db3'
    counts = []
    for cut in range(10_000, len(whole), len(whole) // 9):
        path.write_bytes(whole[:cut])
        assert is_cut(path)
        found = list(leaf_rows(path))
        counts.append(len(found))
        assert found == rows[:len(found)]
    assert counts == sorted(counts) and counts[0] < 30 and counts[-1] > 250
    path.write_bytes(whole[:-1])
    assert is_cut(path)
