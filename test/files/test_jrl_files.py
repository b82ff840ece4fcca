# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""JRL files: what their own library writes is read, and what we write it can read."""

import json
import math

import numpy as np
import pytest
from command import run, solve_json
from numpy.testing import assert_allclose, assert_array_equal
from records import beside, error_of, read
from worlds import drifting, edited, made

import l1slam_ros as l1

A, B = ord('a') << 56, ord('b') << 56
SECOND = 10**9


def pose2(x, y, theta):
    return {'type': 'Pose2', 'x': x, 'y': y, 'theta': theta}


def pose3(x, yaw):
    return {'type': 'Pose3', 'translation': [x, 0.5, 0.25],
            'rotation': [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]}


def between(i, j, pose, covariance):
    return {'type': f'BetweenFactor{pose["type"]}', 'key1': i, 'key2': j, 'measurement': pose,
            'covariance': covariance}


def plane(i, j, x):
    return between(i, j, pose2(x, 0.0, 0.1), [0.04, 0.01, 0, 0.01, 0.05, 0, 0, 0, 0.01])


def team():
    """Two robots in the plane as the library writes them: null where there is nothing."""
    prior = {'type': 'PriorFactorPose2', 'key': A, 'prior': pose2(1, 2, 0.5),
             'covariance': [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01]}
    t = 1_700_000_000 * SECOND
    return {
        'name': 'team', 'robots': [97, 98],
        'measurements': {
            'a': [{'stamp': t, 'measurements': [prior]},
                  {'stamp': t + 2 * SECOND, 'measurements': [plane(A, A + 1, 1.0)]},
                  {'stamp': t + 4 * SECOND, 'measurements': [
                      plane(A + 1, A + 2, 1.0), plane(A, A + 2, 2.0), plane(A + 2, B, 0.5)]}],
            'b': [{'stamp': t + SECOND},
                  {'stamp': t + 3 * SECOND, 'measurements': [plane(B, B + 1, 1.0)]}]},
        'groundtruth': {'a': [{'key': A + k, **pose2(k, 0, 0)} for k in range(3)],
                        'b': [{'key': B + k, **pose2(3 + k, 0, 0)} for k in range(2)]},
        'initialization': {
            'a': [{'key': A + k, **pose2(k + 0.125, 0, 0)} for k in range(3)],
            'b': [{'key': B + k, **pose2(3 + k, 0, 0.5)} for k in range(2)]},
        'potential_outlier_factors': {'a': [[2, 1], [2, 2]], 'b': None},
        'outlier_factors': {'a': [[2, 2]], 'b': []}}


def space():
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])
    covariance[0, 4] = covariance[4, 0] = 5e-4
    listed = covariance.ravel().tolist()
    return {'name': 'space', 'robots': [97], 'measurements': {'a': [
        {'stamp': k, 'measurements': [between(A + k, A + k + 1, pose3(1.0, 0.25), listed)]}
        for k in range(4)]}}


@pytest.fixture
def put(tmp_path):
    def file(document, name='team.jrl'):
        path = tmp_path / name
        if name.endswith('.cbor'):
            path.write_bytes(pytest.importorskip('cbor2').dumps(document))
        else:
            path.write_text(document if isinstance(document, str) else json.dumps(document))
        return path
    return file


def document_of(path):
    if path.suffix == '.cbor':
        return pytest.importorskip('cbor2').loads(path.read_bytes())
    return json.loads(path.read_text())


def leaves(part, way=()):
    """Return all that is said in a part of a document, by where it is; numbers to 13 digits."""
    if isinstance(part, dict | list):
        items = part.items() if isinstance(part, dict) else enumerate(part)
        return {place: leaf for name, inner in items
                for place, leaf in leaves(inner, (*way, name)).items()}
    if part is None:
        return {}
    is_exact = isinstance(part, str) or way[-1] in ('key', 'key1', 'key2', 'stamp')
    return {way: part if is_exact else f'{part + 0.0:.13g}'}


def factors_of(path):
    """Return the factors of a file by their keys."""
    return {(factor['key1'], factor['key2']): factor
            for entries in document_of(path)['measurements'].values() for entry in entries
            for factor in entry.get('measurements', ()) if 'key2' in factor}


