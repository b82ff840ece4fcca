# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Messages counted by the numbers that publishers give them."""

import pytest

pytest.importorskip('rclpy')

from l1slam_ros.ros.threads.intake import Traffic


def count(numbers, publishers=1):
    traffic = Traffic(lambda: publishers)
    for number in numbers:
        traffic.note({'publication_sequence_number': number})
    return traffic.received, traffic.lost


@pytest.mark.parametrize('numbers, lost', [
    ([], 0),
    ([1, 2, 3], 0),
    ([500, 501], 0),  # whoever comes late has lost nothing
    ([1, 2, 5, 6, 9], 4),
    ([7, 8, 1, 2, 3], 0),  # a publisher that began anew
    ([7, 8, 1, 2, 5], 2),
    ([None, None], 0),  # some middlewares do not count
])
def test_gaps_are_what_was_lost(numbers, lost):
    assert count(numbers) == (len(numbers), lost)


@pytest.mark.parametrize('numbers, lost', [
    ([1, 1, 2, 2, 3, 3], 0),
    ([1, 9000, 2, 9001, 3], 0),  # one has spoken for long before anybody listened
    ([5, 1, 6, 2, 9, 4], 3),
    ([1, 50, 2, 60, 5, 61], 11),
])
def test_two_publishers_are_told_apart_by_their_numbers(numbers, lost):
    assert count(numbers, publishers=2) == (len(numbers), lost)


def test_who_has_gone_is_forgotten():
    publishers = 2
    traffic = Traffic(lambda: publishers)
    for number in (1, 5000, 2):
        traffic.note({'publication_sequence_number': number})
    publishers = 1
    traffic.values()
    for number in (3, 5003):
        traffic.note({'publication_sequence_number': number})
    assert traffic.lost == 4999
    assert traffic.values()['received'] == '5'


def test_numbers_that_begin_anew_are_of_another_publisher():
    traffic, found = Traffic(lambda: 1), []
    for number in (7, 8, 12, 1, 2, None, 3):
        traffic.note({'publication_sequence_number': number})
        found.append(traffic.other_source)
    assert found == [False, False, False, True, False, False, False]


@pytest.mark.parametrize('numbers, mixed', [
    ([1, 2, 5, 6], False),
    ([7, 8, 1, 2, 5], False),  # a publisher that began anew
    ([500, 501, 1, 2, 3], False),  # another one took over
    ([1, 501, 2], True),
    ([1, 501, 2, 502, 3], True),
])
def test_messages_of_two_publishers_that_come_by_turns_are_told(numbers, mixed):
    traffic = Traffic(lambda: 2)
    for number in numbers:
        traffic.note({'publication_sequence_number': number})
    assert traffic.mixed == mixed
