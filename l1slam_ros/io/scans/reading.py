# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Reading scans from any recording, and making a graph and the points of its keyframes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from l1slam_ros.core.errors import FileError
from l1slam_ros.io.formats import LOG_SUFFIXES, is_bag, is_log
from l1slam_ros.io.scans.carmen import read_carmen
from l1slam_ros.io.scans.laser_log import LaserLog
from l1slam_ros.io.scans.to_graph import ScanMap, map_scans


def read_scans(path: Path, odom_topic: str, scan_topic: str | None,
               report: Callable[[int, int, int], None]) -> ScanMap:
    """
    Read the scans of a log or a bag, and make a graph of them.

    Parameters
    ----------
    odom_topic, scan_topic : of a bag
    report : called with the number of scans used, of all scans, and of loops found

    Raises
    ------
    FileError : it cannot be read, or holds no scans.

    """
    log = read_log(path, odom_topic, scan_topic)
    made = map_scans(zip(log.scans, log.wheels, strict=True), log.mount,
                     lambda scans, loops: report(scans, len(log.scans), loops))
    if made.record.graph.n_poses < 2:
        raise FileError(path, f'{len(log.scans):,} scans of a robot that did not move; expected '
                        '2 keyframes or more')
    record = made.record
    return replace(made, record=replace(
        record, skipped=(*log.skipped, *record.skipped), damage=log.damage))


def read_log(path: Path, odom_topic: str, scan_topic: str | None) -> LaserLog:
    """
    Return the scans of a log or of a bag's topic, with wheel odometry; see `read_scans`.

    Raises
    ------
    FileError : it cannot be read, or holds no scans.

    """
    if is_log(path):
        return read_carmen(path)
    if is_bag(path) and scan_topic:
        from l1slam_ros.io.bags.reader import bag_summary
        from l1slam_ros.io.scans.bag_scans import read_bag_scans

        bag_summary(path)  # what is no bag is said as such
        return read_bag_scans(path, odom_topic, scan_topic)
    raise FileError(path, 'holds no scans; expected a bag, or a CARMEN log: '
                    f'{", ".join(LOG_SUFFIXES)}')
