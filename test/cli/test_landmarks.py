# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Landmarks as pose vertices: sightings are judged as loops, whatever the ids of the vertices."""

import io
import json
import tempfile
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path

import pytest
from command import run, solve_json
from tags import TagWorld

from l1slam_ros.cli.main import main

SPACE = pytest.mark.parametrize('space', [False, True], ids=['plane', 'space'])


def left_out(found):
    return {tuple(pair) for pair in found['rejected'] + found['suspect']}


def solved(capsys, folder, world, *options, **written):
    truth = world.write(folder / 'tags.g2o', **written)
    return solve_json(capsys, folder / 'tags.g2o', '--reference', truth, *options)


@SPACE
@pytest.mark.parametrize(('tags', 'false'), [(12, 0.0), (40, 0.1)])
def test_sightings_of_tags_hold_laps_of_a_hall_and_false_ones_are_refused(
        tmp_path, capsys, tags, false, space):
    world = TagWorld(tags, 600, tags, false, space)
    found = solved(capsys, tmp_path, world)
    assert found['poses'] == 600 + tags and found['loops'] == world.sightings
    assert found['status'] == 'converged' and found['parts'] == 1
    assert found['ate'] < 0.1
    assert left_out(found) == world.false_pairs


def test_a_file_as_rtabmap_exports_it(capsys, shared):
    found = solve_json(capsys, shared / 'reports' / 'tags6.g2o')
    assert found['status'] == 'converged' and found['loops'] == 69 and not left_out(found)


IDS = {
    'consecutive': [*range(306)],
    'tags_first': [*range(6, 306), *range(6)],
    'tags_between': [*range(150), *range(156, 306), *range(150, 156)],
    'tags_far': [*range(300), *range(2**62, 2**62 + 6)],
    'poses_far_apart': [*range(0, 3000, 10), *range(3000, 3006)],
    'letters': [*((ord('x') << 56) + k for k in range(300)),
                *((ord('l') << 56) + k for k in range(6))],
}


@pytest.fixture(scope='module')
def plain():
    """Return a world, and what is made of it."""
    world = TagWorld(0, 300, 6, 0.1)
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as said:
        truth = world.write(Path(folder) / 'tags.g2o')
        main(['solve', f'{folder}/tags.g2o', '--reference', str(truth), '--json'])
    return world, json.loads(said.getvalue())


@pytest.mark.parametrize('ids', IDS.values(), ids=IDS)
def test_ids_and_the_order_of_lines_are_nothing(tmp_path, capsys, ids, plain):
    """The last pose and the first ones see the tags whose ids are next to theirs."""
    world, plain = plain
    found = solved(capsys, tmp_path, world, ids=ids, tags_first=True)
    assert found['loops'] == plain['loops'] == world.sightings
    assert left_out(found) == {(ids[a], ids[300 + b]) for a, b in world.false}
    assert found['ate'] == pytest.approx(plain['ate'], rel=0.05)


def test_an_edge_from_a_pose_to_the_tag_of_the_next_id_is_a_sighting(tmp_path, capsys):
    # The last of them is between the ids of two poses: the odometry leads past it.
    for tags, beside, tag, ids in (
            (6, (299,), 0, IDS['consecutive']), (6, (0,), 5, IDS['tags_first']),
            (1, (299, 0), 0, [*range(300), 5000]), (1, (299, 0), 0, [*range(1, 301), 0]),
            (1, (99, 100), 0, [*range(100), *range(101, 301), 100])):
        world = TagWorld(0, 300, tags)
        for pose in beside:
            world.see(pose, tag)
        world.write(tmp_path / 'tags.g2o', ids=ids)
        # One tag alone is hardly sure by its norm.
        said = run(capsys, 'solve', tmp_path / 'tags.g2o', '--json', code=None)[0]
        assert json.loads(said)['loops'] == world.sightings


