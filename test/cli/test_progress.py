# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What takes long shows its progress, and what does not shows none."""

from l1slam_ros.io.progress import Progress


def test_on_a_terminal_what_is_done_soon_has_no_bar(capsys, monkeypatch):
    monkeypatch.setattr('sys.stderr.isatty', lambda: True)
    with Progress(3, 'part', False, 'compiling', delay=60) as progress:
        for done in 1, 2, 3:
            progress.reach(done, 3)
    assert capsys.readouterr().err == ''


def test_in_a_log_there_is_a_line_now_and_then_of_what_takes_long(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr('l1slam_ros.io.progress.time.monotonic', lambda: now[0])
    with Progress(200, 'step', label='solving') as progress, Progress(9, 'x', True, 'a') as quiet:
        for k in range(200):
            now[0] += 0.125
            progress.report(k, 1234.5678)
            quiet.advance()
        for _ in range(60):
            now[0] += 0.125
            progress.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == 'l1slam: solving: step 24 of 200, cost 1234.57'
    assert len(lines) == 6 and lines[-1] == 'l1slam: solving: step 224'
    with Progress(2, 'step', label='soon done') as progress:
        progress.advance(2)
    assert capsys.readouterr().err == ''
