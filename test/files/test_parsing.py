# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Numbers of lines are the same whether or not all lines end alike, as where one matrix serves."""

import numpy as np
import pytest
from records import information_of, read

import l1slam_ros as l1

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
