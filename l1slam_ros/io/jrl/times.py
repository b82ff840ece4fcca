# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The stamps of the keyframes of a JRL file, from the stamps of its entries."""

import numpy as np

from l1slam_ros.core.geometry.manifold import Indices
from l1slam_ros.io.files import NANOSECONDS
from l1slam_ros.io.graphs.robot_log import RobotLog


def stamps_of(ids: Indices, keys: Indices, log: RobotLog) -> tuple[Indices | None, list[str]]:
    """
    Return the stamps [ns] of keyframes, (n,), None where none are times, and a sentence on that.

    The last new key of an entry has its stamp; one that is new with it has that of the entry
    before, if that has no key. A robot's own entries come first.

    ids : (n,) ascending; keys : (m, 2) of the factors
    """
    every = [stamp for own in log.stamps for stamp in own]
    if max(every) - min(every) < NANOSECONDS:
        counting = len(set(every)) > 1 and max(every) < NANOSECONDS
        return None, [] if counting or len(every) == 1 else [
            f'stamps {min(every)} to {max(every)} are not used: as nanoseconds they span less '
            'than a second']
    found: dict[int, int] = {}
    by_entry: dict[tuple[int, int], set[int]] = {}
    for entry, ends in zip(log.entries.tolist(), keys.tolist(), strict=True):
        by_entry.setdefault((entry[0], entry[1]), set()).update(ends)
    for own_alone in True, False:
        for robot, (letter, stamps) in enumerate(zip(log.robots, log.stamps, strict=True)):
            empty: list[int] = []
            for k, stamp in enumerate(stamps):
                new = sorted(key for key in by_entry.get((robot, k), ()) if key not in found
                             and (not own_alone or key >> 56 in (letter, 0)))
                for key in new[:-1]:
                    found[key] = empty.pop(0) if empty else stamp
                if new:
                    found[new[-1]] = stamp
                    empty = []
                else:
                    empty.append(stamp)
    if len(found) < len(ids):  # keys that no factor names
        return None, ['stamps are not used: some keys of the initialization have none']
    return np.array([found[key] for key in ids.tolist()], np.int64), []
