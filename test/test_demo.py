# SPDX-License-Identifier: Apache-2.0
"""The demo bag is what its README says, and its summary tells the truth."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Path as PathMessage

from l1slam_ros.cli import main
from l1slam_ros.demo import BAG, Heard, read_recording, summarise
from l1slam_ros.io.bag import read_messages
from l1slam_ros.publishing import header

DEMO = Path(__file__).parents[1] / BAG


def numbers(bag):
    """Return all numbers of all messages of a bag, (k,)."""
    values = []
    for _, _, time, message in read_messages(bag):
        pose = message.pose
        stamped = pose.pose if hasattr(pose, 'covariance') else pose
        p, q = stamped.position, stamped.orientation
        values += [time, p.x, p.y, q.z, q.w, *getattr(pose, 'covariance', ())]
    return np.array(values)


def test_the_bag_is_made_by_the_command_its_readme_gives(tmp_path):
    command = next(line.split() for line in (DEMO.parent / 'README.md').read_text().splitlines()
                   if line.startswith('    l1slam simulate'))
    assert command[2] == str(BAG)
    assert main(['simulate', str(tmp_path / 'demo'), *command[3:]]) == 0
    np.testing.assert_allclose(numbers(tmp_path / 'demo'), numbers(DEMO), rtol=1e-9, atol=1e-12)
    made, kept = (Path(f'{bag}.false.txt').read_text() for bag in (tmp_path / 'demo', DEMO))
    assert made == kept and len(kept.splitlines()) == 10


def test_the_summary_of_a_perfect_map_is_an_error_of_zero(tmp_path):
    recording = read_recording(DEMO)
    assert (len(recording.stamps), len(recording.loops)) == (1000, 611)
    turned = recording.truth @ np.array([[0.0, -1.0], [1.0, 0.0]]) + (5.0, 6.0)
    path = PathMessage(poses=[
        PoseStamped(header=header('map', int(stamp)), pose=Pose(position=Point(x=x, y=y)))
        for stamp, (x, y) in zip(recording.stamps, turned, strict=True)])
    false, true = (tuple(recording.stamps[recording.loops[np.argmax(recording.is_false == kind)]])
                   for kind in (True, False))
    heard = Heard(path, [0.0, 0.25, 0.5], {false, true})
    text = summarise(recording, heard, tmp_path / 'demo' / 'map.png')
    assert '0.000 m in the map' in text and '2.880 m by odometry' in text
    assert '1000 keyframes, 611 loops, 10 of them false' in text
    assert '1 false loops, 1 true ones' in text
    assert '4.0 updates per second' in text
    assert (tmp_path / 'demo' / 'map.png').read_bytes().startswith(b'\x89PNG')
