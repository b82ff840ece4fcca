# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Limits on text and YAML from others: their size is checked before all of them is read."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from l1slam_ros.core.errors import FileError

# [bytes] A text file as a whole (a graph of a million poses has .4e9), one line of it, and a
# document of YAML.
_LARGEST = 2**31
_LONGEST_LINE = 2**16
_LONGEST_YAML = 2**22
# Brackets and lists within each other: PyYAML takes the square of it.
_DEEPEST = 64
_BLOCK = 2**20
_NEWLINE = ord('\n')
_BRACKET = re.compile(r'[][{}]')
_LISTS = re.compile(r'^ *(?:[-?] )+', re.MULTILINE)


def read_text(path: Path) -> bytes:
    """
    Return the bytes of a text file.

    Raises
    ------
    FileError : it is larger, or one of its lines is longer, than that of any graph.
    OSError : it cannot be read.

    """
    size = path.stat().st_size
    if size > _LARGEST:
        raise FileError(path, f'{size:,} bytes; expected a text file of at most {_LARGEST:,}')
    blocks = list[bytes]()
    begun = 0
    number = 1
    with path.open('rb') as file:
        while block := file.read(_BLOCK):
            ends = np.flatnonzero(np.frombuffer(block, np.uint8) == _NEWLINE)
            lengths = np.diff(ends, prepend=-1, append=len(block)) - 1
            lengths[0] += begun  # a line may begin in one block and end in another
            if lengths.max() > _LONGEST_LINE:
                number += int(np.argmax(lengths > _LONGEST_LINE))
                raise FileError(path, f'a line of more than {_LONGEST_LINE:,} bytes; expected a '
                                'text file', number)
            begun = int(lengths[-1])
            number += len(ends)
            blocks.append(block)
    return b''.join(blocks)


def read_yaml(text: str) -> Any:
    """
    Return what a document of YAML says.

    Raises
    ------
    ValueError : it is too long, or nested too deeply, to be what anybody writes.
    yaml.YAMLError : it is no YAML.

    """
    import yaml

    depth = deepest = 0
    for found in _BRACKET.finditer(text) if len(text) <= _LONGEST_YAML else ():
        depth += 1 if found[0] in '[{' else -1
        deepest = max(deepest, depth)
    lists = max((len(found[0].split()) for found in _LISTS.finditer(text)), default=0)
    if len(text) > _LONGEST_YAML or max(deepest, lists) > _DEEPEST:
        raise ValueError(f'YAML of {len(text):,} characters, {max(deepest, lists)} deep; expected '
                         f'at most {_LONGEST_YAML:,}, and {_DEEPEST} deep')
    return yaml.safe_load(text)
