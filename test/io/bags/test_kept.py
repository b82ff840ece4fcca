# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What a recorder kept for who comes late is in the summary of a bag, by which it is played."""

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from bags import STRING, TYPES
from l1slam_ros.io.bags.reader import bag_summary
from l1slam_ros.io.messages.serialisation import cdr, string_bytes


def test_summary_says_what_was_kept_for_who_comes_late(tmp_path):
    time = QosTime(0, 0)
    profiles = [Qos(QosHistory.KEEP_LAST, 3, QosReliability.RELIABLE, durability, time, time,
                    QosLiveliness.AUTOMATIC, time, False)
                for durability in (QosDurability.TRANSIENT_LOCAL, QosDurability.VOLATILE)]
    with Rosbag2Writer(tmp_path / 'two', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, offered in (('/grid', profiles), ('/said', profiles[1:])):
            to = writer.add_connection(name, STRING, typestore=TYPES, offered_qos_profiles=offered)
            writer.write(to, 1, cdr((4, string_bytes('a'))))
    for path in tmp_path / 'two', tmp_path / 'two' / 'two.mcap':
        assert {t.name: t.kept for t in bag_summary(path).topics} == {'/grid': 3, '/said': 0}
    with Rosbag1Writer(tmp_path / 'one.bag') as writer:
        for latching in 0, 1:
            writer.add_connection(f'/{latching}', STRING, typestore=get_typestore(
                Stores.ROS1_NOETIC), latching=latching)
    assert {t.name: t.kept for t in bag_summary(tmp_path / 'one.bag').topics} == {'/0': 0, '/1': 1}
