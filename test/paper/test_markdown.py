# SPDX-License-Identifier: Apache-2.0
"""Tables, lists and numbers of the report."""

import pytest

from l1slam_ros.paper import markdown


def test_a_table_has_words_left_and_numbers_right():
    assert markdown.table(['of', 'cost'], [['Intel', '1']]) == [
        '| of | cost |', '| --- | ---: |', '| Intel | 1 |']
    assert markdown.table(['a', 'b'], [], words=2)[1] == '| --- | --- |'


@pytest.mark.parametrize(('words', 'text'), [
    (['a'], 'a'), (['a', 'b'], 'a and b'), (['a', 'b', 'c'], 'a, b and c')])
def test_listed(words, text):
    assert markdown.listed(words) == text


def test_numbers_are_printed_as_in_the_paper():
    assert markdown.cost(52064000.0) == '5.2064e7' and markdown.cost(982.0514) == '982.051'
    assert markdown.percent(0.0213) == '2.1%' and markdown.metres(0.126) == '0.13 m'
    assert [markdown.milliseconds(s) for s in (0.0003, 2.31, None)] == [
        '0.3', '2310', 'did not finish']
    assert markdown.bullets(iter(['one'])) == ['- one']
