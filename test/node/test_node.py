# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The real node on real DDS, in this process: messages in, the optimised Path out."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from command import solve_json
from diagnostic_msgs.msg import DiagnosticStatus
from node_bench import EVERY_MESSAGE, begin, call, odometry, pause, poses_of, stamp_of
from worlds import as_map, made, off_by, torn, whitened

import l1slam_ros as l1
from bags import write_world


def test_a_recorded_world_becomes_its_optimal_map_and_all_topics_agree(bench, tmp_path):
    graph = write_world(tmp_path / 'bag', 300, 500).graph
    b = bench(**EVERY_MESSAGE)
    b.play(tmp_path / 'bag')
    b.map_of(300)
    b.until(lambda: b.count('factors') == len(graph.between),
            'no message was lost on the way')
    most = 1.02 * l1.solve(graph, robust=False).cost
    b.until(lambda: np.abs(whitened(graph, poses_of(b.path()))).sum() <= most,
            'the map is as good as optimal')
    last = b.path().poses[-1]
    t = b.received['map_to_odom'][-1]
    assert (t.header.frame_id, t.child_frame_id) == ('map', 'odom')
    b.until(lambda: b.received['pose'][-1].header.stamp == last.header.stamp, 'the last pose')
    assert {p.header.frame_id for p in (b.path(), *b.received['pose'])} == {'map'}
    b.received['pose'].clear()
    b.received['map_to_odom'].clear()
    b.until(lambda: b.received['map_to_odom'], 'a transform is repeated')
    # A look-up at the time of the newest odometry finds it.
    ahead = [stamp_of(m.header) - stamp_of(last.header) for m in b.received['map_to_odom']]
    assert ahead[0] >= 10**8 and (np.diff(ahead) > 0).all()


def test_where_a_map_is_loaded_odometry_goes_on_from_its_end(bench, tmp_path):
    """The robot was switched off meanwhile: its odometry begins at 50 m, a part begins there."""
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    b.drive(0, 3)
    b.map_of(3)
    assert call(b, 'save').success and call(b, 'load').success
    b.send('/odom', odometry(10 * 10**9, 50.0))
    b.send('/odom', odometry(11 * 10**9, 50.1))
    b.until(lambda: len(b.received['pose']) == 5, 'both are answered')
    # Right at once, not only from the next keyframe on.
    x = [message.pose.position.x for message in b.received['pose'][-2:]]
    np.testing.assert_allclose(x, [2.0, 2.1], atol=1e-9)
    b.received['map_to_odom'].clear()
    b.until(lambda: b.received['map_to_odom'], 'a transform')
    assert b.received['map_to_odom'][-1].transform.translation.x == pytest.approx(-48.0)
    b.send('/odom', odometry(12 * 10**9, 51.0))
    np.testing.assert_allclose(poses_of(b.map_of(5))[:, 0], [0, 1, 2, 2, 3], atol=1e-9)
    b.send('/odom', odometry(13 * 10**9, 51.1))
    b.until(lambda: b.received['pose'][-1].header.stamp.sec == 13, 'a pose after the update')
    assert b.received['pose'][-1].pose.position.x == pytest.approx(3.1)


def test_optimize_takes_a_doubtful_map_and_says_so(bench, tmp_path, capsys):
    torn(tmp_path / 'map.g2o')
    as_map(tmp_path / 'map.g2o')
    expected = solve_json(capsys, tmp_path / 'map.g2o', code=4)
    b = bench(save_path=str(tmp_path / 'map.g2o'))
    pause(b, True)  # or an update could change the map before the service does
    assert call(b, 'load').success
    before = poses_of(b.map_of(400))
    answer = call(b, 'optimize')
    reasons = '; '.join(doubt['text'] for doubt in expected['doubts'])
    assert not answer.success and answer.message.startswith(f'doubtful: {reasons}. ')
    assert call(b, 'save').success
    _, taken = l1.read_graph(tmp_path / 'map.g2o')
    assert np.abs(taken - before).max() > 1
    b.until(lambda: np.allclose(poses_of(b.path()), taken, atol=1e-9), 'it is published')
    b.until(lambda: b.count('accepted_loops') > 90, 'most loops are taken')
    b.until(lambda: answer.message in b.status()[1], 'diagnostics say the same')
    level, _, values = b.status()
    assert level == DiagnosticStatus.WARN
    assert values['judgement.doubts'] == '; '.join(doubt['kind'] for doubt in expected['doubts'])
    assert values['judgement.confidence'] == f"{expected['confidence']:.3g}"


def test_no_update_while_paused(bench):
    b = bench()
    pause(b, True)
    assert call(b, 'optimize').message == 'there are no factors yet'
    b.send('/odom', odometry(10**9, 0.0))
    b.until(lambda: b.received['pose'], 'poses go on')
    ticks = len(b.received['map_to_odom'])
    b.until(lambda: len(b.received['map_to_odom']) > ticks + 3, 'the timer goes on')
    assert not b.received['path']
    pause(b, False)
    b.map_of(1)


def test_the_solver_never_starves_the_callbacks_and_names_an_offset_of_loops(bench, tmp_path):
    as_map(off_by(made(tmp_path / 'map.g2o', 1500, 2600), (-0.3, 0.4, 0.05)))
    b = bench(save_path=str(tmp_path / 'map.g2o'), autosave_period=0.0)
    assert call(b, 'load').success
    answer = begin(b, 'optimize')
    for k in range(20):
        b.send('/odom', odometry((10 + k) * 10**9, 0.1 * k))
    b.until(lambda: b.newest() == 29 * 10**9, 'odometry is answered')
    assert not answer.done(), 'the solver was done before the callbacks: make the world larger'
    b.until(answer.done, 'the solver answers')
    # What was driven meanwhile no loop joins to the map that was loaded.
    found = answer.result()
    assert found.success or ' joins 2 parts of the map' in found.message
    assert call(b, 'load').success
    answer = call(b, 'optimize')
    assert answer.success
    assert 'L1 cost' in answer.message and '; loops share an offset of 0.' in answer.message
