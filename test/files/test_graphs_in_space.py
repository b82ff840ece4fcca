# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Graph files of poses in space: both formats, both readings of the rotation, malformed lines."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from records import information_of, read
from scipy.spatial.transform import Rotation
from worlds import write_g2o

import l1slam_ros as l1

UNIT = ' '.join('1' if row == column else '0' for row in range(6) for column in range(row, 6))
SQUARE = f"""\
VERTEX_SE3:QUAT 7 1.5 0 0.25 0 0 0.6 0.8
VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1
EDGE_SE3:QUAT 3 7 1 0.25 2 0.48 0 0.36 -0.8 {UNIT}
FIX 3
"""
TORO_SQUARE = f"""\
VERTEX3 7 1.5 0 0.25 0 0 0.6
VERTEX3 3 0 0 0 0 0 0
EDGE3 3 7 1 0.25 2 0.3 -0.2 0.1 {UNIT}
# as many lines
"""


@pytest.fixture
def write(tmp_path):
    def file(content, name='a.g2o'):
        path = tmp_path / name
        path.write_text(content)
        return path
    return file


def test_a_small_graph(write):
    record = read(write(SQUARE))
    assert record.poses.shape == (2, 7)
    assert record.ids.tolist() == [3, 7] and record.skipped == ()
    assert_allclose(record.poses, [[0, 0, 0, 0, 0, 0, 1], [1.5, 0, 0.25, 0, 0, 0.6, 0.8]])
    assert_allclose(record.graph.between.measurement, [[1, 0.25, 2, -0.48, 0, -0.36, 0.8]])


@pytest.mark.parametrize(('reading', 'diagonal'), [('quaternion', 0.25), ('angle', 1.0)])
def test_the_rotation_block_is_of_what_it_is_said_to_be(write, reading, diagonal):
    """Of the vector part, half the angle: a quarter; of the blocks beside it a half."""
    beside = SQUARE.replace(UNIT, UNIT.replace('1 0 0 0 0 0', '1 0 0 0.5 0 0', 1))
    information = information_of(read(write(beside), rotation_information=reading).graph)[0]
    assert_allclose(np.diag(information), [1, 1, 1, *[diagonal] * 3])
    assert_allclose(information[0, 3], 0.5 * np.sqrt(diagonal))
    toro = information_of(read(write(TORO_SQUARE, 'a.graph'),
                               rotation_information=reading).graph)[0]
    assert_allclose(toro, np.eye(6), atol=1e-15)


def test_angles_of_toro_are_turns_about_z_then_y_then_x(write):
    measurement = read(write(TORO_SQUARE, 'a.graph')).graph.between.measurement[0]
    expected = Rotation.from_euler('ZYX', [0.1, -0.2, 0.3]).as_quat()
    assert_allclose(measurement, [1, 0.25, 2, *expected], atol=1e-15)


@pytest.mark.parametrize('reading', ['quaternion', 'angle'])
def test_round_trip(tmp_path, rng, reading):
    A, measured = rng.normal(size=(7, 6, 6)), rng.normal(size=(7, 7))
    measured[:, 3:] /= np.linalg.norm(measured[:, 3:], axis=1, keepdims=True)
    source = write_g2o(tmp_path / 'a.g2o', [(k, k + 1) for k in range(7)], measured,
                       A @ A.transpose(0, 2, 1) + 0.1 * np.eye(6))
    record = read(source, rotation_information=reading)
    poses = record.graph.between.measurement[[*range(7), 0]]
    record.write(tmp_path / 'b.g2o', poses, rotation_information=reading)
    back = read(tmp_path / 'b.g2o', rotation_information=reading)
    assert_array_equal(poses, back.poses)
    assert_array_equal(record.graph.between.measurement, back.graph.between.measurement)
    assert_allclose(information_of(record.graph), information_of(back.graph), atol=1e-12)


@pytest.mark.parametrize('turn', ['0 0 0 0', '0 0 0 1.2', '3 0 0 1'])
def test_a_quaternion_that_is_none_is_named(write, turn):
    expected = r'a\.g2o:5: quaternion \[.*\]; expected one of norm 1'
    with pytest.raises(l1.L1SlamError, match=expected):
        l1.read_graph(write(SQUARE + f'VERTEX_SE3:QUAT 9 0 0 0 {turn}\n'))


