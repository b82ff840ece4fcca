# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Functions for text files: read their lines, write a file whole or not at all."""

import os
import secrets
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain, count, islice
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.geometry.manifold import Array, Indices
from l1slam_ros.io.bounded import read_text
from l1slam_ros.io.remarks import Remarks, read_remarks

NANOSECONDS = 10**9
# [ns] builtin_interfaces/Time holds its seconds in 32 bits.
LAST_STAMP = 2**31 * NANOSECONDS - 1
# Largest absolute value that is read: no pose or information exceeds it, and squares stay finite.
LARGEST = 1e30
# Largest number of characters of a file that are quoted in an error.
_QUOTED = 40
# Number of lines that are formatted, or written, at once.
_AT_ONCE = 500


@dataclass(frozen=True)
class TextLines:
    """
    The lines of a file without comments: their numbers, from 1, and their texts.

    remarks : the state of a saved map, see `remarks.py`; comments : number and text of each
    comment line.
    """

    numbers: list[int]
    texts: list[str]
    remarks: Remarks = None
    comments: tuple[tuple[int, str], ...] = ()


@contextmanager
def reported(path: object, done: str = 'written') -> Iterator[None]:
    """Turn an OSError of the block into a FileError: `path` cannot be written (or read, ...)."""
    try:
        yield
    except OSError as error:
        raise FileError(path, f'cannot be {done}: {error.strerror or error}') from error


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Yield a temporary neighbour of `path`; it takes the place of `path` when the block succeeds.

    A link stays a link: what it leads to is replaced.

    Raises
    ------
    FileError : `path` cannot be written; it is then unchanged, as after any other error.

    """
    target = Path(os.path.realpath(path))
    if kind := other_kind(target):
        raise FileError(path, f'cannot be written: it is {kind}')
    # Not `tempfile`, whose files only their owner may read, whatever the umask is.
    temporary = target.parent / f'.{target.name}.{secrets.token_hex(4)}.tmp'
    try:
        with reported(path):
            yield temporary
            os.replace(temporary, target)
            sync_folder(target.parent)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def new_folder_beside(target: Path) -> Iterator[Path]:
    """Yield a new temporary folder beside `target`; it is removed with its content in the end."""
    with TemporaryDirectory('.tmp', f'.{target.name}.', target.absolute().parent,
                            ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def dated_names(path: Path, of: Path) -> Iterator[Path]:
    """Yield names like `of`, with the time of the last change of `path`, then a number, too."""
    name = f'{of.stem}.{time.strftime("%Y-%m-%dT%H-%M-%S", time.localtime(path.stat().st_mtime))}'
    yield of.with_name(f'{name}{of.suffix}')
    for number in count(2):
        yield of.with_name(f'{name}.{number}{of.suffix}')


def sync_folder(folder: Path) -> None:
    """Flush the renames in a folder to the disk, if its file system supports that."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def require_folder(path: str | os.PathLike[str]) -> None:
    """Check, before any work is done, that the folder of `path` exists and can be written to."""
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise FileError(path, f'cannot be written: {folder} is no folder')
    with reported(path), TemporaryFile(dir=folder):
        pass


def require_file(path: str | os.PathLike[str]) -> None:
    """Check, before any work is done, that a file can be written to `path`."""
    require_folder(path)
    if kind := other_kind(path):
        raise FileError(path, f'cannot be written: it is {kind}')


def other_kind(path: str | os.PathLike[str]) -> str:
    """Return what `path` is if it exists and is not a regular file, in words; else nothing."""
    # Not the functions of `Path`: they raise if a name is too long.
    if os.path.isfile(path) or not os.path.exists(path):
        return ''
    return 'a directory' if os.path.isdir(path) else 'not a regular file'