def test_a_false_first_sighting_is_refused_as_any(tmp_path, capsys):
    world = TagWorld(0, 300, 6)
    for tag in range(6):
        world.falsify_first(tag)
    found = solved(capsys, tmp_path, world)
    assert left_out(found) == world.false_pairs and len(world.false) == 6
    assert found['slips'] == []


def test_start_from_odometry_and_from_the_solved_file(tmp_path, capsys):
    world = TagWorld(0, 300, 6, 0.1)
    out = tmp_path / 'solved.g2o'
    found = solved(capsys, tmp_path, world, '--start', 'odometry', '--output', out)
    again = solve_json(capsys, out, '--start', 'file')
    assert again['rejected'] == found['rejected'] and len(found['rejected']) == len(world.false)
    assert again['initial_cost'] <= found['initial_cost'] * (1 + 1e-6)
    text = out.read_text()
    assert text.count('\nVERTEX_SE2 ') + text.startswith('VERTEX_SE2 ') == 306


def test_info_counts_landmarks_and_finds_no_gap_at_them(tmp_path, capsys):
    TagWorld(0, 300, 6).write(tmp_path / 'tags.g2o', ids=IDS['tags_between'])
    out, _ = run(capsys, 'info', tmp_path / 'tags.g2o')
    assert 'landmarks   6 of the poses' in out and 'gap' not in out


def test_one_sighting_places_a_landmark(tmp_path, capsys):
    world = TagWorld(0, 120, 3)
    world.edges = [edge for k, edge in enumerate(world.edges)
                   if not edge[3] or edge[1] not in [other[1] for other in world.edges[:k]]]
    assert not left_out(solved(capsys, tmp_path, world))


def star(folder, edges):
    lines = [f'EDGE_SE2 {a} {b} {x} 0 0 100 0 0 100 0 100' for a, b, x in edges]
    (folder / 'star.g2o').write_text('\n'.join(lines) + '\n')
    return folder / 'star.g2o'


def test_without_any_odometry_there_is_no_landmark_nor_is_the_last_pose_one(tmp_path, capsys):
    none = [(a, b, b - a) for a in range(9) for b in (a + 2, a + 3)]
    last = [(a, b, 1) for a, b in pairwise(range(20))] + [(3, 19, 16), (2, 19, 17), (1, 0, -1)]
    for edges in none, last:
        assert 'landmarks' not in run(capsys, 'info', star(tmp_path, edges))[0]


def test_one_step_of_odometry_and_all_else_seen_once(tmp_path, capsys):
    found = solve_json(capsys, star(tmp_path, [(0, 10 * k, k) for k in range(1, 9)]))
    assert found['poses'] == 9 and not left_out(found) and found['parts'] == 1


def test_what_places_a_landmark_is_not_suspected_as_a_slip_of_the_odometry(tmp_path, capsys):
    world = TagWorld(4, 300, 8, 0.1)
    truth = world.write(tmp_path / 'tags.g2o')
    lines = (tmp_path / 'tags.g2o').read_text()
    # The information of sightings is a hundredth of what it should be.
    (tmp_path / 'tags.g2o').write_text(lines.replace('399.99999999999994', '4').replace(
        '1111.111111111111', '11.1'))
    found = solve_json(capsys, tmp_path / 'tags.g2o', '--reference', truth)
    assert world.false_pairs <= left_out(found) and found['ate'] < 0.15
    assert not found['doubts'] and not found['slips']


def test_a_slip_of_the_odometry_is_found_beside_landmarks(tmp_path, capsys):
    world = TagWorld(1, 300, 6, 0.1)
    for edge in world.edges[150:152]:
        edge[2][:2] += 0.7, 0.5
    found = solved(capsys, tmp_path, world)
    assert found['slips'] == [[150, 151], [151, 152]] and found['ate'] < 0.15
    assert left_out(found) == world.false_pairs | {(150, 151), (151, 152)}
