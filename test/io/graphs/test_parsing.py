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

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.files import TextLines
from l1slam_ros.io.graphs.parsing import parse_rows

ALIKE = ['1 2 0.1 400 0.0 1e4', '2 3 .2 400 0.0 1e4', '3 4 -5 400 0.0 1e4']


def parsed(texts, values=4):
    """Return ids and values of lines with two ids."""
    return parse_rows('a.g2o', 'EDGE', TextLines([*range(1, 1 + len(texts))], texts), 2, values)


@pytest.mark.parametrize('texts', [
    ALIKE, [text.replace(' ', '  ') for text in ALIKE], [f'{text} ' for text in ALIKE],
    [text.replace(' ', '\t') for text in ALIKE], ALIKE[:1], [f'{text} # ours' for text in ALIKE],
    [ALIKE[0], '2 3 .2 +400 0 1e4', ALIKE[2]]])
def test_lines_that_end_alike_read_as_any_others(texts):
    ids, values = parsed(texts)
    assert ids.tolist() == [[1, 2], [2, 3], [3, 4]][:len(texts)]
    assert np.array_equal(
        values, [[first, 400, 0, 1e4] for first in (0.1, 0.2, -5)][:len(texts)])


def test_of_lines_that_are_all_alike_the_whole_numbers_are_read():
    ids, values = parsed(['7 7 7 7 7 7'] * 3)
    assert ids.tolist() == [[7, 7]] * 3 and values.tolist() == [[7, 7, 7, 7]] * 3


@pytest.mark.parametrize(('middle', 'found'), [
    ('2 3 # .2 400 0.0 1e4', '2 fields'), ('2 3 .2 # 400 0.0 1e4', '3 fields'),
    ('2 3 .2 1 400 0.0 1e4', '7 fields'), ('2 3 400 0.0 1e4', '5 fields'),
    ('2 3 x 400 0.0 1e4', "'x' is not a finite number"), ('2 3 nan 400 0.0 1e4', "'nan'"),
    ('2 3.5 .2 400 0.0 1e4', "'3.5' is not a whole number"), ('2 3 .2 1400 0.0 1e4x', "'1e4x'"),
    ('2 3 .21400 0.0 1e4', '5 fields'), ('400 0.0 1e4', '3 fields')])
def test_a_malformed_line_among_lines_that_end_alike_is_named(middle, found):
    with pytest.raises(FileError, match=f'a.g2o:2: EDGE: {found}'):
        parsed([ALIKE[0], middle, ALIKE[2]])


@pytest.mark.parametrize('end', ['nan', 'inf', '1e31', '0x1'])
def test_what_all_lines_end_in_is_judged_too(end):
    with pytest.raises(FileError, match=f'a.g2o:1: EDGE: {end!r}'):
        parsed([f'{k} 2 .1 400 0.0 {end}' for k in range(3)])
