# SPDX-License-Identifier: Apache-2.0
"""How bags are called, and where one has what; imports nothing that takes time."""

from dataclasses import dataclass

BAG_SUFFIXES = ('.mcap', '.db3', '.bag')
ODOMETRY_TOPIC = '/odom'
LOOP_TOPIC = '/loop_closures'
TRUSTED_LOOP_TOPIC = '/trusted_loop_closures'
TRUTH_TOPIC = '/ground_truth'

_LOOP = 'geometry_msgs/msg/PoseWithCovarianceStamped'


@dataclass(frozen=True)
class Topics:
    """Where a bag has its odometry, its loop closures, and those that somebody vouches for."""

    odometry: str = ODOMETRY_TOPIC
    loops: str = LOOP_TOPIC
    trusted: str = TRUSTED_LOOP_TOPIC

    def types(self) -> dict[str, str]:
        """Return the topics with the types of their messages."""
        return {self.loops: _LOOP, self.trusted: _LOOP, self.odometry: 'nav_msgs/msg/Odometry'}


DEFAULT_TOPICS = Topics()
