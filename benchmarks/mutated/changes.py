# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Damage to files: to their bytes, numbers, fields, lines, cells of databases, messages."""

import bz2
import gzip
import json
import re
import sqlite3
import struct
from base64 import b64decode, b64encode
from collections.abc import Callable
from contextlib import closing, suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import cbor2
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import Writer as Rosbag1Writer

EXTREMES = (
    b'nan inf -inf 1e308 -1e308 1e-320 1e400 -0 0 1 -1 1e30 1e29 1e15 1e-30 9223372036854775807 '
    b'9223372036854775808 -9223372036854775809 18446744073709551616 4294967296 2147483648 '
    b'99999999999999999999999 1000000000 0x10 1_000 null true [] {} "" x - \xd9\xa3 \xff').split()
TAGS = (b'VERTEX_SE2 EDGE_SE2 EDGE_PRIOR_SE2 EDGE_PRIOR_SE2_XY VERTEX_SE3:QUAT EDGE_SE3:QUAT '
        b'EDGE_SE3_PRIOR EDGE_SE3_XYZPRIOR EDGE_SE3_PRIORXY EDGE_SE2_SWITCHABLE VERTEX3 EDGE3 '
        b'VERTEX2 EDGE2 EQUIV PARAMS_SE3OFFSET FIX VERTEX_XY FLASER ROBOTLASER1 #L1SLAM # '
        b'slip rejected suspect EDGE_NEW').split()
BINARY = (*(struct.pack('<d', value) for value in (np.nan, 1e308, -np.inf, 0.0, 1e15)),
          *(struct.pack('<q', value) for value in (2**63 - 1, -2**63)),
          *(struct.pack('<I', value) for value in (2**32 - 1, 2**31, 10**8, 0)), b'\xff\xff')
CELLS = (None, 0, -1, 2**63 - 1, -2**63, 1e308, 'nan', '', 'x' * 5000, b'', b'\xff' * 100,
         'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped', '/odom', '/loop_closures')
_NUMBER = re.compile(rb'(?<![\w.])-?\d[\d.]*(?:e[+-]?\d+)?')
_FIELD = re.compile(rb'[^\s,\[\]{}:]+')
_ARRAY = re.compile(rb'(?m)^(#L1SLAM \S+ )([<>|][a-z]\d) (\S*)$')
Random = np.random.Generator


def mutate(path: Path, rng: Random, sound: Path) -> None:
    """Damage a file in place; sound : a folder of files, of which another may be spliced in."""
    if path.suffix == '.db3' and rng.random() < 0.6:
        _cells(path, rng)
        return
    if path.suffix == '.bag' and rng.random() < 0.6:
        _ros1(path, rng)
        return
    content = path.read_bytes()
    if path.suffix == '.cbor' and rng.random() < 0.7:
        with suppress(ValueError):
            text = _damaged(json.dumps(cbor2.loads(content)).encode(), rng, sound)
            content = cbor2.dumps(json.loads(text))
        path.write_bytes(content)
        return
    if '.mcap' in path.name and rng.random() < 0.6:
        packed = path.suffix == '.zstd'
        unpack = zstandard.ZstdDecompressor().decompressobj().decompress
        made = _mcap(unpack(content) if packed else content, rng)
        path.write_bytes(zstandard.compress(made) if packed else made)
        return
    for suffix, library in (('.gz', gzip), ('.bz2', bz2)):
        if path.suffix == suffix and rng.random() < 0.7:
            inner = _damaged(library.decompress(content), rng, sound)
            if rng.random() < 0.1:  # packs as nothing does
                inner += b'0 ' * int(10 ** rng.uniform(3, 7.5))
            path.write_bytes(library.compress(inner, 1))
            return
    proven = b'\n#L1SLAM sha256' in content
    if proven and rng.random() < 0.9:  # a saved map whose checksum proves wrong contents
        kept = content[:content.rindex(b'#L1SLAM sha256')]
        damaged = _array(kept, rng) if rng.random() < 0.5 else _damaged(kept, rng, sound)
        digest = sha256(damaged).hexdigest()
        path.write_bytes(damaged + f'#L1SLAM sha256 {digest}\n'.encode())
        return
    path.write_bytes(_damaged(content, rng, sound))


