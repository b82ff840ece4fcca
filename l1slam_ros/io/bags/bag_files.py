# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The files of a bag: those that its metadata.yaml lists, or those whose names say they are its.

Recorders split a bag into files with a number in their names:

    bag_0.mcap                              rosbag2, until 2025
    0_bag_2026_01_31-12_00_00.mcap          rosbag2, since then
    bag_2026-01-31-12-00-00_0.bag           ROS 1
"""

import re
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from l1slam_ros.io.bounded import read_yaml

METADATA = 'metadata.yaml'
_STAMP = r'_?[0-9]{4}(?:[_-][0-9]{2}){2}-[0-9]{2}(?:[_-][0-9]{2}){2}'
_KIND = r'(?P<kind>\.mcap|\.db3|\.bag)(?:\.zstd)?'  # `.zstd` if whole files are compressed
# The first one that a name fits says of which bag it is.
_NAMES = tuple(map(re.compile, (
    rf'(?P<number>[0-9]+)_(?P<bag>.*?){_STAMP}{_KIND}',
    rf'(?P<bag>.*?){_STAMP}_(?P<number>[0-9]+){_KIND}',
    rf'(?P<bag>.+?)(?:_(?P<number>[0-9]+))?{_KIND}')))


def directory_metadata(bag: Path) -> dict[str, Any]:
    """Return the content of the metadata.yaml of a bag; empty if it cannot be read."""
    file = bag / METADATA
    with suppress(Exception):  # it may be missing, or not text, or not such YAML
        # Another kind of file, as a pipe, would be waited for.
        document = read_yaml(file.read_text(encoding='utf-8')) if file.is_file() else {}
        return dict(document['rosbag2_bagfile_information'])
    return {}


def storage_files(directory: Path) -> list[Path]:
    """Return the existing files of a bag in the order of their numbers."""
    return _by_number(path for path in directory.iterdir() if _match(path) and path.is_file())


def _by_number(files: Iterable[Path]) -> list[Path]:
    return sorted(files, key=lambda file: [(text, int(number or 0)) for text, number in re.findall(
        r'(\D*)([0-9]*)', file.name)])


def bag_count(directory: Path) -> int:
    """Return of how many bags the files in a directory are, by their names."""
    numbers: dict[tuple[str, str], Counter[str | None]] = {}
    for path in storage_files(directory):
        if match := _match(path):
            numbers.setdefault((match['bag'], match['kind']), Counter())[match['number']] += 1
    # Two files with one number are of two bags.
    return sum(max(found.values()) for found in numbers.values())


def _match(path: Path) -> re.Match[str] | None:
    return next((match for name in _NAMES if (match := name.fullmatch(path.name))), None)


def files_of(bag: Path) -> tuple[list[Path], str]:
    """
    Return the files of a bag in the order of their numbers, and what is wrong with their list.

    Those that metadata.yaml lists may be missing. Empty: nothing is wrong.
    """
    if not bag.is_dir():
        return [bag], ''
    names = directory_metadata(bag).get('relative_file_paths')
    if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
        # Older versions include the directory.
        return _by_number({bag / Path(name).name for name in names}), ''
    files = storage_files(bag)
    if not (bag / METADATA).exists():
        is_ros1 = bool(files) and files[0].suffix == '.bag'
        return files, '' if is_ros1 else f'its {METADATA} is missing'
    return files, f'its {METADATA} cannot be read'
