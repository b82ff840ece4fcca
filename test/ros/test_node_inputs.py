# SPDX-License-Identifier: Apache-2.0
"""Strays of every kind to the real node: counted, told once, and not in the map."""

from collections import Counter

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from problems import seconds
from rclpy.qos import QoSProfile, ReliabilityPolicy
from test_node import Bench, header, odometry, poses_of

NS = 10**9


def loop(reference, stamp, x):
    message = PoseWithCovarianceStamped(header=header(f'base_link@{reference}.000000000', stamp))
    message.pose.pose.position.x = x
    return message


@pytest.fixture
def bench(ros):
    made = Bench(ros, {'robust.enabled': False})
    yield made
    made.close()


@pytest.mark.parametrize('given, of_odometry, of_loops', [
    ('', '/base_link', 'base_link'), ('', 'base_link', '/base_link'),
    ('/base_link', 'base_link', 'base_link')])
def test_a_slash_before_a_frame_says_nothing(ros, given, of_odometry, of_loops):
    """To tf2, too: it was the habit of ROS 1."""
    b = Bench(ros, {'base_frame': given, 'map_frame': '/map', 'robust.enabled': False})
    try:
        for k in range(1, 6):
            b.send('/odom', odometry(k * NS, float(k), of_odometry))
        closure = loop(1, 5 * NS, 3.5)
        closure.header.frame_id = closure.header.frame_id.replace('base_link', of_loops)
        b.send('/loop_closures', closure)
        fix = loop(1, 2 * NS, 2.0)
        fix.header.frame_id, fix.pose.covariance = 'map', np.eye(6).ravel()
        b.send('/absolute_poses', fix)
        b.until(lambda: b.backend._backend.counts()[0]['accepted_loops'] == 2, 'both are used')
        b.until(lambda: len(b.path().poses) == 5, 'a map')
        assert b.path().header.frame_id == 'map' and not b.backend._inputs.refused
    finally:
        b.close()


def test_strays_do_not_stop_the_map(bench, capfd):
    """A first message of another robot, a stamp of tomorrow, a teleport, loops five times."""
    bench.send('/odom', odometry(5 * NS, 7.0, 'gripper'))
    for k in range(10, 20):
        bench.send('/odom', odometry(k * NS, float(k)))
        if k == 13:
            bench.send('/odom', odometry(k * NS + 86_400 * NS, float(k)))
        if k == 15:
            bench.send('/odom', odometry(k * NS + NS // 2, 5e8))
    for _ in range(5):
        bench.send('/loop_closures', loop(11, 18 * NS, 7.0))
    expected = {'child_frame': 1, 'stamp_ahead': 1, 'jump': 1, 'repeated': 4}

    def refused():
        node = bench.backend
        return dict(node._inputs.refused + Counter(node._backend.counts()[1]))

    bench.until(lambda: refused() == expected, f'{expected} are counted')
    bench.until(lambda: len(bench.path().poses) == 10, 'the Path has all poses')
    assert np.allclose(poses_of(bench.path())[:, 0], np.arange(10, 20), atol=1e-6)
    bench.until(lambda: max(p.header.stamp.sec for p in bench.received['pose']) == 19,
                'the newest pose is published')
    # The very first was believed for as long as nothing spoke against it.
    assert {p.pose.position.x for p in bench.received['pose'][1:]} <= set(range(10, 20))
    told = ''

    def is_told(part):
        nonlocal told
        told += capfd.readouterr().err
        return part in told

    for part in ("refused: odometry of 'gripper'; expected that of 'base_link'",
                 f'odometry stamp {seconds(86_413.0)} ns is 86400 s after the one before',
                 'odometry 5e+08 m from one message to the next',
                 'a loop from 11000000000 ns to 18000000000 ns was sent before'):
        bench.until(lambda part=part: is_told(part), f'it is told: {part}')


def test_a_publisher_that_nobody_can_hear_is_told_of(bench, capfd):
    """Who waits for messages in another thread than rclpy's own has to look for that."""
    bench.peer.create_publisher(Odometry, 'odom', QoSProfile(
        depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    told = ''

    def is_told():
        nonlocal told
        told += capfd.readouterr().err
        return "[backend]: New publisher discovered on topic 'odom', offering incompat" in told

    bench.until(is_told, 'it is a warning')


def test_no_executor_is_woken_by_a_message(bench):
    """Each time it would make its wait set anew, ten times the work of a message."""
    bench.until(lambda: bench.received['/diagnostics'], 'the node is up')
    took = [one for one in (*bench.backend.subscriptions, *(
        event for one in bench.backend.subscriptions for event in one.event_handlers))
        if bench.executor.can_execute(one)]
    assert {one.topic_name for one in took if hasattr(one, 'topic_name')} <= {
        '/clock', '/parameter_events'} and all(hasattr(one, 'topic_name') for one in took)