def _messages(recording: list[tuple], rng: Random) -> list[tuple]:
    """Return messages (source, stamp [ns], bytes) of a recording, some of them damaged."""
    found = list(recording)
    for _ in range(rng.integers(1, 20) if rng.random() < 0.5 else len(found)):
        if not found:
            break
        k = int(rng.integers(len(found)))
        source, stamp, data = found[k]
        way = rng.integers(6)
        if way == 0:
            stamp = int(rng.choice([0, 2**62, stamp + 10**12, 1]))
        elif way == 1:
            del found[k]
            continue
        elif way == 2:
            found.append(found[k])
        else:
            data = data[:4] + (_binary if rng.random() < 0.8 else _bytes)(data[4:], rng)
        found[k] = source, stamp, data
    return found


def _mcap(content: bytes, rng: Random) -> bytes:
    """Write the messages of an MCAP file anew, some of them damaged and all checksums right."""
    recording = [((schema.name, schema.data, channel.topic), message.log_time, message.data)
                 for schema, channel, message in make_reader(BytesIO(content)).iter_messages()]
    notes = list(make_reader(BytesIO(content)).iter_metadata())
    file = BytesIO()
    writer = McapWriter(file)
    writer.start('ros2', 'damaged')
    for note in notes:
        writer.add_metadata(note.name, note.metadata)
    known: dict[tuple, int] = {}
    for source, stamp, data in _messages(recording, rng):
        if source not in known:
            name, text, topic = source
            if rng.random() < 0.05:
                text = _damaged(text, rng, Path())
            known[source] = writer.register_channel(
                topic, 'cdr', writer.register_schema(name, 'ros2msg', text))
        writer.add_message(known[source], stamp, data, stamp)
    writer.finish()
    return file.getvalue()


def _ros1(path: Path, rng: Random) -> None:
    """Write the messages of a bag of ROS 1 anew, with some of them damaged."""
    with Rosbag1Reader(path) as reader:
        recording = [(one, stamp, bytes(data)) for one, stamp, data in reader.messages()]
    path.unlink()
    known = {}
    with Rosbag1Writer(path) as writer:
        for one, stamp, data in _messages(recording, rng):
            if one.id not in known:
                known[one.id] = writer.add_connection(
                    one.topic, one.msgtype, msgdef=one.msgdef.data, md5sum=one.digest)
            writer.write(known[one.id], min(stamp, 2**31 * 10**9), data)


def _damaged(content: bytes, rng: Random, sound: Path) -> bytes:
    is_text = b'\0' not in content[:2000]
    ways: tuple[Callable[[bytes, Random], bytes], ...] = (
        (_numbers, _numbers, _numbers, _fields, _lines, _ranges, _bytes) if is_text
        else (_binary, _binary, _bytes, _ranges))
    if is_text and rng.random() < 0.4:  # of which most is read
        return _numbers(content, rng, 1.0)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        content = ways[rng.integers(len(ways))](content, rng)
    if sound != Path() and rng.random() < 0.06:
        others = sorted(path for path in sound.rglob('*') if path.is_file())
        other = others[rng.integers(len(others))].read_bytes()
        content = content[:_place(content, rng)] + other[_place(other, rng):]
    return content


def _place(content: bytes, rng: Random) -> int:
    return int(rng.integers(len(content) + 1))


def _bytes(content: bytes, rng: Random) -> bytes:
    found = bytearray(content)
    for _ in range(rng.integers(1, 12) if found else 0):
        k = rng.integers(len(found))
        found[k] = rng.integers(256) if rng.random() < 0.5 else found[k] ^ 1 << rng.integers(8)
    return bytes(found)


def _binary(content: bytes, rng: Random) -> bytes:
    for _ in range(rng.integers(1, 8)):
        new = BINARY[rng.integers(len(BINARY))]
        k = _place(content, rng) & ~3
        content = content[:k] + new + content[k + len(new):]
    return content


def _ranges(content: bytes, rng: Random) -> bytes:
    """Cut off the end, or remove, repeat, or swap parts."""
    a, b, c = sorted(_place(content, rng) for _ in range(3))
    return (content[:c], content[:b] + content[c:], content[:a] + content[b:a + 200 + b] +
            content[b:c] + content[a:b] + content[c:], content[:a] + content[a:a + 300] *
            int(10 ** rng.uniform(0, 3)) + content[a:])[rng.integers(4)]


def _replaced(pattern: re.Pattern[bytes], content: bytes, rng: Random,
              new: Callable[[bytes], bytes]) -> bytes:
    """Replace a few matches, or one match of each of many lines, of a pattern."""
    found = list(pattern.finditer(content))
    if not found:
        return content
    chosen = {int(k) for k in rng.integers(len(found), size=rng.choice([1, 1, 2, 5]))}
    if rng.random() < 0.1:
        chosen = set(range(int(rng.integers(len(found))), len(found), int(rng.integers(1, 13))))
    parts, end = [], 0
    for k in sorted(chosen):
        parts += content[end:found[k].start()], new(found[k][0])
        end = found[k].end()
    return b''.join((*parts, content[end:]))


