# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The state of a saved map that graph formats have no tag for, as lines that are comments to others.

    ... #L1SLAM map 3           at the end of the first line: the version. It has no line of its
                                own, because GTSAM reads no edge behind a comment
    #L1SLAM <name> <JSON>       a value; a value with many rows continues in lines of this name
    #L1SLAM <name> <f8 <Base64> the numbers of an array of NumPy's type `<f8`; may be continued
    #L1SLAM sha256 <digest>     the last line: checksum of all bytes before it

Arrays are in Base64, because writing numbers as text would take most of the time of a save.
"""

import json
from base64 import b64decode, b64encode
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from itertools import chain
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError

# Name -> value; none where a file is no saved map.
Remarks = Mapping[str, Any] | None

KEYWORD = '#L1SLAM '
_FIRST = f' {KEYWORD}map 3'
_FIRST_OF_2 = f'{KEYWORD}map 2'
_PROOF = f'{KEYWORD}sha256 '
_LAST = len(_PROOF) + 2 * sha256().digest_size + 1  # bytes of the last line
# Rows to a line: readers whose lines have an end get through, and other threads their turn.
_AT_ONCE = 500
# [characters] So many are hashed and written at once. Both let go of the interpreter's lock, and
# to get it back from threads that are busy may take longer than the work.
_ENOUGH = 2**20


def with_remarks(lines: Iterable[str], values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a file with some values and its checksum, many to a string."""
    digest = sha256()
    for text in _together(_unproven(lines, values)):
        digest.update(f'{text}\n'.encode())
        yield text
    yield f'{_PROOF}{digest.hexdigest()}'


def _together(lines: Iterable[str]) -> Iterator[str]:
    some: list[str] = []
    size = 0
    for line in lines:
        some.append(line)
        size += len(line)
        if size > _ENOUGH:
            yield '\n'.join(some)
            some = []
            size = 0
    yield '\n'.join(some)


def _unproven(lines: Iterable[str], values: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines and values: arrays, or what JSON knows."""
    graph = iter(lines)
    first, newline, rest = next(graph).partition('\n')
    yield f'{first}{_FIRST}{newline}{rest}'
    yield from graph
    for name, value in values.items():
        parts = [value]
        if isinstance(value, np.ndarray | list):
            parts = [value[k : k + _AT_ONCE] for k in range(0, max(len(value), 1), _AT_ONCE)]
        for part in parts:
            yield f'{KEYWORD}{name} ' + (
                f'{part.dtype.str} {b64encode(part.tobytes()).decode()}'
                if isinstance(part, np.ndarray) else json.dumps(part, separators=(',', ':')))


def is_proven(path: object, content: bytes) -> bool:
    """
    Tell whether a file is a saved map.

    Raises
    ------
    FileError : it was one, and is not as it was written.

    """
    first = content[: content.find(b'\n')]
    last = content[-_LAST:]
    if KEYWORD.encode() not in first and not last.startswith(_PROOF.encode()):
        return False
    if last != f'{_PROOF}{sha256(memoryview(content)[:-_LAST]).hexdigest()}\n'.encode():
        raise FileError(path, 'is damaged: its last line is not the checksum of those before; '
                        'expected a saved map as it was written')
    if not first.endswith(_FIRST.encode()) and first != _FIRST_OF_2.encode():
        raise FileError(path, 'is a saved map of another version; expected one that says '
                        f'{_FIRST.strip()!r}', 1)
    return True


def read_remarks(path: object, content: bytes) -> Remarks:
    """
    Return what a saved map says.

    Raises
    ------
    FileError : it was one, and is not as it was written, or a value cannot be read.

    """
    if not is_proven(path, content):
        return None
    parts: dict[str, list[Any]] = {}
    with wrong_contents(path):
        *lines, _ = (line.split(' ', 2)[1:] for line in content.decode().split('\n')
                     if line.startswith(KEYWORD) and line != _FIRST_OF_2)
        for name, text in lines:
            parts.setdefault(name, []).append(_value(text))
        return {name: _joined(of_name) for name, of_name in parts.items()}


@contextmanager
def wrong_contents(path: object) -> Iterator[None]:
    """
    Turn what the values of a saved map raise into a FileError: its checksum proves no contents.

    Raises
    ------
    FileError : in place of another error of the block, except of those that it raises on purpose.

    """
    try:
        with np.errstate(invalid='raise'):  # no whole number is made of NaN
            yield
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError,
            ValueError) as error:
        missing = isinstance(error, KeyError)
        what = f'there is no value {error}' if missing else ' '.join(str(error).split())
        raise FileError(path, f'is a saved map with wrong contents: {what}') from error


def _joined(parts: list[Any]) -> Any:
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    return list(chain(*parts)) if isinstance(parts[0], list) else parts[0]


def _value(text: str) -> Any:
    kind, _, numbers = text.partition(' ')
    # As no JSON does, a type begins with the order of its bytes.
    return np.frombuffer(b64decode(numbers), kind) if kind[0] in '<>|' else json.loads(text)
