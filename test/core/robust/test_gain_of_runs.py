# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A run of loops of a place that was known before counts as a place that a cut wins or loses."""

from types import SimpleNamespace

import numpy as np
import pytest

from l1slam_ros.core.robust import pairwise_consistency
from l1slam_ros.core.robust.pairwise_consistency import NO_GROUP, gain_of

_OF_A_PLACE = 12.0


def _state(accepted):
    """Return what a gain is worked out from: ten loops of one place, which of them are in."""
    given = SimpleNamespace(place=np.zeros(10, int), is_loop=np.ones(10, bool),
                            log_odds_of_place=_OF_A_PLACE)
    return SimpleNamespace(given=given, accepted=np.isin(np.arange(10), accepted))


@pytest.fixture(autouse=True)
def _six_loops_are_a_run(monkeypatch):
    monkeypatch.setattr(pairwise_consistency, 'runs',
                        lambda _, rows: [NO_GROUP] if len(rows) >= 6 else [])


@pytest.mark.parametrize(('before', 'stated', 'after', 'gain'), [
    (2, 2, 10, _OF_A_PLACE), (2, 2, 6, 0.0), (2, 10, 10, 0.0), (10, 10, 2, -_OF_A_PLACE)])
def test_a_run_of_a_known_place_is_won_or_lost(before, stated, after, gain):
    states = (_state(range(count)) for count in (before, stated, after))
    assert gain_of(*states) == gain
