# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`l1slam merge`: several drives or robots, one map."""

import json

import numpy as np
import pytest
from command import run, solve_json
from worlds import lines_of, made

import l1slam_ros as l1

HALF = 200
SYMBOL = 1 << 56
A, B = ord('a') * SYMBOL, ord('b') * SYMBOL


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """A graph of 400 keyframes with 10 false loops."""
    return made(tmp_path_factory.mktemp('world') / 'world.g2o', 2 * HALF, 800, '--false-loops', 10)


def cut(world, folder, ids=None):
    """
    Write a graph as two, and return them with the lines of what leads from one to the other.

    ids : the id of each keyframe; none: both begin with 0, and the lines say the number of each
    """
    write, ids = ids or (lambda k: f'{k // HALF + 1}:{k % HALF}'), ids or (lambda k: k % HALF)
    lines, between = ([], []), []
    for tag, *rest in map(str.split, world.read_text().splitlines()):
        if tag.startswith('VERTEX'):
            k = int(rest[0])
            lines[k // HALF].append(f'{tag} {ids(k)} {" ".join(rest[1:])}')
        elif tag.startswith('EDGE'):
            i, j, values = int(rest[0]), int(rest[1]), ' '.join(rest[2:])
            if i // HALF == j // HALF:
                lines[i // HALF].append(f'{tag} {ids(i)} {ids(j)} {values}')
            elif (i, j) != (HALF - 1, HALF):
                between.append(f'{tag} {write(i)} {write(j)} {values}')
    paths = [folder / 'first.g2o', folder / 'second.g2o']
    for path, own in zip(paths, lines, strict=True):
        path.write_text('\n'.join(own) + '\n')
    return paths, between


def listed(folder, between):
    path = folder / 'loops.txt'
    path.write_text('\n'.join(between) + '\n')
    return path


def ids_of(path):
    return [int(row[0]) for row in lines_of(path, 'VERTEX')]


def merge_json(capsys, *arguments, code=0):
    out, err = run(capsys, 'merge', *arguments, '--json', code=code)
    return json.loads(out), err


def whole(pairs):
    """Return pairs of ids of the merged map as those of the world."""
    return sorted((i % 1000 + HALF * (i >= 1000), j % 1000 + HALF * (j >= 1000))
                  for i, j in pairs)


def test_what_is_cut_in_two_and_merged_by_a_list_is_as_it_was(world, tmp_path, capsys):
    """A graph and a bag."""
    known = solve_json(capsys, world)
    paths, between = cut(world, tmp_path)
    run(capsys, 'convert', paths[1], tmp_path / 'bag')
    found, said = merge_json(capsys, paths[0], tmp_path / 'bag', '--loops',
                             listed(tmp_path, between), '--output', tmp_path / 'out.g2o',
                             '--reference', f'{world}')
    assert whole(found['rejected']) == sorted(map(tuple, known['rejected']))
    assert (found['poses'], found['factors']) == (known['poses'], known['factors'] - 1)
    assert found['final_cost'] == pytest.approx(known['final_cost'], rel=.01)
    assert found['parts'] == 1
    assert 'its vertices 0 to 199 are 1000 to 1199 in the map' in said
    read = solve_json(capsys, tmp_path / 'out.g2o')
    assert read['final_cost'] == pytest.approx(found['final_cost'], rel=1e-6)
    assert sorted(map(tuple, read['rejected'])) == sorted(map(tuple, found['rejected']))


def test_symbols_stay_and_edges_to_the_other_file_are_used_once(world, tmp_path, capsys):
    paths, between = cut(world, tmp_path, lambda k: (A if k < HALF else B) + k % HALF)
    for path in paths:
        path.write_text(path.read_text() + '\n'.join(between) + '\n')
    assert 'is unknown' in run(capsys, 'solve', paths[0], code=2)[1]
    found, said = merge_json(capsys, *paths, '--output', tmp_path / 'out.g2o')
    assert f'{len(between)} edges to another input given there, too: used once' in said
    assert ids_of(tmp_path / 'out.g2o') == [
        A + k for k in range(HALF)] + [B + k for k in range(HALF)]
    graph, _ = l1.read_graph(tmp_path / 'out.g2o')
    assert np.unique(graph.robot, return_counts=True)[1].tolist() == [HALF, HALF]
    assert len(found['rejected']) == 10 and found['parts'] == 1


def test_what_does_not_join_lies_beside_and_is_said(world, tmp_path, capsys):
    paths, _ = cut(world, tmp_path)
    found, said = merge_json(capsys, *paths, '--output', tmp_path / 'out.g2o', code=4)
    assert found['parts'] == 2
    assert said.count(f'{paths[1]}: nothing that is believed joins it to {paths[0]}') == 1
    _, poses = l1.read_graph(tmp_path / 'out.g2o')
    assert poses[:HALF, 0].max() < poses[HALF:, 0].min()
    alone = [solve_json(capsys, path)['final_cost'] for path in paths]
    assert found['final_cost'] == pytest.approx(sum(alone), rel=1e-3)


def test_one_place_that_alone_joins_is_left_out_and_named(world, tmp_path, capsys):
    paths, between = cut(world, tmp_path)
    ends = np.array([[int(word.partition(':')[2]) for word in line.split()[1:3]]
                     for line in between])
    near = (np.abs(ends[:, None] - ends) < 6).all(axis=2)
    one = near[np.argmax(near.sum(axis=1))]
    assert one.sum() > 3
    loops = listed(tmp_path, [line for line, is_near in zip(between, one, strict=True) if is_near])
    found, said = merge_json(capsys, *paths, '--loops', loops, '--output', tmp_path / 'out.g2o',
                             code=4)
    assert found['doubts'][0]['kind'] == 'parts' and 'no accepted loop joins 2' in said
    assert len(found['doubts'][0]['loops']) == one.sum()


@pytest.mark.parametrize(('line', 'sentence'), [
    ('EDGE_SE2 1:0 3:5 1 0 0 1 0 0 1 0 1', "'3:5': input 3; expected 1 to 2"),
    ('EDGE_SE2 1:0 2:900 1 0 0 1 0 0 1 0 1', 'vertex 900 is not of'),
    ('EDGE_SE2 0 2:9 1 0 0 1 0 0 1 0 1', "'0'; expected NUMBER:ID"),
    ('EDGE_SE2 1:0 2:9 1 0 nan 1 0 0 1 0 1', "'nan' is not a finite number"),
    ('EDGE_SE2 1:9 1:9 1 0 0 1 0 0 1 0 1', 'from a vertex to itself'),
    ('EDGE_SE3:QUAT 1:0 2:9 1 0 0', 'expected `EDGE_SE2 NUMBER:ID NUMBER:ID ...`')])
def test_a_line_that_is_no_loop_is_named(world, tmp_path, capsys, line, sentence):
    paths, between = cut(world, tmp_path)
    said = run(capsys, 'merge', *paths, '--loops', listed(tmp_path, [between[0], line]),
               '--output', tmp_path / 'out.g2o', code=2)[1]
    assert 'loops.txt:2: ' in said and sentence in said and said.count('\n') == 1
    assert not (tmp_path / 'out.g2o').exists()


def test_what_cannot_be_merged_is_refused(world, tmp_path, capsys):
    (first, second), between = cut(world, tmp_path)
    output = ('--output', tmp_path / 'out.g2o')
    assert 'expected 2 or more' in run(capsys, 'merge', first, *output, code=2)[1]
    assert 'ends with .g2o' in run(
        capsys, 'merge', first, second, '--output', tmp_path / 'bag', code=2)[1]
    space = tmp_path / 'space.g2o'
    space.write_text('VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n'
                     f'EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {" ".join("100000100001000100101")}\n')
    assert 'is of SE3; expected SE2' in run(capsys, 'merge', first, space, *output, code=2)[1]
    second.write_text(second.read_text() + 'EDGE_SE2 0 5000 1 0 0 1 0 0 1 0 1\n')
    said = run(capsys, 'merge', first, second, *output, code=2)[1]
    assert 'vertex 5000 is of no input' in said and f'{second}:' in said
    assert 'is an input' in run(capsys, 'merge', first, world, '--output', first, code=2)[1]
    third = tmp_path / 'third.g2o'
    third.write_text('VERTEX_SE2 900 0 0 0\nVERTEX_SE2 901 1 0 0\n'
                     'EDGE_SE2 900 901 1 0 0 1 0 0 1 0 1\nEDGE_SE2 900 7 1 0 0 1 0 0 1 0 1\n')
    (first, second), _ = cut(world, tmp_path)
    said = run(capsys, 'merge', first, second, third, *output, code=2)[1]
    assert f'{third}:4: vertex 7 is of 2 other inputs' in said
    (tmp_path / 'out.g2o').write_text('of others\n')
    assert 'not overwritten' in run(capsys, 'merge', first, world, *output, code=2)[1]


def test_ids_are_shifted_only_where_they_collide(tmp_path, capsys):
    def merged(*graphs, code=4):
        """Merge chains of these ids, which nothing joins; return the ids of the map."""
        paths = [tmp_path / f'{k}.g2o' for k in range(len(graphs))]
        for path, ids in zip(paths, graphs, strict=True):
            path.write_text(''.join(f'EDGE_SE2 {i} {j} 1 0 0 1 0 0 1 0 1\n'
                                    for i, j in zip(ids[:-1], ids[1:], strict=True)))
        said = run(capsys, 'merge', *paths, '--output', tmp_path / 'out.g2o', code=code)[1]
        return said if code == 2 else sorted(ids_of(tmp_path / 'out.g2o'))

    first, second = np.arange(5), np.arange(5, 12)
    assert merged(first, second) == list(range(12))
    assert merged(second, first + 3, first) == [*range(12), 103, 104, 105, 106, 107]
    assert merged(first + A, first + A, first + B) == [
        letter + k for letter in (A, B, ord('c') * SYMBOL) for k in range(5)]
    assert 'cannot be made distinct' in merged([1, 2**55], [1, 1000], code=2)
