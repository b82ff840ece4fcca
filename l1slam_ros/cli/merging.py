# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command of `l1slam` that makes one map of several drives or robots."""

import argparse
from dataclasses import replace
from pathlib import Path

from l1slam_ros.cli.commands import Ending, inputs, read, scan_progress, topics_of
from l1slam_ros.cli.solving import asked_of, solved
from l1slam_ros.core.errors import FileError, OptionError, optional_libraries
from l1slam_ros.core.robust.batch_map import Outcome
from l1slam_ros.fleet.merging import Merged, Part, apart_sentences, merged, parts_beside
from l1slam_ros.fleet.rivals import rival_doubts
from l1slam_ros.fleet.scanning import Found, scanned
from l1slam_ros.io import formats
from l1slam_ros.io.graphs.graph_file import read_graph_file, read_one_of_several

_FEWEST = 2


def merge(arguments: argparse.Namespace) -> Ending:
    """Make one graph of all inputs, solve it, and write it."""
    paths = arguments.input
    if len(paths) < _FEWEST:
        raise OptionError(f'{len(paths)} input; expected {_FEWEST} or more, or `l1slam solve`')
    if arguments.output.suffix.lower() != '.g2o':
        raise FileError(arguments.output, 'expected a name that ends with .g2o: the other formats '
                        'hold the drive of one robot')
    formats.check_output(arguments.output, inputs(
        arguments, arguments.reference, arguments.loops), arguments.force)
    parts, found = _parts(arguments, paths)
    whole = merged(parts, arguments.loops, found, arguments.rotation_information,
                   arguments.information)

    def settled(outcome: Outcome) -> tuple[Outcome, list[str]]:
        return _settled(outcome, whole, [part.path for part in parts])

    # What is wrong with the whole is of no input alone.
    return solved(argparse.Namespace(**{**vars(arguments), 'input': arguments.output}),
                  asked_of(arguments), whole.record, None, settled)


def _parts(arguments: argparse.Namespace, paths: list[Path]) -> tuple[list[Part], Found | None]:
    """Return all inputs, and the loops between them that the front end found, if asked to."""
    if arguments.scans is None:
        return [_part(arguments, drive) for drive in _drives(arguments, paths)], None
    with scan_progress(arguments.quiet) as report:
        records, found = scanned(paths, arguments.odom_topic, arguments.scans, report)
    return [Part(path, record) for path, record in zip(paths, records, strict=True)], found


def _drives(arguments: argparse.Namespace, paths: list[Path]) -> list[list[Path]]:
    """Return the inputs of each drive: bags may follow each other, all else is one of its own."""
    bags = [path for path in paths if path.exists() and formats.is_bag(path)]
    # A file of loops counts the inputs as they are.
    if len(bags) < _FEWEST or arguments.loops is not None:
        return [[path] for path in paths]
    with optional_libraries():
        from l1slam_ros.io.bags.drives import drives

    chains = drives(bags, topics_of(arguments))
    found = {chain[0]: chain for chain in chains}
    later = {path for chain in chains for path in chain[1:]}
    return [found.get(path, [path]) for path in paths if path not in later]


def _part(arguments: argparse.Namespace, drive: list[Path]) -> Part:
    path, *more = drive
    if path.is_file() and formats.graph_reader(path) is read_graph_file:
        return Part(path, *read_one_of_several(
            path, arguments.rotation_information, arguments.information))
    record = read(arguments, path, quiet=True, more=more)
    said = tuple(f'{other} goes on where it ends; they are read as one drive' for other in more)
    return Part(path, replace(record, skipped=(*said, *record.skipped)))


def _settled(outcome: Outcome, whole: Merged, paths: list[Path]) -> tuple[Outcome, list[str]]:
    """Return the outcome with unjoined parts beside each other, and a sentence on each."""
    graph = whole.record.graph.without_struck()
    judgement = outcome.judgement
    if judgement:
        rivals = rival_doubts(whole.record.graph, outcome.solution.poses, judgement.accepted,
                              whole.of_input)
        judgement = replace(judgement, doubts=(*judgement.doubts, *rivals))
        graph = judgement.believed(whole.record.graph)
    poses = parts_beside(graph, outcome.solution.poses)
    return (replace(outcome, judgement=judgement, solution=replace(outcome.solution, poses=poses)),
            apart_sentences(graph, whole.of_input, paths))
