# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The page of a solve: one HTML file that works without a network, drawn by Plotly.

In: what it shows. Out: the file, written whole or not at all. How it looks and what it does when
one ticks a loop stands in `page.html`, which this puts the library and the contents into.
"""

import argparse
import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from l1slam_ros.cli.report.content import content
from l1slam_ros.cli.report.rivals import rival_maps
from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.robust.batch_map import Outcome, SolveOptions
from l1slam_ros.io.files import replacing, require_file
from l1slam_ros.io.graphs.graph_file import GraphRecord
from l1slam_ros.io.ours import REPORT_MARK, refuse_others
from l1slam_ros.io.progress import Progress

_SUFFIXES = '.html', '.htm'
_LIBRARY, _CONTENTS = '/* the library */', '/* the contents */'


def check_report(path: Path, read: Sequence[Path], force: bool) -> None:
    """
    Refuse, before any work is done, a page that could not be written.

    Raises
    ------
    FileError : its name is no page's, its folder is none, or what is there is not ours or is read.
    OptionError : the plotting library is not installed.

    """
    if path.suffix.lower() not in _SUFFIXES:
        raise FileError(path, 'is not the name of a web page; expected one that ends in '
                        f'{" or ".join(_SUFFIXES)}')
    if find_spec('plotly') is None:
        raise OptionError('--report draws with plotly, which is not installed; expected it: `pip '
                          "install 'l1slam_ros[report]'`, or the package python3-plotly")
    require_file(path)
    refuse_others([path], read, force)


def write_report(arguments: argparse.Namespace, record: GraphRecord, outcome: Outcome,
                 asked: SolveOptions, cost_name: str, remarks: Sequence[str]) -> None:
    """Solve for the rivals of a map, and write the page; remarks : sentences said besides."""
    with Progress(None, 'map', arguments.quiet, 'solving for rivals') as progress:
        rivals = rival_maps(record, outcome, asked, lambda name: progress.advance(1, name))
    shown = content(arguments.input, arguments.norm, record, outcome, rivals, cost_name, remarks)
    with replacing(arguments.report) as temporary:
        temporary.write_text(page(shown), encoding='utf-8')


def page(shown: dict[str, Any]) -> str:
    """Return a page that shows what `content` returns."""
    from plotly.offline import get_plotlyjs

    template = files(__package__).joinpath('page.html').read_text(encoding='utf-8')
    begin, between = template.split(_CONTENTS)
    between, end = between.split(_LIBRARY)
    # What is ticked in a page is kept in the browser for pages that show the same.
    key = hashlib.sha256(json.dumps(shown).encode()).hexdigest()
    # Whatever a file is called ends no script.
    data = json.dumps({**shown, 'key': key}, separators=(',', ':')).replace('<', '\\u003c')
    return ''.join((REPORT_MARK, '\n', begin, data, between, get_plotlyjs(), end))
