# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Types shared by the readers of damaged files, which yield messages up to the damage."""

from typing import Any, NamedTuple


class BagMessage(NamedTuple):
    """A message of a bag; time : when recorded [ns]; data : serialised (CDR), or decoded."""

    topic: str
    msgtype: str
    time: int
    data: Any


class BrokenRecordError(Exception):
    """Reading ends at `position` [bytes] in the file, or in the chunk."""

    def __init__(self, position: int):
        super().__init__(f'no readable record at byte {position}')
        self.position = position
