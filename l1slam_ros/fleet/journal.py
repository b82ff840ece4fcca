# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The log of a batch, from which it is taken up again.

In: how each recording ended. Out: a file of JSON, one line for each, kept open and locked; and
what such a file says. The first line says of what batch it is; a last line that a kill cut off is
taken away. Lines `{"table": name, "sha256": digest}` tell which tables this program wrote.
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

from l1slam_ros.core.errors import FileError
from l1slam_ros.fleet.child import Values
from l1slam_ros.io.files import reported
from l1slam_ros.io.ours import PROGRAM

# What the first line says besides what the results depend on.
_KIND = PROGRAM
_BATCH = 'batch'


class Journal:
    """
    The log of one batch, to be opened by `journal`.

    Parameters
    ----------
    path, file : the log, at its end
    lines : what it says but for its first line

    """

    def __init__(self, path: Path, file: IO[str], lines: list[Values]):
        self._path, self._file = path, file
        self._ended = {line['recording']: line for line in lines if 'recording' in line}
        self._tables = {line['sha256'] for line in lines if 'table' in line}

    def ended(self, name: str) -> Values | None:
        """Return the last line of a recording; None: it is not done."""
        return self._ended.get(name)

    def add(self, line: Values) -> None:
        """Put down how a recording ended."""
        self._ended[line['recording']] = line
        self.put(line)

    def announce_table(self, name: str, content: bytes) -> None:
        """Put down that a table will be written."""
        digest = sha256(content).hexdigest()
        if digest not in self._tables:
            self._tables.add(digest)
            self.put({'table': name, 'sha256': digest})

    def refuse_other_table(self, path: Path) -> None:
        """Refuse to replace a table that this program did not write, or that was changed since."""
        if os.path.lexists(path):
            with reported(path, 'read'):
                content = path.read_bytes()
            if sha256(content).hexdigest() not in self._tables:
                raise FileError(path, f'is not as {PROGRAM} wrote it, so it is not replaced; '
                                'expected the table unchanged, or no file of this name')

    def put(self, line: Values) -> None:
        """Append a line, such that a kill of this process does not take it away."""
        with reported(self._path):
            self._file.write(json.dumps(line) + '\n')
            self._file.flush()


@contextmanager
def journal(path: Path, about: dict[str, Any], resume: bool) -> Iterator[Journal]:
    """
    Yield the log of a batch, new or taken up again; nobody else can open it meanwhile.

    Parameters
    ----------
    path : of the log
    about : what the results depend on, values of JSON
    resume : whether there must be one, of the same

    Raises
    ------
    FileError : there is one, or none, or of something else, or it is damaged or in use.

    """
    first = {_KIND: _BATCH, **about}
    if resume and not path.exists():
        raise FileError(path, 'no such file; expected the log of a batch, or no --resume')
    with reported(path):
        file = open(path, 'r+' if resume else 'x', encoding='ascii')  # noqa: SIM115
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise FileError(path, 'another batch is at work here') from error
        lines = _lines(path, file, first) if resume else []
        log = Journal(path, file, lines[1:])
        if not lines:
            log.put(first)
        yield log
        os.fsync(file.fileno())


def _lines(path: Path, file: IO[str], first: Values) -> list[Values]:
    """Return what a log says, with its first line; it ends there."""
    whole = 0
    lines = list[Values]()
    try:
        for text in file:
            if text.endswith('\n'):
                lines.append(json.loads(text))
                whole += len(text)
    except ValueError as error:
        raise FileError(path, 'expected a line of JSON, as this program wrote it', len(lines) + 1
                        ) from error
    if lines and lines[0] != first:
        raise FileError(path, f'is of {json.dumps(lines[0])}; expected {json.dumps(first)}: '
                        'give the same options, or another folder for the results', 1)
    file.seek(whole)
    file.truncate()
    return lines
