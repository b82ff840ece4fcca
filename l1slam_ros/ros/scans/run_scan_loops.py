# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The process of `scan_loops`; see `run_backend`."""

from typing import Any

from l1slam_ros.ros.run_backend import run


def main() -> None:
    """Run the node until SIGINT or SIGTERM, and leave the process."""
    def load() -> Any:
        from l1slam_ros.ros.scans.node import ScanLoopsNode

        return ScanLoopsNode

    run('scan_loops', load, 'waiting for scans and odometry')
