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