@pytest.mark.parametrize('name', ['team.jrl', 'team.jrl.cbor'])
def test_a_team_is_read(put, capsys, tmp_path, name):
    document = team()
    document['measurements']['a'][1]['measurements'].append(
        {'type': 'RangeFactorPose2', 'key1': A, 'key2': B, 'measurement': 3.0})
    document['initialization']['a'].append({'key': B, **pose2(99, 0, 0)})
    record = read(put(document, name))
    factors = record.graph.between
    assert_array_equal(record.ids, [A, A + 1, A + 2, B, B + 1])
    assert_array_equal(record.graph.predecessor, [-1, 0, 1, -1, 3])
    assert_array_equal(record.graph.robot, [0, 0, 0, 1, 1])
    assert_array_equal(factors.i, [-1, 0, 1, 0, 2, 3])
    assert_array_equal(factors.is_odometry, [False, True, True, False, False, True])
    assert_array_equal((record.stamps - record.stamps[0]) // SECOND, [0, 2, 4, 1, 3])
    # Of a key of which two robots say something its own robot is right.
    assert_allclose(record.poses[:, 0], [0.125, 1.125, 2.125, 3, 4])
    assert record.skipped == ('1 RangeFactorPose2 is not used: no pose factor',)
    covariance = np.linalg.inv(np.swapaxes(factors.sqrt_information, 1, 2)
                               @ factors.sqrt_information)
    assert_allclose(covariance[1], [[0.04, 0.01, 0], [0.01, 0.05, 0], [0, 0, 0.01]], atol=1e-15)
    said = run(capsys, 'info', put(document, name))[0]
    assert 'robots      2: a, b' in said and 'jump' not in said and 'gap' not in said
    assert 'known false 0 within a robot, 1 of 1 between robots' in said
    record.write(tmp_path / 'out.g2o')
    again = read(tmp_path / 'out.g2o')
    assert_array_equal(again.ids, record.ids)
    assert_array_equal(again.graph.predecessor, record.graph.predecessor)


def test_covariances_in_space_have_the_rotation_first(put):
    record = read(put(space()))
    root = record.graph.between.sqrt_information[0]
    covariance = np.linalg.inv(root.T @ root)
    assert_allclose(np.diagonal(covariance), [0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4])
    assert covariance[1, 3] == pytest.approx(5e-4)
    assert_allclose(record.graph.between.measurement[0],
                    [1, 0.5, 0.25, 0, 0, math.sin(0.125), math.cos(0.125)])
    assert record.stamps is None and record.poses is None


@pytest.mark.parametrize('document', [team, space])
@pytest.mark.parametrize('name', ['out.jrl', 'out.cbor'])
def test_written_it_is_what_was_read(put, tmp_path, document, name):
    """Keys, stamps, entries, flags, truth, numbers: as the library wrote them."""
    record, out = read(put(document())), tmp_path / name
    record.write(out)
    record.write(out)  # what this program wrote may be replaced
    found = document_of(out)
    assert leaves({part: found[part] for part in document()}) == leaves(document())
    back = read(out)
    assert_array_equal(back.ids, record.ids)
    assert_array_equal(back.graph.between.pairs, record.graph.between.pairs)


def test_what_was_left_out_is_an_outlier_and_comes_back(put, tmp_path):
    record, out, again = read(put(team())), tmp_path / 'out.jrl', tmp_path / 'again.jrl'
    record.write(out, inliers=np.array([True, True, True, False, True, True]))
    read(out).write(again)
    for path in out, again:
        assert document_of(path)['outlier_factors'] == {'a': [[2, 1]], 'b': []}
    # What the first file knew to be false is still known.
    read(put(team())).write(out)
    assert document_of(out)['outlier_factors'] == {'a': [[2, 2]], 'b': []}


def test_odometry_that_is_corrected_comes_back_as_it_was_measured(capsys, tmp_path):
    path = edited(made(tmp_path / 'a.g2o', 300, 480, '--false-loops', 10), drifting)
    out = tmp_path / 'out.jrl'
    drift = solve_json(capsys, path, '--output', out)['drift']
    assert drift == pytest.approx(-0.02, abs=2e-3)
    measured, back = (read(one).graph.between for one in (path, out))
    for row in range(5):
        x, y, turn = measured.measurement[row]
        found = factors_of(out)[row, row + 1]['measurement']['theta']
        assert found == pytest.approx(turn + drift * math.hypot(x, y))
    assert_allclose(back.measurement, measured.measurement, atol=1e-12)


def test_times_and_what_is_not_said_survive(tmp_path):
    """A position without a heading is a prior whose heading has an enormous variance."""
    g2o, jrl, again = (tmp_path / name for name in ('a.g2o', 'a.jrl', 'b.g2o'))
    g2o.write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n'
                   'EDGE_PRIOR_SE2_XY 2 5 6 4 1 4\n')
    beside(g2o, 'stamps').write_text('0 5\n1 6\n2 7\n')
    record = read(g2o)
    record.write(jrl)
    read(jrl).write(again)
    back = read(again)
    assert 'EDGE_PRIOR_SE2_XY 2 5.0 6.0 ' in again.read_text()
    assert_allclose(back.graph.between.sqrt_information,
                    record.graph.between.sqrt_information, rtol=1e-12, atol=1e-12)
    assert_array_equal(back.stamps, np.array([5, 6, 7]) * SECOND)
    assert_array_equal(record.stamps, back.stamps)