def put_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines to a file, add a newline to each, and flush the file to the disk."""
    with path.open('w', encoding='utf-8') as file:
        left = iter(lines)
        while many := list(islice(left, _AT_ONCE)):
            file.write('\n'.join([*many, '']))
        file.flush()
        # Without this, a power cut just after the file is renamed could leave it empty.
        os.fsync(file.fileno())


def formatted(line: str, *columns: np.ndarray) -> list[str]:
    """
    Return `line % row` for each row of the tables (m, k), put side by side; many lines a string.

    To format many lines at once takes a third less time than one by one. A larger number would
    hold Python's lock for too long.
    """
    texts = []
    for k in range(0, len(columns[0]), _AT_ONCE):
        part = [column.tolist() for table in columns for column in table[k:k + _AT_ONCE].T]
        rows = zip(*part, strict=True)
        texts.append('\n'.join([line] * len(part[0])) % tuple(chain.from_iterable(rows)))
    return texts


def write_lines(path: str | os.PathLike[str], lines: Iterable[str]) -> None:
    """
    Write a text file, whole or not at all.

    Raises
    ------
    FileError : the file cannot be written.

    """
    with replacing(path) as temporary:
        put_lines(temporary, lines)


def read_lines(path: str | os.PathLike[str]) -> TextLines:
    """
    Return the lines of a text file without blank lines; `#` comments are returned separately.

    Raises
    ------
    FileError : the file cannot be read, is not text, or is a saved map that is damaged.

    """
    with reported(path, 'read'):
        content = read_text(Path(path))
    try:
        remarks = read_remarks(path, content)
        text = content.decode('utf-8-sig').replace('\r\n', '\n').replace('\r', '\n')
    except UnicodeDecodeError as error:
        found = f'byte 0x{error.object[error.start]:02x} at offset {error.start}'
        raise FileError(path, f'{found}; expected a text file') from error
    lines = text.split('\n')
    blank = [k for k, line in enumerate(lines) if not line or line.isspace()]
    comments = [k for k, line in enumerate(lines) if '#' in line and line.lstrip()[0] == '#']
    numbers: list[int] = []
    kept: list[str] = []
    begin = 0
    for k in [*sorted({*blank, *comments}), len(lines)]:
        numbers += range(begin + 1, k + 1)
        kept += lines[begin:k]
        begin = k + 1
    return TextLines(numbers, kept, remarks, tuple((k + 1, lines[k]) for k in comments))


def counted(count: int, noun: str, plural: str = '') -> str:
    """Return e.g. `1 loop` or `1,837 loops`; plural : of the noun, if not formed with an s."""
    return f'{count:,} {noun if count == 1 else plural or noun + "s"}'


def quoted(text: str) -> str:
    """Return a piece of a file as it is quoted in errors: printable, on one line, shortened."""
    return repr(text if len(text) <= _QUOTED else text[:_QUOTED] + '...')


def first_failure(count: int, works: Callable[[slice], bool]) -> int:
    """Return the first of `count` rows that fails, by bisection; `works` tests a slice."""
    low = 0
    high = count
    while high - low > 1:
        middle = (low + high) // 2
        if works(slice(low, middle)):
            low = middle
        else:
            high = middle
    return low


def invented_stamps(n: int) -> Indices:
    """Return stamps [ns], (n,), for poses without stamps: ten poses a second from 1000 s on."""
    return 1000 * NANOSECONDS + np.arange(n, dtype=np.int64) * (NANOSECONDS // 10)


def stamp_text(stamp: int) -> str:
    """Return a stamp [ns] as seconds with nine decimals, exactly."""
    seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
    return f'{seconds}.{nanoseconds:09d}'


def stamp_from_text(text: str) -> int:
    """
    Return the stamp [ns] of a decimal number of seconds, exact to the nanosecond.

    Raises
    ------
    ValueError : the text is not a number, or its nanoseconds do not fit into 64 bits.

    """
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(text) from error
    if not (seconds.is_finite() and 0 <= seconds < 2**63 // NANOSECONDS):
        raise ValueError(text)
    return int((seconds * NANOSECONDS).to_integral_value())


def rounded(values: Array) -> Array:
    """
    Round each value to 15 decimal digits if that changes it by rounding errors only.

    For computed numbers: the square of a square root turns 50 into 50.00000000000001.
    """
    magnitude = np.abs(np.where(values == 0.0, 1.0, values))
    # Powers up to 10^22 are exact, so the quotient is the double nearest to the decimal.
    places = np.clip(14 - np.floor(np.log10(magnitude)), 0, 22).astype(int)
    scale = np.array([float(f'1e{k}') for k in range(23)])[places]
    decimal = np.rint(values * scale) / scale
    return np.where(np.abs(decimal - values) <= 4 * np.spacing(magnitude), decimal, values)
