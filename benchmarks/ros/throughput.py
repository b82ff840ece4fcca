# SPDX-License-Identifier: Apache-2.0
"""
How many odometry messages the node takes in, beside a bare rclpy subscriber on the same topic.

    python benchmarks/ros/throughput.py [MESSAGES [RATE]]

Three processes: this one publishes, paced; a bare subscriber only counts; the node runs as
shipped. Prints what each received, and what the node says that it lost.
"""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

# Its own domain: nobody else's odometry is counted.
os.environ.setdefault('ROS_DOMAIN_ID', '93')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from l1slam_ros.ros.demo import executable
from l1slam_ros.ros.publishing import header

MESSAGES, RATE = 25_000, 1_000.0
_SPEED = 5.0  # [m/s] ten keyframes a second
_BEGIN = 10**12  # [ns]
_PATIENCE = 60.0  # [s]


def main() -> int:
    """Measure and print."""
    if sys.argv[1:] == ['bare']:
        return _subscribe()
    count = int(sys.argv[1]) if len(sys.argv) > 1 else MESSAGES
    rate = float(sys.argv[2]) if len(sys.argv) > 2 else RATE
    bare = subprocess.Popen([sys.executable, __file__, 'bare'], stdout=subprocess.PIPE, text=True)
    backend = subprocess.Popen([executable('backend')])
    try:
        said, seconds, cpu = _measure(count, rate, backend.pid)
    finally:
        for process in (bare, backend):
            process.send_signal(signal.SIGINT)
        received = int((bare.communicate()[0] or '0').split()[-1])
        backend.wait()
    node = int(said['odom.received'])
    print(f'{count} messages sent in {seconds:.1f} s\n'
          f'bare subscriber: {received} received, {1 - received / count:.2%} lost\n'
          f'node: {node} received, {1 - node / count:.2%} lost; it says {said["odom.lost"]} lost, '
          f'{said["odom.rate"]} a second; {said["keyframes"]} keyframes, {cpu:.1f} CPU s')
    return 0


def _measure(count: int, rate: float, backend: int) -> tuple[dict[str, str], float, float]:
    """Publish; return what the node last says, how long it took and the node's CPU time [s]."""
    rclpy.init()
    node = rclpy.create_node('robot')
    publisher = node.create_publisher(Odometry, 'odom', QoSProfile(depth=1000))
    said: dict[str, str] = {}
    node.create_subscription(
        DiagnosticArray, '/diagnostics',
        lambda m: said.update({v.key: v.value for s in m.status for v in s.values},
                              message=m.status[0].message), 10)
    _until(node, lambda: publisher.get_subscription_count() == 2 and 'odom.received' in said
           and 'compiling' not in said['message'])
    before, began = cpu_seconds(backend), time.monotonic()
    for k, data in enumerate(_messages(count, rate)):
        publisher.publish(data)
        time.sleep(max(began + k / rate - time.monotonic(), 0.0))
    seconds, cpu = time.monotonic() - began, cpu_seconds(backend) - before
    # Until two reports in a row say the same.
    seen = ''
    while seen != said['odom.received']:
        seen, until = said['odom.received'], time.monotonic() + 2.5
        _until(node, lambda until=until: time.monotonic() > until)  # type: ignore[misc]
    return said, seconds, cpu


def _messages(count: int, rate: float) -> list[bytes]:
    """Return the odometry of a straight drive, serialised before the clock runs."""
    messages = []
    for k in range(count):
        stamp = _BEGIN + round(k / rate * 1e9)
        message = Odometry(header=header('odom', stamp), child_frame_id='base_link')
        message.pose.pose.position.x = _SPEED * k / rate
        messages.append(serialize_message(message))
    return messages


def _until(node: Any, condition: Any) -> None:
    deadline = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f'waited {_PATIENCE} s in vain'
        rclpy.spin_once(node, timeout_sec=0.1)


def cpu_seconds(process: int) -> float:
    """Return the processor's time that a process has taken [s]."""
    with open(f'/proc/{process}/stat') as file:
        fields = file.read().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _subscribe() -> int:
    """Count odometry until SIGINT; print how many."""
    rclpy.init()
    node, received = rclpy.create_node('bare'), [0]

    def count(_: Odometry) -> None:
        received[0] += 1

    node.create_subscription(Odometry, 'odom', count, QoSProfile(depth=1000))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    print(received[0])
    return 0


if __name__ == '__main__':
    sys.exit(main())
