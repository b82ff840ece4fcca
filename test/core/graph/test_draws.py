# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
import numpy as np

from l1slam_ros.core.graph.draws import keys, signs

N = 4000
K = 3
Q = 24
ONE = np.arange(N)


def test_signs_look_like_independent_tosses_of_a_coin():
    drawn = signs(keys(ONE, ONE + 1), K, Q).reshape(N, K * Q).astype(float)
    assert set(np.unique(drawn)) == {-1.0, 1.0}
    assert np.abs(drawn.mean(axis=0)).max() < 5 / np.sqrt(N)
    between = drawn.T @ drawn / N - np.eye(K * Q)
    assert np.abs(between).max() < 5 / np.sqrt(N)
    neighbours = (drawn[1:] * drawn[:-1]).mean(axis=0)
    assert np.abs(neighbours).max() < 5 / np.sqrt(N)


def test_they_hang_on_the_keyframes_alone():
    shuffled = np.random.default_rng(0).permutation(N)
    expected = keys(ONE, ONE + 1)
    assert np.array_equal(keys(ONE[shuffled], ONE[shuffled] + 1), expected[shuffled])
    assert np.array_equal(keys(ONE + 1, ONE), expected)
    assert np.array_equal(keys(ONE[5:9], ONE[5:9] + 1), expected[5:9])


def test_factors_of_the_same_keyframes_draw_for_themselves():
    twice = keys(np.array([3, 5, 3, -1, -1]), np.array([4, 9, 4, 7, 7]))
    assert len(np.unique(twice)) == 5
