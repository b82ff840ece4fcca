# SPDX-License-Identifier: Apache-2.0
"""The true poses that a bag has on a topic, stamped by their headers."""

from collections import Counter
from pathlib import Path

import numpy as np

from l1slam_ros.core.errors import FileError, MessageError
from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.io.bags.reader import bag_summary, read_messages
from l1slam_ros.io.messages.conversion import stamped_pose
from l1slam_ros.io.trajectory import Reference
from l1slam_ros.io.wording import counted

_TYPES = ('geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PoseWithCovarianceStamped',
          'geometry_msgs/msg/TransformStamped', 'nav_msgs/msg/Odometry')


def read_truth_topic(path: Path, topic: str, manifold: Manifold = se2) -> Reference:
    """
    Return the poses on a topic, in order of their stamps; of one stamp the first.

    Raises
    ------
    FileError : the bag cannot be read, or has no poses on the topic.

    """
    damage: list[str] = []
    refused: Counter[str] = Counter()
    pose_at: dict[int, Array] = {}
    for message in read_messages(path, [topic], damage.append):
        if message.msgtype not in _TYPES:
            raise FileError(path, f'{topic} is of {message.msgtype}; expected one of '
                            f'{", ".join(_TYPES)}')
        try:
            stamp, pose3 = stamped_pose(message.message)
            pose_at.setdefault(stamp, pose3)
        except MessageError as error:
            refused[error.cause] += 1
    skipped = [f'{counted(count, "message")} on {topic} of {path} refused: {cause}'
               for cause, count in refused.items()]
    if not pose_at:
        raise FileError(path, '; '.join([f'no poses on {topic}; expected true poses',
                                         *_alternatives(path), *skipped, *damage]))
    stamps = np.array(sorted(pose_at), np.int64)
    poses = manifold.from_pose3(np.array([pose_at[stamp] for stamp in stamps.tolist()]))
    return Reference(stamps, poses, stamped=True, skipped=(*skipped, *damage))


def _alternatives(path: Path) -> list[str]:
    """Say which topics have poses; nothing where none has."""
    names = [topic.name for topic in bag_summary(path).topics if topic.msgtype in _TYPES]
    return [f'there are poses on {", ".join(names)}'] if names else []
