# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam reproduce`: what it refuses."""

from pathlib import Path

import pytest
from command import run


def arguments(folder, **changes):
    options = {'datasets': folder, 'worlds': 'none', 'output': folder / 'out', **changes}
    return [word for name, value in options.items() if value is not None
            for word in (f'--{name}', value)]


@pytest.mark.parametrize(('changes', 'says'), [
    ({'datasets': None}, 'expected --datasets DIR, or --worlds other than none'),
    ({}, "none of the paper's graphs is there; expected manhattan3500.g2o, intel.g2o"),
    ({'datasets': Path('/no/such/folder')}, "none of the paper's graphs is there"),
    ({'worlds': '10k', 'datasets': None, 'output': Path('/no/such/folder')}, 'is no folder'),
    ({'worlds': '10k', 'datasets': None, 'output': Path(__file__)}, 'is no folder; expected one'),
    ({'output': Path('/proc')}, '/proc/report.md: cannot be written'),
    ({'output': Path('/proc/out')}, '/proc/out: cannot be written'),
])
def test_what_cannot_be_is_refused_at_once_in_one_line(capsys, tmp_path, changes, says):
    out, err = run(capsys, 'reproduce', *arguments(tmp_path, **changes), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('text', 'says'), [
    ('EDGE_SE2 0 1 1 0 nonsense 1 0 0 1 0 1\n', 'intel.g2o:1: '),
    ('VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 1 0 0\n'
     'EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n', 'intel.g2o: the graph is not connected: vertex 2')])
def test_a_graph_that_cannot_be_used_is_named(capsys, tmp_path, text, says):
    (tmp_path / 'intel.g2o').write_text(text)
    out, err = run(capsys, 'reproduce', *arguments(tmp_path), code=2)
    assert out == '' and says in err and err.count('\n') == 1
    assert [p.name for p in tmp_path.iterdir()] == ['intel.g2o']
