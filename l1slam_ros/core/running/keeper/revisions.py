# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The number that counts the changes of a back end."""

from typing import NamedTuple


class Revisions(NamedTuple):
    """
    The revision, which counts the changes of a back end, now and at some earlier changes.

    now : the latest; map : when the poses of the map last changed; grown : when the graph last
    grew; graph : when the graph began, which names it
    """

    now: int = 0
    map: int = 0
    grown: int = 0
    graph: int = 0

    def after(self, map: bool = False, grown: bool = False, graph: bool = False) -> 'Revisions':
        """Return the revisions after one more change; changes : which ones it sets."""
        now = self.now + 1
        return Revisions(now, now if map else self.map, now if grown else self.grown,
                         now if graph else self.graph)