def _numbers(content: bytes, rng: Random, sound: float = 0.5) -> bytes:
    """Replace numbers; sound : the share of those that remain what they are, ids or decimals."""
    same = EXTREMES[rng.integers(len(EXTREMES))]
    scale = 10 ** rng.uniform(-9, 9)

    def new(old: bytes) -> bytes:
        with suppress(ValueError):
            if old.isdigit() and rng.random() < sound:  # of a vertex, a count
                return b'%d' % rng.integers(40)
            if rng.random() < sound:
                return repr(float(old) * (scale, -1, 0, 1 / scale)[rng.integers(4)]).encode()
        return same if rng.random() < 0.7 else EXTREMES[rng.integers(len(EXTREMES))]

    return _replaced(_NUMBER, content, rng, new)


def _fields(content: bytes, rng: Random) -> bytes:
    words = _FIELD.findall(content) or [b'']

    def new(old: bytes) -> bytes:
        return (b'', old + b' ' + old, words[rng.integers(len(words))], old[::-1], old * 3000,
                TAGS[rng.integers(len(TAGS))], EXTREMES[rng.integers(len(EXTREMES))]
                )[rng.integers(7)]

    return _replaced(_FIELD, content, rng, new)


def _lines(content: bytes, rng: Random) -> bytes:
    lines = content.split(b'\n')
    k, j = rng.integers(len(lines), size=2)
    made = b' '.join((TAGS[rng.integers(len(TAGS))], *(
        EXTREMES[rng.integers(len(EXTREMES))] if rng.random() < 0.3 else b'%d' % rng.integers(50)
        for _ in range(rng.integers(32)))))
    way = rng.integers(6)
    if way == 0:
        rng.shuffle(lines)
    elif way == 1:
        del lines[k:k + int(rng.integers(1, 20))]
    elif way == 2:
        lines[k], lines[j] = lines[j], lines[k]
    elif way == 3:
        lines.insert(k, lines[j])
    else:
        lines.insert(k, made)
    return b'\n'.join(lines)


def _array(content: bytes, rng: Random) -> bytes:
    """Damage the numbers of an array of a saved map, or how many there are."""
    def new(old: bytes) -> bytes:
        begin, kind, text = _ARRAY.fullmatch(old).groups()
        numbers = b64decode(text)
        values = np.frombuffer(numbers, kind.decode()).copy()
        way = rng.integers(4)
        if way == 0 or not len(values):
            values = np.repeat(values[:len(values) // 2], rng.integers(4))
        elif way == 1:
            values[:] = 0
        else:
            rows = rng.integers(len(values), size=rng.integers(1, 5))
            with np.errstate(all='ignore'):
                values[rows] = np.array(rng.choice(
                    [np.nan, np.inf, -1e308, 1e29, 0, -1, 1, 2**31, 2**62, 1e-300, 7])).astype(
                        values.dtype)
        return begin + kind + b' ' + b64encode(values.tobytes())

    return _replaced(_ARRAY, content, rng, new)


def _cells(path: Path, rng: Random) -> None:
    """Replace cells of a database, or drop or rename what is in it."""
    with closing(sqlite3.connect(path)) as database, suppress(sqlite3.Error, ValueError):
        tables = [row[0] for row in database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table'")]
        for _ in range(rng.integers(1, 4)):
            table = tables[rng.integers(len(tables))]
            columns = [row[1] for row in database.execute(f'PRAGMA table_info({table})')]
            if not columns:  # dropped
                continue
            column = columns[rng.integers(len(columns))]
            value = CELLS[rng.integers(len(CELLS))]
            every = int(rng.choice([1, 2, 17, 40]))
            way = rng.random()
            with suppress(sqlite3.Error, OverflowError, TypeError):
                if way < 0.05:
                    database.execute(f'DROP TABLE {table}')
                elif way < 0.1:
                    database.execute(f'ALTER TABLE {table} DROP COLUMN {column}')
                elif way < 0.2:
                    database.execute(f'DELETE FROM {table} WHERE rowid % ? = 0', (every,))
                elif way < 0.35 and table == 'messages':
                    rows = database.execute('SELECT rowid, data FROM messages').fetchall()
                    for row, data in rows[::every]:
                        database.execute('UPDATE messages SET data = ? WHERE rowid = ?',
                                         (data[:4] + _binary(data[4:], rng), row))
                else:
                    database.execute(f'UPDATE {table} SET {column} = ? WHERE rowid % ? = 0',
                                     (value, every))
        database.commit()
