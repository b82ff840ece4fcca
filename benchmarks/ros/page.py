# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The steps of doc/how_a_message_becomes_a_map.md."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).resolve().parents[2] / 'doc' / 'how_a_message_becomes_a_map.md'


class Step(NamedTuple):
    """A numbered step of the page: a file of the package, and what is called there."""

    number: int
    file: str
    call: str


class Part(NamedTuple):
    """A part of the page: its title, its thread, its steps."""

    title: str
    thread: str
    steps: list[Step]


def parts() -> Iterator[Part]:
    """Yield the parts of the page."""
    for section in re.split(r'^## ', PAGE.read_text(), flags=re.M)[1:]:
        head, _, body = section.partition('\n')
        title, thread = re.findall(r'^(.*): thread `(\w+)`$', head)[0]
        steps = re.findall(r'^(\d+)\. `([\w/]+\.py)` `([\w.]+)`: ', body, re.M)
        yield Part(title, thread, [Step(int(number), file, call) for number, file, call in steps])
