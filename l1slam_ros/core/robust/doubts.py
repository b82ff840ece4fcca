# SPDX-License-Identifier: Apache-2.0
"""Why a map is not to be relied on."""
from l1slam_ros.core.robust.rounds import Growth


def doubts(growth: Growth):
    return ()