def test_what_the_file_says_is_false_is_compared_with_what_is_refused(put, tmp_path, capsys):
    path, stranger = put(team()), put(team(), 'theirs.jrl')
    said, _ = run(capsys, 'solve', path, '--robust', '--reference', path, code=None)
    assert 'of 1 loop that the file says are false' in said
    assert 'was not written by' in run(capsys, 'convert', path, stranger, code=2)[1]


def test_in_python(put, tmp_path):
    out = tmp_path / 'out.jrl'
    graph, poses = l1.read_graph(put(team()))
    graph.add_between(np.array([1]), np.array([4]), np.zeros((1, 3)), np.eye(3)[None])
    l1.write_graph(out, graph, poses)
    assert (A + 1, B + 1) in factors_of(out) and document_of(out)['name'] == 'team'


def test_truth(put, capsys, tmp_path):
    """Of the keys of the team; a graph in space takes that of the plane, too."""
    row, keys = tmp_path / 'row.g2o', (A, A + 1, A + 2, B, B + 1)
    unit = ' '.join('1' if i == j else '0' for i in range(6) for j in range(i, 6))
    row.write_text(''.join(f'EDGE_SE3:QUAT {i} {j} 1 0 0 0 0 0 1 {unit}\n'
                           for i, j in zip(keys, keys[1:], strict=False)))
    for off in 0, 1:
        true = team()
        true['groundtruth']['b'][1]['y'] = off
        found = solve_json(capsys, row, '--reference', put(true), code=None)
        assert found['ate_poses'] == 5 and (found['ate'] > 0.1) == off
    said = run(capsys, 'solve', row, '--reference', put(space(), 'b.jrl'), code=2)[1]
    assert 'has no groundtruth' in said


def changed(path, value):
    document = team()
    *way, last = path
    part = document
    for step in way:
        part = part[step]
    if value is None:
        del part[last]
    else:
        part[last] = value
    return document


@pytest.mark.parametrize('path, value, said', [
    (('measurements',), None, 'measurements: nothing; expected a value'),
    (('measurements', 'a', 1, 'stamp'), -1, 'measurements.a[1].stamp: -1; expected a whole'),
    (('measurements', 'a', 1, 'measurements', 0, 'key2'), 2**64, 'a number beyond 64 bits'),
    (('measurements', 'a', 1, 'measurements', 0, 'covariance'), [1.0] * 8,
     'measurements.a[1].measurements[0].covariance: a list of 8; expected a list of 9 numbers'),
    (('measurements', 'a', 1, 'measurements', 0, 'covariance'), [0.0] * 9, 'variances of 1e-30'),
    (('measurements', 'a', 1, 'measurements', 0, 'covariance'), [1, 1, 0, 0, 1, 0, 0, 0, 1],
     'expected a symmetric matrix'),
    (('measurements', 'a', 1, 'measurements', 0, 'measurement', 'x'), 'here',
     "measurements.a[1].measurements[0].measurement.x: 'here'; expected a number"),
    (('measurements', 'a', 1, 'measurements', 0),
     between(A, A + 1, pose3(1, 0), np.eye(6).ravel().tolist()), 'expected all poses in the'),
    (('robots',), [[]], 'robots[0]: a list of 0; expected the number of a character'),
])
def test_what_is_wrong_is_named(put, path, value, said):
    file = put(changed(path, value))
    assert said in error_of(l1.read_graph, file)


@pytest.mark.parametrize('text, said', [
    ('', 'not JSON'), ('[' * 100_000, 'too deeply'), ('[1]', 'expected an object'),
    ('{"a":' * 3000, 'too deeply'), ('1' * 5000, 'too many digits'), ('{"a": NaN', 'not JSON'),
    ('{"measurements": {}}', 'no edges'), ('{"measurements": {"ab": []}}', 'single character')])
def test_text_that_is_none(put, text, said):
    with pytest.raises(l1.L1SlamError, match=said):
        l1.read_graph(put(text))


@pytest.mark.parametrize('content', [
    '', '81' * 1000, '9bffffffffffffffff', '7bffffffffffffffff61', '82d81c80d81d00',
    'c4821b0000000fffffffff03'])
def test_cbor_that_asks_for_more_than_it_is(tmp_path, content):
    pytest.importorskip('cbor2')
    path = tmp_path / 'a.cbor'
    path.write_bytes(bytes.fromhex(content))
    with pytest.raises(l1.L1SlamError):
        l1.read_graph(path)


def test_a_file_too_large_is_not_read(tmp_path):
    path = tmp_path / 'a.jrl'
    with path.open('wb') as file:
        file.truncate(2**29 + 1)
    with pytest.raises(l1.L1SlamError, match='expected at most 536,870,912'):
        l1.read_graph(path)
