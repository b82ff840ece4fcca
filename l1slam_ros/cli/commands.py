# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The commands of `l1slam` that only read: convert and info, and what all have in common."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from l1slam_ros.cli import summary
from l1slam_ros.io import formats
from l1slam_ros.io.bags.topics import Topics
from l1slam_ros.io.files import counted
from l1slam_ros.io.formats import is_log
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.progress import Progress, say

if TYPE_CHECKING:
    from l1slam_ros.io.scans.to_graph import ScanMap


class Ending(NamedTuple):
    """
    The last words of a command, a sentence each, or empty.

    damage : what could not be read; doubt : why the map is not to be relied on.
    """

    damage: str = ''
    doubt: str = ''


def convert(arguments: argparse.Namespace) -> Ending:
    """Write what was read in another format."""
    formats.check_output(arguments.output, inputs(arguments), arguments.force)
    record = read(arguments, arguments.input)
    with formats.named(arguments.input):
        formats.write_output(arguments.output, formats.with_poses(record), force=arguments.force)
    return Ending(record.damage)


def info(arguments: argparse.Namespace) -> Ending:
    """Print what is in a graph or a bag, and what looks wrong with it."""
    if formats.is_bag(arguments.input):
        _print_rows(summary.bag_numbers(arguments.input))
    record = read(arguments, arguments.input, quiet=True)
    _print_rows(summary.numbers(record))
    sentences = [*record.skipped, *summary.complaints(record)]
    for sentence in sentences:
        print(f'- {sentence}')
    if not sentences and not record.damage:
        print('nothing looks wrong')
    return Ending(record.damage)


def inputs(arguments: argparse.Namespace, *others: str | Path | None) -> list[Path]:
    """Return all that a command may read: its inputs, what lies beside them, and others."""
    named = arguments.input if isinstance(arguments.input, list) else [arguments.input]
    extra = [arguments.params_file, *others]
    # A topic of a bag is named after it.
    return [file for path in named for file in formats.files_of(path)] + [
        Path(part) for path in extra if path for part in {str(path), str(path).split(':/')[0]}]


def _print_rows(rows: list[tuple[str, str]]) -> None:
    print('\n'.join(f'{name:<12}{value}' for name, value in rows))


def read(arguments: argparse.Namespace, path: Path, quiet: bool = False,
         more: Sequence[Path] = ()) -> GraphRecord:
    """
    Return the graph of an input, as the options for bags say; warn of what was skipped.

    more : further bags of the drive whose first bag is the input
    """
    options = None
    if arguments.params_file:
        from l1slam_ros.io.node_options import read_params_file

        options = read_params_file(arguments.params_file)
    if is_log(path):
        record = read_scan_map(arguments, path, quiet).record
        warn(record.skipped, quiet)
        return record
    record = formats.read_input(
        path, options, topics_of(arguments), arguments.rotation_information,
        options.dimension if options else 2, arguments.information, more)
    warn(record.skipped, quiet)
    return record


def topics_of(arguments: argparse.Namespace) -> Topics:
    """Return the topics of a bag that the options name."""
    return Topics(arguments.odom_topic, arguments.loop_topic, with_loops=False)


def read_scan_map(arguments: argparse.Namespace, path: Path, quiet: bool = False,
                  topic: str | None = None) -> 'ScanMap':
    """Return what the scans of a log, or of a bag's topic, make."""
    from l1slam_ros.io.scans.reading import read_scans

    with scan_progress(quiet) as report:
        return read_scans(path, arguments.odom_topic, topic, report)


@contextmanager
def scan_progress(quiet: bool) -> Iterator[Callable[[int, int, int], None]]:
    """Yield a function that shows the numbers of scans matched, of all scans, and of loops."""
    with Progress(None, 'scan', quiet, 'matching scans') as progress:
        def report(scans: int, of_all: int, loops: int) -> None:
            progress.reach(scans, of_all)
            progress.advance(0, counted(loops, 'loop'))

        yield report


def warn(sentences: Sequence[str], quiet: bool = False) -> None:
    """Print warnings to standard error."""
    for sentence in () if quiet else sentences:
        say(sentence)
