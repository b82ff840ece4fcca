# SPDX-License-Identifier: Apache-2.0
"""
What the text files of this package share: lines of numbers in, whole files out.

Numbers are converted in bulk, so a graph of 700,000 edges reads in seconds; only when a bulk
fails is its guilty line looked for, to be named.
"""

import os
import secrets
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError
from l1slam_ros.core.manifold import Array, Indices

NANOSECONDS = 10**9
# The longest piece of a damaged file that is quoted in an error.
_QUOTED = 40


@dataclass(frozen=True)
class TextLines:
    """Lines of a file: their numbers, from 1, and their texts."""

    numbers: list[int]
    texts: list[str]


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Yield a temporary neighbour of `path`; it takes the place of `path` when the block succeeds.

    Raises
    ------
    FileError : naming `path`; whatever goes wrong, `path` is then as it was before.

    """
    target = Path(path)
    # Not `tempfile`: its files are for their owner only, whatever the umask says.
    temporary = target.parent / f'.{target.name}.{secrets.token_hex(4)}.tmp'
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise FileError(path, f'cannot be written: {error.strerror or error}') from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def put_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines to a file of our own, onto the disk; each gets its newline here."""
    with path.open('w', encoding='utf-8') as file:
        file.writelines(f'{line}\n' for line in lines)
        file.flush()
        # Or a power cut just after the file is put in its place could leave it empty.
        os.fsync(file.fileno())


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
    Return the lines of a text file, blank ones and `#` comments left out.

    Raises
    ------
    FileError : the file cannot be read, or is no text.

    """
    try:
        text = Path(path).read_text(encoding='utf-8-sig')
    except OSError as error:
        raise FileError(path, f'cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        found = f'byte 0x{error.object[error.start]:02x} at offset {error.start}'
        raise FileError(path, f'{found}; expected a text file') from error
    kept = [(number, line) for number, line in enumerate(text.split('\n'), 1)
            if line and not line.isspace() and not line.lstrip().startswith('#')]
    return TextLines([number for number, _ in kept], [line for _, line in kept])


def quoted(text: str) -> str:
    """Return a piece of a file as an error quotes it: printable, on one line, not too long."""
    return repr(text if len(text) <= _QUOTED else text[:_QUOTED] + '...')


def parse_rows(
    path: object, name: str, lines: TextLines, ids: int, values: int
) -> tuple[Indices, Array]:
    """
    Convert lines of `ids` whole numbers followed by `values` finite numbers.

    Returns
    -------
    ids (m, ids) and values (m, values).

    Raises
    ------
    FileError : naming the first bad line; `name` says in it what the line should have been.

    """
    dtype = np.dtype([('ids', np.int64, (ids,)), ('values', np.float64, (values,))])
    rows = _convert(lines.texts, dtype)
    if rows is None:
        k = first_failure(len(lines.texts),
                          lambda part: _convert(lines.texts[part], dtype) is not None)
        found = _complaint(lines.texts[k], ids, values)
        expected = f'{ids} whole and {values} finite numbers'
        raise FileError(path, f'{name}: {found}; expected {expected}', lines.numbers[k])
    return rows['ids'], rows['values']


def first_failure(count: int, works: Callable[[slice], bool]) -> int:
    """Return the first of `count` rows that fails, by bisection; `works` judges a slice."""
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        if works(slice(low, middle)):
            low = middle
        else:
            high = middle
    return low


def stamp_text(stamp: int) -> str:
    """Return a stamp [ns] as seconds with nine decimals, exactly."""
    seconds, nanoseconds = divmod(int(stamp), NANOSECONDS)
    return f'{seconds}.{nanoseconds:09d}'


def stamp_from_text(text: str) -> int:
    """
    Return the stamp [ns] of a decimal number of seconds, rounded from its text, not from a float.

    Raises
    ------
    ValueError : no number of seconds that 64 bits of nanoseconds hold.

    """
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(text) from error
    if not (seconds.is_finite() and 0 <= seconds < 2**63 // NANOSECONDS):
        raise ValueError(text)
    return int((seconds * NANOSECONDS).to_integral_value())


def stamps_path(path: str | os.PathLike[str]) -> Path:
    """Return the name of the side file with the stamps of a graph file."""
    return Path(f'{os.fspath(path)}.stamps.txt')


def write_stamps(path: Path, ids: Indices, stamps: Indices) -> None:
    """
    Write the stamp [ns] of each vertex, `id seconds`: ids, stamps (n,).

    Raises
    ------
    FileError : the file cannot be written.

    """
    write_lines(path, (f'{k} {stamp_text(stamp)}' for k, stamp
                       in zip(ids.tolist(), stamps.tolist(), strict=True)))


def read_stamps(path: Path, ids: Indices) -> Indices | None:
    """
    Return the stamps [ns] of the vertices `ids` (n,), or None where there is no such file.

    Raises
    ------
    FileError : the file is damaged, or is not about these vertices.

    """
    if not path.exists():
        return None
    lines = read_lines(path)
    stamp_of = {}
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        try:
            name, stamp = text.split()
            stamp_of[int(name)] = stamp_from_text(stamp)
        except ValueError as error:
            raise FileError(path, f'{quoted(text)}; expected a vertex id and seconds',
                            number) from error
    if len(lines.texts) != len(ids) or stamp_of.keys() != set(ids.tolist()):
        raise FileError(path, f'{len(lines.texts)} stamps that are not those of the {len(ids)} '
                        'vertices; expected one for each, or no such file')
    return np.array([stamp_of[k] for k in ids.tolist()], np.int64)


def _convert(texts: list[str], dtype: np.dtype) -> np.ndarray | None:
    """Return the rows as a structured array, or None when any of them is not as it should be."""
    if not texts:
        return np.empty(0, dtype)
    with warnings.catch_warnings():
        # NumPy warns where it should fail: no data, and (before 2.0) an id such as 1.5.
        warnings.simplefilter('error')
        try:
            rows: np.ndarray = np.loadtxt(texts, dtype, ndmin=1, encoding=None)
        except (ValueError, Warning):
            return None
    # `loadtxt` passes over rows without any field.
    if len(rows) != len(texts) or not np.isfinite(rows['values']).all():
        return None
    return rows


def _complaint(text: str, ids: int, values: int) -> str:
    """Say what is wrong with one line."""
    fields = text.split('#', 1)[0].split()
    if len(fields) != ids + values:
        return f'{len(fields)} fields'
    for field in fields[:ids]:
        if _convert([field], np.dtype([('values', np.int64, (1,))])) is None:
            return f'{quoted(field)} is not a whole number of 64 bits'
    for field in fields[ids:]:
        if _convert([field], np.dtype([('values', np.float64, (1,))])) is None:
            return f'{quoted(field)} is not a finite number'
    return f'{quoted(text)} is not understood'
