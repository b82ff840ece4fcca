# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A recording and a graph of a user's stay as they are, whatever commands and the node do."""

import pytest

pytest.importorskip('rclpy')

from node_bench import call
from rosbags.rosbag2 import StoragePlugin

from bags import recording_of, rosbag2_directory, write_world
from l1slam_ros.cli.main import main

GRAPH = """# my own graph
VERTEX_SE2 10 0 0 0
VERTEX_SE2 13 1 0 0
VERTEX_SE2 16 2 0 0
EDGE_SE2 10 13 1 0 0 100 0 0 100 0 100
EDGE_SE2 13 16 1 0 0 100 0 0 100 0 100
"""


def kept_in(folder):
    """Return the file that has the graph by the name of a day; beside it `.1` may have it, too."""
    kept, = (file for file in folder.glob('map.2*.g2o') if file.read_bytes() == GRAPH.encode())
    return kept


def drive(b, first, last):
    """Drive, until there is a map."""
    b.drive(first, last)
    b.until(lambda: b.count('keyframes') == last - first, 'a map')


def files_of(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.rglob('*')) if path.is_file()}


def test_a_recording_is_never_replaced(tmp_path, capsys):
    recording, graph = tmp_path / 'recording', tmp_path / 'graph.g2o'
    write_world(tmp_path / 'ours', 20, 30)
    rosbag2_directory(recording, recording_of(tmp_path / 'ours'), StoragePlugin.MCAP)
    graph.write_text(GRAPH)
    before = files_of(recording)
    for command in (['convert', str(graph), str(recording)],
                    ['solve', str(graph), '--output', str(recording)],
                    ['solve', str(recording), '--output', str(recording)],
                    ['solve', str(recording), '--output', str(recording), '--force']):
        assert main(command) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
        assert files_of(recording) == before
    assert main(['convert', str(recording), str(graph)]) == 2
    assert graph.read_text() == GRAPH


@pytest.mark.parametrize('period', [0.0, 0.2], ids=['saved when asked', 'saved by itself'])
def test_a_graph_at_save_path_outlives_every_save_and_reset(bench, tmp_path, period):
    path = tmp_path / 'map.g2o'
    path.write_text(GRAPH)
    b = bench(save_path=str(path), autosave_period=period)
    for begin in (0, 5):
        drive(b, begin, begin + 4)
        for _ in range(2):
            answer = call(b, 'save')
            assert answer.success
        assert call(b, 'reset').success
        assert kept_in(tmp_path)
    drive(b, 10, 13)
    assert call(b, 'save').success
    assert kept_in(tmp_path)


def test_the_answer_says_what_was_kept(bench, tmp_path):
    path = tmp_path / 'map.g2o'
    path.write_text(GRAPH)
    b = bench(save_path=str(path), autosave_period=0.0)
    drive(b, 0, 3)
    message = call(b, 'save').message
    assert str(kept_in(tmp_path)) in message
