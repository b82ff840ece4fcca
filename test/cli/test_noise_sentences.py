# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `l1slam solve` says of suspects, and of noise that is not the noise stated."""

import re

import pytest
from command import run, solve_json
from worlds import edited, made


@pytest.fixture(scope='module')
def world(tmp_path_factory):
    """Return a world whose noise is as stated."""
    return made(tmp_path_factory.mktemp('world') / 'world.g2o', 400, 900, '--seed', 2).read_text()


def told(path, text, odometry=1.0, loops=1.0, identity=False):
    """Write the world with sigmas that many times those it has; or of odometry, the identity."""
    path.write_text(text)

    def change(line, is_odometry):
        times = odometry if is_odometry else loops
        line[6:] = '100101' if is_odometry and identity else [
            repr(float(number) / times**2) for number in line[6:]]

    return edited(path, change)


NOISY_ODOMETRY = (r'the odometry is about (\S+) times as noisy as stated: it says little about '
                  'loops between distant times')
NOISY_LOOPS = (r'the loops are about (\S+) times as noisy as stated: a false loop that is off by '
               'little cannot be told from noise')
ACCURATE_LOOPS = (r'the loops are about (\S+) times as accurate as stated: weighed as stated, '
                  'they move the map less than they could; expected covariances of what the front '
                  'end measures')


@pytest.mark.parametrize('odometry, loops, expected', [
    (1, 1, {}), (0.2, 1, {NOISY_ODOMETRY: 5}), (1, 0.2, {NOISY_LOOPS: 5}),
    (0.2, 0.25, {NOISY_ODOMETRY: 5, NOISY_LOOPS: 4}), (1, 100, {ACCURATE_LOOPS: 100}),
    (1 / 1.5, 1, {})])
def test_what_is_twice_as_noisy_as_it_says_or_more_is_told(
        capsys, tmp_path, world, odometry, loops, expected):
    said = run(capsys, 'solve', told(tmp_path / 'a.g2o', world, odometry, loops), code=None)[0]
    for sentence in NOISY_ODOMETRY, NOISY_LOOPS, ACCURATE_LOOPS:
        found = re.search(f'^{sentence}$', said, re.M)
        assert bool(found) == (sentence in expected), said
        if found:
            assert float(found[1]) == pytest.approx(expected[sentence], rel=0.3)


def test_where_the_odometry_alone_states_the_identity_it_alone_is_said_to(capsys, tmp_path, world):
    said = run(capsys, 'solve', told(tmp_path / 'a.g2o', world, identity=True), code=None)[0]
    assert re.findall('the information of the (.*) is the identity', said) == ['odometry']


def test_suspects_are_counted_apart(capsys, tmp_path):
    path = made(tmp_path / 'a.g2o', 150, 155, '--seed', 0, '--false-loops', 10)
    said = run(capsys, 'solve', path, code=None)[0].splitlines()
    report = solve_json(capsys, path, code=None)
    assert len(report['suspect']) == 1 and f'{len(report["rejected"])} of 16 loops refused' in said
    assert '1 loop suspect and left out: nothing confirms it' in said
