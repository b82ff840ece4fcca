# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Bags are walked without their library; damage is an error to who wants no part."""

import pytest
from worlds import simulated_bag

from bags import KINDS, mcap_file, recording_of
from l1slam_ros.core.errors import L1SlamError
from l1slam_ros.io.bags.bag_files import storage_files
from l1slam_ros.io.bags.damaged.salvage import Salvage
from l1slam_ros.io.bags.reader import read_messages, read_raw


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of this package: 200 odometry messages, 101 loops."""
    return simulated_bag(tmp_path_factory.mktemp('world') / 'bag', 200, 300)


@pytest.fixture(scope='module')
def recording(bag):
    return recording_of(bag)


@pytest.mark.parametrize('kind', [kind for kind in KINDS if not kind.startswith('ROS 1')])
def test_what_is_whole_is_walked_to_its_end(tmp_path, recording, kind):
    path = KINDS[kind](tmp_path, recording)
    found = []
    for file in storage_files(path) if path.is_dir() else [path]:
        salvage = Salvage(file)
        found += salvage.messages(None, None, None)
        assert salvage.damage is None
    assert [m[:3] for m in found] == [m[:3] for m in recording]
    assert [m.data for m in found] == [m[3] for m in recording]


def test_damage_is_an_error_to_who_wants_no_part(tmp_path, bag):
    path = tmp_path / 'a.mcap'
    path.write_bytes((bag / 'bag.mcap').read_bytes()[:5000])
    for call in (read_messages, read_raw):
        with pytest.raises(L1SlamError, match='a.mcap is damaged: it breaks off after 5,000 b'):
            list(call(path))


def test_a_message_that_cannot_be_decoded_is_an_error_to_who_wants_no_part(tmp_path, recording):
    broken = list(recording)
    for k in (20, 30):
        broken[k] = (*broken[k][:3], broken[k][3][:40])
    path = mcap_file(tmp_path / 'a.mcap', broken)
    said = []
    times = [m.time for m in read_messages(path, None, said.append)]
    assert times == [m[2] for k, m in enumerate(recording) if k not in (20, 30)]
    assert said == [f'{path} is damaged: 2 messages cannot be decoded; 299 others were used']
    with pytest.raises(L1SlamError, match='2 messages cannot be decoded; 299 others were used'):
        list(read_messages(path))
