# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam`: one graph as a file and as a bag of every kind, by the parameters of a node."""

import numpy as np
import pytest
from command import run, solve_json
from rosbags.rosbag2 import StoragePlugin

import l1slam_ros as l1
from bags import NOTE, recording_of, rosbag2_directory


def copied_bag(bag, copy, names=None, note=NOTE):
    """Copy a bag into an sqlite one by rosbags' own reader and writer."""
    recording = [((names or {}).get(topic, topic), *rest) for topic, *rest in recording_of(bag)]
    return rosbag2_directory(copy, recording, StoragePlugin.SQLITE3, note=note)


def as_toro(line):
    """Return a line of g2o as TORO has it: it orders the information otherwise."""
    tag, *fields = line.split()
    if tag == 'EDGE_SE2':
        xx, xy, xt, yy, yt, tt = fields[5:]
        fields[5:] = xx, xy, yy, tt, xt, yt
    return ' '.join([tag.replace('_SE2', '2'), *fields])


@pytest.fixture
def doors(capsys, world, tmp_path):
    """One graph in every form that a user may have it in."""
    toro = tmp_path / 'a.graph'
    toro.write_text('\n'.join(map(as_toro, world.read_text().splitlines())))
    run(capsys, 'convert', world, tmp_path / 'bag')
    run(capsys, 'convert', tmp_path / 'bag', tmp_path / 'back.g2o')
    sqlite = copied_bag(tmp_path / 'bag', tmp_path / 'sqlite')
    return [world, toro, tmp_path / 'bag', tmp_path / 'bag' / 'bag.mcap',
            tmp_path / 'back.g2o', sqlite, sqlite / 'sqlite.db3']


@pytest.mark.parametrize('norm', ['l1', 'l2', 'huber'])
def test_every_door_leads_to_the_same_costs_and_poses(capsys, doors, tmp_path, norm):
    costs, poses = [], []
    for door in doors:
        report = solve_json(capsys, door, '--no-robust', '--start', 'odometry', '--norm', norm,
                            '--output', tmp_path / 'out.tum')
        costs.append(report['initial_cost'])
        poses.append(np.loadtxt(tmp_path / 'out.tum'))
    assert np.ptp(costs) <= 1e-9 * costs[0] and costs[0] > 100
    assert np.linalg.norm(poses[0][:, 1:3] - np.loadtxt(f'{doors[0]}.truth.txt')[:, 1:3]) > 0.1
    assert np.ptp(poses, axis=0).max() < 1e-6


def test_a_bag_without_our_note_goes_by_the_parameters(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    plain = copied_bag(tmp_path / 'bag', tmp_path / 'plain', note=None)
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {odometry: {covariance_source: increment}, '
                      'keyframe: {translation: 0.0, rotation: 0.0, period: 0.0}}}')
    expected = solve_json(capsys, world, '--norm', 'l2')['final_cost']
    by_defaults = solve_json(capsys, plain, '--norm', 'l2')['final_cost']
    told = solve_json(capsys, plain, '--norm', 'l2', '--params-file', params)['final_cost']
    assert told == pytest.approx(expected, rel=1e-6)
    assert by_defaults != pytest.approx(expected, rel=0.01)
    # So do the other commands that read bags.
    run(capsys, 'convert', plain, tmp_path / 'told.g2o', '--params-file', params)
    assert solve_json(capsys, tmp_path / 'told.g2o', '--norm', 'l2')[
        'final_cost'] == pytest.approx(expected, rel=1e-6)


def test_other_topics(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    other = copied_bag(tmp_path / 'bag', tmp_path / 'other', {
        '/odom': '/wheels/odom', '/loop_closures': '/places'})
    out, err = run(capsys, 'info', other, code=2)
    assert '/wheels/odom: 150 of nav_msgs/msg/Odometry' in out
    assert err.startswith('l1slam: ') and err.count('\n') == 1 and '/wheels/odom' in err
    topics = ('--odom-topic', '/wheels/odom', '--loop-topic', '/places')
    assert solve_json(capsys, other, *topics)['loops'] == 101
    run(capsys, 'plot', other, *topics, '--output', tmp_path / 'map.png')


def test_a_cut_bag_is_read_in_part_and_exits_with_3(capsys, world, tmp_path, soon):
    run(capsys, 'convert', world, tmp_path / 'bag')
    whole = (tmp_path / 'bag' / 'bag.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[:len(whole) // 2])
    for arguments in (['solve', cut, '--quiet', '--output', tmp_path / 'out.g2o'], ['info', cut],
                      ['convert', cut, tmp_path / 'out.g2o'],
                      ['corrupt', cut, tmp_path / 'bad.g2o', '--false-loops', 1],
                      ['plot', cut, world, '--output', tmp_path / 'map.png']):
        out, err = run(capsys, *arguments, code=3)
        assert err.startswith(f'l1slam: {cut}') and err.count('\n') == 1 and 'damaged' in err
        assert 'nothing looks wrong' not in out
    assert l1.read_graph(tmp_path / 'out.g2o')[0].n_poses > 20
    cut.write_bytes(whole[:100])
    out, err = run(capsys, 'solve', cut, '--json', code=2)
    assert out == '' and err.startswith(f'l1slam: {cut}') and err.count('\n') == 1


def test_a_trajectory_goes_out_as_tum_and_in_as_reference_with_stamps_that_others_round(
        capsys, world, tmp_path):
    output = tmp_path / 'out.tum'
    run(capsys, 'solve', world, '--output', output, '--quiet')
    lines = [line.split() for line in output.read_text().splitlines()[1:]]
    assert len(lines) == 150
    for shift in 0, 2e-7:
        output.write_text('\n'.join(' '.join([f'{float(stamp) + shift:.6f}', *rest])
                                    for stamp, *rest in lines))
        ate = solve_json(capsys, world, '--reference', output)['ate']
        assert ate == pytest.approx(0, abs=1e-5 if shift else 1e-8)


def test_a_parameter_file_speaks_to_both_growth_and_solver(capsys, world, tmp_path):
    run(capsys, 'convert', world, tmp_path / 'bag')
    params = tmp_path / 'params.yaml'
    params.write_text('/**: {ros__parameters: {keyframe: {translation: 5.0, rotation: 0.0}, '
                      'solver: {outer_iterations: 2}}}')
    report = solve_json(capsys, tmp_path / 'bag', '--params-file', params)
    assert report['poses'] < 60 and report['outer_iterations'] == 2
    # What it leaves as it is, the bag says of itself.
    params.write_text('/**: {ros__parameters: {keyframe: {translation: 0.5}, solver: {norm: l2}}}')
    said = solve_json(capsys, tmp_path / 'bag', '--params-file', params)['final_cost']
    assert said == pytest.approx(solve_json(capsys, world, '--norm', 'l2')['final_cost'], rel=1e-6)
