# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Running a node as a process, which SIGINT, SIGTERM and SIGHUP end within two seconds.

This module is imported before all slow modules, so that signals work during their import, too.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

_BAD_INPUT = 2
# [s] Time for an orderly end after a signal, and the part of it for the threads of the node.
_PATIENCE, _THREADS = 1.2, 0.9
# [s] Additional time if a map is being saved.
_SAVING = 4.5
# [s] Pause after an error, so that a recurring one does not keep a core busy.
_BREATH = 0.05
# [s] Switch interval of the interpreter: the longest time for which solver code delays a callback.
_TURN = 5e-4


class Signals:
    """
    Waits for signals in a thread of its own, so that no other thread has to handle them.

    Attributes
    ----------
    begun : whether there was a signal
    saving : returns whether a map is being saved

    """

    def __init__(self) -> None:
        self.begun = False
        self._wake: Callable[[], None] | None = None
        self.saving: Callable[[], bool] = lambda: False
        self._read, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
            # SIGHUP is left ignored under `nohup`.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, name='signals', daemon=True).start()

    def orderly(self, wake: Callable[[], None]) -> None:
        """From now on a signal calls `wake`, which makes the main thread end the node."""
        self._wake = wake
        if self.begun:
            wake()

    def _wait(self) -> None:
        os.read(self._read, 1)
        self.begun = True
        if self._wake is None:
            leave(0)
        else:
            self._wake()
            time.sleep(_PATIENCE)
            deadline = time.monotonic() + _SAVING
            while self.saving() and time.monotonic() < deadline:
                time.sleep(_BREATH)
            leave(0)


def leave(code: int) -> None:
    """End the process now, whatever its threads are doing."""
    for stream in (sys.stdout, sys.stderr):
        # The stream may be closed, or None if it never was open.
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(code)


def main() -> None:
    """Run the back end until SIGINT or SIGTERM, and leave the process."""
    def load() -> Any:
        from l1slam_ros.ros.node import BackendNode

        return BackendNode

    run('backend', load, 'waiting for odometry')


def run(name: str, load: Callable[[], Any], ready: str) -> None:
    """
    Run a node until SIGINT or SIGTERM, and leave the process.

    Parameters
    ----------
    name : of the executable, for errors
    load : imports the class of the node, and returns it
    ready : the message of the log when it is ready

    """
    signals = Signals()
    sys.setswitchinterval(_TURN)
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from l1slam_ros.core.errors import L1SlamError
    from l1slam_ros.io.progress import say

    make = load()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # arguments, or a file of parameters, that ROS cannot read
        unknown = type(error).__name__ == 'UnknownROSArgsError'
        said = 'arguments that ROS does not know: ' if unknown else ''
        print(f'{name}: {said}{" ".join(str(error).split())}', file=sys.stderr)
        leave(_BAD_INPUT if unknown else 1)
    node = None
    code = 0
    try:
        node = make()
        signals.saving = node.is_saving
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # Not before: ROS that is shut down in the middle of that complains of what is half made.
        signals.orderly(rclpy.try_shutdown)
        node.get_logger().info(f'ready: {ready}')
        if node.options.publish_tf and find_spec('tf2_msgs') is None:
            node.get_logger().warning('publish_tf is true, but tf2_msgs is not installed (PyPI '
                                      'has none): this node publishes nothing on /tf')
        _spin(executor, node)
    except L1SlamError as error:
        say(str(error), name)
        code = 1
    except Exception:
        # A signal can shut ROS down during any call; the error of that call is not a failure.
        if rclpy.ok():
            raise
    if node is None or node.close(_THREADS):
        rclpy.try_shutdown()
    # Not by returning: a thread inside ROS would abort while the interpreter is torn down.
    leave(code)


def _spin(executor: Any, node: Any) -> None:
    """Serve callbacks until ROS is shut down, and log errors that ROS raises meanwhile."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    while rclpy.ok():
        try:
            executor.spin_once()
        except ExternalShutdownException:
            return
        except Exception as error:
            if rclpy.ok():
                node.failures.note('callback', error)
                time.sleep(_BREATH)
        else:
            node.failures.over('callback')
