# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What is said of a way whose length only the wheels know."""

import numpy as np
import pytest
from command import run
from rooms import along, box, drive, write_log

CORRIDOR = box(0, 0, 60, 2)
# A door frame every 3 m.
FRAMES = np.concatenate([box(x, 1.8, x + 0.3, 2.0) for x in np.arange(2.0, 60.0, 3.0)])


@pytest.fixture
def said_of(capsys, tmp_path):
    """Return a function from walls to what is said of a drive along y = 1, by a near laser."""
    def near(ranges, *_):
        return np.where(ranges < 8.0, ranges, np.inf)

    def said(walls, first, last):
        true = along(np.array([(first, 1.0), (last, 1.0)]), 0.25)
        write_log(tmp_path / 'a.clf', *drive(true, 1, walls, near))
        err = run(capsys, 'convert', tmp_path / 'a.clf', tmp_path / 'a.g2o')[1]
        return [line.removeprefix('l1slam: ') for line in err.splitlines() if 'wheels say' in line]
    return said


def test_a_bare_corridor_is_as_long_as_the_wheels_say_and_that_is_said_once(said_of):
    sentence, = said_of(CORRIDOR, 10.0, 30.0)
    assert sentence.startswith('scans did not show over 5 m how far the robot went')
    assert sentence.endswith('(1 time)')


@pytest.mark.parametrize('walls, first, last', [
    (np.concatenate((CORRIDOR, FRAMES)), 10.0, 30.0), (CORRIDOR, 52.5, 59.0),
    (CORRIDOR, 10.0, 13.0)],
    ids=['door frames', 'its end is seen', 'a short way'])
def test_where_scans_show_the_way_or_it_is_short_nothing_is_said(said_of, walls, first, last):
    assert not said_of(walls, first, last)
