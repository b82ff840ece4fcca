# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Each malformed line of a graph file is named, found and expected beside it, in any format.

Numbers are the same whether or not all lines end alike, as where one matrix serves.
"""

import re
from typing import NamedTuple

import numpy as np
import pytest
from records import information_of, read

import l1slam_ros as l1

UNIT = ' '.join('1' if row == column else '0' for row in range(6) for column in range(row, 6))


class Format(NamedTuple):
    """Tags of vertices and edges, a pose and an information in it, a tag of the other manifold."""

    vertex: str
    edge: str
    pose: str
    information: str
    other: str


FORMATS = {
    'g2o': Format('VERTEX_SE2', 'EDGE_SE2', '0 0 0', '1 0 0 1 0 1', 'EDGE3'),
    'toro': Format('VERTEX2', 'EDGE2', '0 0 0', '1 0 1 1 0 0', 'VERTEX_SE3:QUAT'),
    'g2o in space': Format('VERTEX_SE3:QUAT', 'EDGE_SE3:QUAT', '0 0 0 0 0 0 1', UNIT, 'EDGE_SE2'),
    'toro in space': Format('VERTEX3', 'EDGE3', '0 0 0 0 0 0', UNIT, 'VERTEX2')}
SOUND = ['V 7 POSE', 'V 3 POSE', 'E 3 7 POSE INFO', 'V 9 POSE', 'E 7 9 POSE INFO']


@pytest.mark.parametrize('name', FORMATS)
@pytest.mark.parametrize(('line', 'message'), [
    ('E 3 7 POSE', 'E: {few} fields, the information is missing; expected 2 whole and {edge} '
     'finite numbers, or the option `--information X`'),
    ('E 3 7 POSE INFO 1', 'E: {many} fields; expected 2 whole and {edge} finite numbers'),
    ('E 3 7 # POSE INFO', 'E: 2 fields; expected 2 whole'),
    ('V 5 0 0', 'V: 3 fields; expected 1 whole and {vertex} finite numbers'),
    *((f'V 5 {word} TAIL', f'V: {word!r} is not a finite number; expected')
      for word in ('nan', 'x', '0x10', '1_0', '1e999', '1,5')),
    ('V 5 1e31 TAIL', "V: '1e31' is beyond 1e+30; expected"),
    *((f'V {word} POSE', f'V: {word!r} is not a whole number of 64 bits; expected')
      for word in ('5.0', '9223372036854775808')),
    ('E 3 7.5 POSE INFO', "E: '7.5' is not a whole number of 64 bits"),
    ('E 3 7 inf TAIL INFO', "E: 'inf' is not a finite number; expected"),
    ('E 3 7 -1e99 TAIL INFO', "E: '-1e99' is beyond 1e+30; expected"),
    ('E 3 7 POSE NONE', 'information [0 0 0'), ('E 3 7 POSE MINUS', 'information [-1 0 0 0'),
    ('E 3 8 POSE INFO', 'vertex 8 is unknown; expected one of the 3 vertices'),
    ('E 100 3 POSE INFO', 'vertex 100 is unknown; expected one of the 3 vertices'),
    ('V 7 POSE', 'vertex 7 comes twice, first at line 1; expected each once'),
    ('OTHER 5 6', 'OTHER: a line of SE{beside} beside V at line 1; expected all poses in the '
     'plane, or all in space'),
    *((f'{tag} 3 7', f'unknown tag {tag!r}; expected VERTEX_SE2, EDGE_SE2, ')
      for tag in ('EGDE_SE2', 'EDGE_SE3:EXPMAP', 'Vertex2'))])
def test_each_malformed_line_is_named(tmp_path, name, line, message):
    of, path = FORMATS[name], tmp_path / 'a.g2o'
    words = {'V': of.vertex, 'E': of.edge, 'POSE': of.pose, 'TAIL': of.pose[2:],
             'INFO': of.information, 'NONE': of.information.replace('1', '0'),
             'MINUS': of.information.replace('1', '-1'), 'OTHER': of.other}
    pose, edge = len(of.pose.split()), len((of.pose + ' ' + of.information).split())

    def written(text):
        return re.sub('|'.join(rf'\b{word}\b' for word in words), lambda of: words[of[0]], text)

    # A good line follows: it is not the last one that is named, nor the first of its tag.
    path.write_text(written('\n'.join([*SOUND, line, 'E 9 3 POSE INFO\n'])))
    with pytest.raises(l1.L1SlamError) as caught:
        l1.read_graph(path)
    said = written(message).format(few=2 + pose, many=3 + edge, edge=edge, vertex=pose,
                                   beside=2 if 'space' in name else 3)
    assert str(caught.value).startswith(f'{path}:6: {said}') and '\n' not in str(caught.value)


# What edges measure but for x, and their information.
END = '0 0 400 0 0 400 0.0 1e4'
ALIKE = [f'1 2 0.1 {END}', f'2 3 .2 {END}', f'3 4 -5 {END}']


@pytest.fixture
def parsed(tmp_path):
    """Return a function from edges to the ids of their keyframes, measurements, information."""
    def read_edges(texts):
        path = tmp_path / 'a.g2o'
        path.write_text(''.join(f'EDGE_SE2 {text}\n' for text in texts))
        record = read(path)
        factors = record.graph.between
        return record.ids[factors.pairs], factors.measurement, information_of(record.graph)
    return read_edges


@pytest.mark.parametrize('texts', [
    ALIKE, [text.replace(' ', '  ') for text in ALIKE], ALIKE[:1],
    [f'{text} # ours' for text in ALIKE],
    [ALIKE[0], '2 3 .2 0 0 +400 0 0 400 0 1e4', ALIKE[2]]])
def test_lines_that_end_alike_read_as_any_others(parsed, texts):
    ids, measured, information = parsed(texts)
    assert ids.tolist() == [[1, 2], [2, 3], [3, 4]][:len(texts)]
    assert np.array_equal(measured, [[x, 0, 0] for x in (0.1, 0.2, -5)][:len(texts)])
    np.testing.assert_allclose(information, [np.diag([400, 400, 1e4])] * len(texts), rtol=1e-15)


@pytest.mark.parametrize(('middle', 'found'), [
    (f'2 3 # .2 {END}', '2 fields'), (f'2 3 x {END}', "'x' is not a finite number"),
    (f'2 3.5 .2 {END}', "'3.5' is not a whole"), (f'2 3 .2 1{END}x', "'1e4x'"), (END, '8 fields')])
def test_the_first_malformed_line_among_lines_that_end_alike_is_named(parsed, middle, found):
    with pytest.raises(l1.L1SlamError, match=f'a.g2o:2: EDGE_SE2: {found}'):
        parsed([ALIKE[0], middle, ALIKE[2], middle])


@pytest.mark.parametrize('end', ['nan', 'inf', '1e31', '0x1'])
def test_what_all_lines_end_in_is_judged_too(parsed, end):
    with pytest.raises(l1.L1SlamError, match=f'a.g2o:1: EDGE_SE2: {end!r}'):
        parsed([f'{k} 2 .1 0 0 400 0 0 400 0.0 {end}' for k in range(3)])
