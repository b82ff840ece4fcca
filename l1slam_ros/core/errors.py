# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The errors that bad input raises: each says what, the value found and what was expected."""

from collections.abc import Iterator
from contextlib import contextmanager

# So much of a value that is none is shown.
_SHOWN = 60


class L1SlamError(Exception):
    """Base of every error this package raises on purpose."""


class GraphError(L1SlamError):
    """A factor or pose that cannot be part of the graph, or a graph that cannot be solved."""


class FillError(GraphError):
    """A graph whose factorisation would take more memory than there is; blocks : of the factor."""

    def __init__(self, message: str, blocks: int = 0):
        super().__init__(message)
        self.blocks = blocks


class DoubtfulError(L1SlamError):
    """A map that was made all the same, and is not to be relied on."""


class Interrupted(Exception):  # noqa: N818
    """Work was told to stop before its end; no input is to blame, and nothing of it is used."""


class NoiseError(L1SlamError):
    """A covariance or information matrix that is none."""


class OptionError(L1SlamError):
    """An option outside its range."""


def require(kind: type | tuple[type, ...], name: str, value: object, expected: str) -> None:
    """
    Refuse a value that is of another kind.

    Raises
    ------
    OptionError : naming it, what was found and what was expected.

    """
    if not isinstance(value, kind):
        text = ' '.join(repr(value).split())
        shown = text if len(text) <= _SHOWN else f'{text[:_SHOWN]}...'
        raise OptionError(f'{name} is {shown}, expected {expected}')


class MissingError(L1SlamError):
    """A library that some inputs and outputs need, or the compiled core, is not installed."""


# By the first part of a module's name: who may do without, and what brings it.
_OPTIONAL = {
    **dict.fromkeys(('rosbags', 'mcap', 'lz4', 'zstandard'),
                    'bags are read and written by it, expected `pip install rosbags mcap`'),
    'cbor2': 'JRL files in CBOR are read and written by it, expected `pip install cbor2`',
    **dict.fromkeys(('dask', 'distributed'),
                    '--scheduler speaks to a cluster by it, expected `pip install distributed`'),
    'matplotlib': 'pictures are drawn by it, expected `pip install matplotlib` or the package '
                  'python3-matplotlib',
}


@contextmanager
def optional_libraries() -> Iterator[None]:
    """
    Say what to install where a library that is not needed by all is not there.

    Raises
    ------
    MissingError : in place of the error of the import.

    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or '').partition('.')[0]
        if library not in _OPTIONAL:
            raise
        raise MissingError(f'{library} is not installed: {_OPTIONAL[library]}') from error


class MessageError(L1SlamError):
    """A message that cannot be used; `cause` is the short word it is counted under."""

    def __init__(self, cause: str, message: str):
        super().__init__(message)
        self.cause = cause


class FileError(L1SlamError):
    """A file that cannot be read or written; the text names the file and, if known, the line."""

    def __init__(self, path: object, message: str, line: int | None = None):
        super().__init__(f'{path}:{line}: {message}' if line else f'{path}: {message}')
