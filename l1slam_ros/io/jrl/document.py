# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Reading JSON or CBOR from others within limits; each value knows its place, for errors.

The place of a value is its path, as in `measurements.a[3].stamp`.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from l1slam_ros.core.errors import FileError, optional_libraries
from l1slam_ros.io.bounded import read_bytes, unpacked_name
from l1slam_ros.io.files import LARGEST, counted, quoted, reported

# [bytes] Of a graph of half a million factors. Python takes thirty times as much at worst.
_LARGEST_FILE = 2**29
_DEEPEST = 64
# These tags stand for other values, or refer to each other: a few bytes may expand for hours.
_TAGS = range(2**9)
CBOR_SUFFIX = '.cbor'


class Node:
    """
    A value of a document, and its place.

    Attributes
    ----------
    value : what JSON knows

    """

    __slots__ = ('value', '_above', '_name')

    def __init__(self, value: Any, above: 'Node | Path', name: str | int = ''):
        self.value = value
        self._above, self._name = above, name

    def refuse(self, expected: str) -> NoReturn:
        """Raise a FileError that names the file, the place, what was found and expected."""
        place = ''
        node = self
        while isinstance(node._above, Node):
            step = f'[{node._name}]' if isinstance(node._name, int) else (
                f'.{quoted(node._name)[1:-1]}')
            place = step + place
            node = node._above
        where = f'{place.removeprefix(".")}: ' if place else ''
        raise FileError(node._above, f'{where}{_described(self.value)}; expected {expected}')

    def members(self) -> Iterator[tuple[str, 'Node']]:
        """Yield names and values of an object; none for null, as an empty object is written."""
        if self.value is not None and not isinstance(self.value, dict):
            self.refuse('an object')
        for name, value in (self.value or {}).items():
            if not isinstance(name, str):
                self.refuse('names that are texts')
            yield name, Node(value, self, name)

    def elements(self) -> Iterator['Node']:
        """Yield the values of a list; none for null, as an empty list is written."""
        if self.value is not None and not isinstance(self.value, list):
            self.refuse('a list')
        for k, value in enumerate(self.value or ()):
            yield Node(value, self, k)

    def find(self, name: str) -> 'Node | None':
        """Return a member of an object, or None if there is none of this name."""
        if not isinstance(self.value, dict):
            self.refuse(f'an object with {quoted(name)}')
        return Node(self.value[name], self, name) if name in self.value else None

    def __getitem__(self, name: str) -> 'Node':
        """Return a member of an object; raise if there is none of this name."""
        node = self.find(name)
        if node is None:
            Node(None, self, name).refuse('a value')
        return node

    def text(self) -> str:
        """Return a text."""
        if not isinstance(self.value, str):
            self.refuse('a text')
        return str(self.value)

    def whole(self) -> int:
        """Return a whole number of 63 bits."""
        if type(self.value) is not int or not 0 <= self.value < 2**63:
            self.refuse('a whole number from 0 to 2^63 - 1')
        return self.value

    def number(self) -> float:
        """Return a finite number, none beyond 1e30."""
        # Written so that NaN fails, too; True is of another type.
        if type(self.value) not in (int, float) or not -LARGEST <= self.value <= LARGEST:
            self.refuse(f'a number within {LARGEST:g}')
        return float(self.value)

    def numbers(self, count: int) -> list[float]:
        """Return a list of `count` numbers."""
        if not isinstance(self.value, list) or len(self.value) != count:
            self.refuse(f'a list of {count} numbers')
        return [node.number() for node in self.elements()]


def read_document(path: Path) -> Node:
    """
    Return what a file of JSON says, or one of CBOR where its name ends in `.cbor`.

    Raises
    ------
    FileError : it cannot be read, is too large or nested too deeply, or is no such document.
    MissingError : the library that reads CBOR is not installed.

    """
    with reported(path, 'read'):
        content = read_bytes(path, _LARGEST_FILE)
    return Node((_from_cbor if is_cbor(path) else _from_json)(path, content), path)


def document_bytes(path: Path, value: Any) -> bytes:
    """Serialise a document for the file `path`; numbers are read back exactly."""
    if is_cbor(path):
        return bytes(cbor_library().dumps(value))
    return json.dumps(value, separators=(',', ':')).encode() + b'\n'


def is_cbor(path: Path) -> bool:
    """Tell whether a file is read as CBOR, by its name."""
    return unpacked_name(path).endswith(CBOR_SUFFIX)


def cbor_library() -> Any:
    """
    Return the library for CBOR.

    Raises
    ------
    MissingError : it is not installed.

    """
    with optional_libraries():
        import cbor2

    return cbor2


def _from_json(path: Path, content: bytes) -> Any:
    try:
        return json.loads(content.decode('utf-8-sig'))
    except json.JSONDecodeError as error:
        raise FileError(path, f'not JSON at column {error.colno}: {error.msg}; expected a JRL '
                        'document', error.lineno) from error
    except UnicodeDecodeError as error:
        found = f'byte 0x{error.object[error.start]:02x} at offset {error.start}'
        raise FileError(path, f'{found}; expected JSON') from error
    except ValueError as error:  # a number of thousands of digits
        raise FileError(path, 'a number with too many digits; expected JSON') from error
    except RecursionError as error:
        raise FileError(path, 'lists are nested too deeply; expected JSON at most '
                        f'{_DEEPEST} deep') from error


def _from_cbor(path: Path, content: bytes) -> Any:
    library = cbor_library()

    def refuse(_: object, *__: object) -> NoReturn:
        raise ValueError('a tag, which JSON does not have')

    try:
        return library.loads(content, tag_hook=refuse, max_depth=_DEEPEST,
                             allow_indefinite=False, strict_hashable_types=True,
                             semantic_decoders=dict.fromkeys(_TAGS, refuse))
    except (library.CBORDecodeError, ValueError, OverflowError) as error:
        cause = error.__cause__ or error
        raise FileError(path, f'not CBOR: {quoted(" ".join(str(cause).split()))}; expected a JRL '
                        'document') from error


def _described(value: Any) -> str:
    if isinstance(value, dict):
        return f'an object of {counted(len(value), "member")}'
    if isinstance(value, list):
        return f'a list of {len(value):,}'
    if value is None:
        return 'nothing'
    if isinstance(value, int) and abs(value) >= 2**64:  # may have a million digits
        return 'a number beyond 64 bits'
    if isinstance(value, float) and not math.isfinite(value):
        return 'a number that is not finite'
    return quoted(value) if isinstance(value, str) else quoted(repr(value))[1:-1]