ABSOLUTE = f"""\
PARAMS_SE3OFFSET 4 0 0 0 0 0 0 1
VERTEX_PLANE 20 0 0 1 0
EDGE_SE3_PLANE 7 20 0 0 1 0.5 10 0 0 10 0 10
EDGE_SE3_PRIOR 7 4 1 2 3 0 0 0.6 0.8 {UNIT}
EDGE_SE3_XYZPRIOR 3 4 1 2 3 10 0 0 10 0 30
EDGE_SE3_PRIORXYZ 3 1 2 4 10 0 0 10 0 30
EDGE_SE3_PRIORXY 7 4 5 20 0 20
"""


def test_absolute_poses_and_the_position_fixes_of_hdl_graph_slam(write, tmp_path):
    """Those without a height say nothing of it; the floor it saw is no part of a pose graph."""
    record = read(write(SQUARE + ABSOLUTE))
    sentence, = record.skipped
    assert "1 'VERTEX_PLANE', 1 'EDGE_SE3_PLANE'" in sentence
    for _ in range(2):
        factors = record.graph.between
        assert factors.i.tolist() == [0, *[-1] * 4] and factors.j.tolist() == [1, 1, 0, 0, 1]
        assert_allclose(factors.measurement[1:3], [[1, 2, 3, 0, 0, 0.6, 0.8],
                                                   [1, 2, 3, 0, 0, 0, 1]])
        assert_allclose(factors.measurement[3:, :3], [[1, 2, 4], [4, 5, 0]])
        assert_allclose([np.diag(one) for one in information_of(record.graph)[1:]],
                        [[1, 1, 1, 0.25, 0.25, 0.25], *[[10, 10, 30, 0, 0, 0]] * 2,
                         [20, 20, 0, 0, 0, 0]])
        record.write(tmp_path / 'b.g2o')
        record = read(tmp_path / 'b.g2o')
    assert (tmp_path / 'b.g2o').read_text().count('PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1') == 1


def test_what_was_measured_elsewhere_than_at_the_robot_is_named(write):
    beside = ABSOLUTE.replace('4 0 0 0', '4 0 0.5 0')
    with pytest.raises(l1.L1SlamError, match=r'a\.g2o:8: EDGE_SE3_PRIOR: the pose is that of'):
        l1.read_graph(write(SQUARE + beside))


def test_loops_that_could_be_switched_off_are_loops(write):
    """Whatever the number of the switch, which is no vertex, nor that of an offset."""
    plain = SQUARE + f'EDGE_SE3:QUAT 7 3 0 1 2 0 0 0 1 {UNIT}\n'
    lines = plain.replace('QUAT 7 3 0 1', 'QUAT 7 3 4 0 1').replace(
        'EDGE_SE3:QUAT 7', 'PARAMS_SE3OFFSET 4 0 0.5 0 0 0 0 1\nVERTEX_SWITCH 4 1\n'
        'EDGE_SWITCH_PRIOR 4 1 1.0\nEDGE_SE3_SWITCHABLE 7')
    record, expected = (read(write(content)) for content in (lines, plain))
    assert record.ids.tolist() == [3, 7] and len(record.skipped) == 1
    for name in 'i', 'j', 'measurement', 'sqrt_information':
        assert_array_equal(getattr(record.graph.between, name),
                           getattr(expected.graph.between, name))


def line(i, j):
    return f'EDGE_SE3:QUAT {i} {j} 1 0 0 0 0 0 1 {UNIT}\n'


@pytest.mark.parametrize(('fixed', 'edges', 'ids'), [
    (5, ((5, 3), (7, 3), (7, 9)), [3, 7, 9]),  # as hdl_graph_slam numbers them
    (3, ((5, 3), (7, 3), (7, 9)), [3, 5, 7, 9]),
    (5, ((5, 3), (5, 7), (7, 9)), [3, 5, 7, 9]),
    (5, ((5, 3), (7, 3), (5, 9), (7, 9)), [3, 5, 7, 9]),
    (9, ((5, 3), (7, 5), (7, 9), (7, 3)), [3, 5, 7, 9]),
])
def test_an_anchor_beside_the_way_is_left_out(write, fixed, edges, ids):
    """It only holds the graph in place; a keyframe that is fixed stays."""
    vertices = ''.join(f'VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1\n' for k in (3, 5, 7, 9))
    lines = ''.join(line(*pair) for pair in edges)
    for content in (vertices + lines, lines):
        record = read(write(f'FIX {fixed}\n{content}'))
        assert record.ids.tolist() == ids
        assert len(record.graph.between) == len(edges) - (len(ids) < 4)
        assert record.poses is None or record.poses[:, 0].tolist() == ids
        assert any('vertex 5 and its edge are not used' in said
                   for said in record.skipped) == (len(ids) < 4)
