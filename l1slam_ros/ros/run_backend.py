# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The process of a node: SIGINT, SIGTERM and SIGHUP end it within two seconds, whatever it does.

It is imported and run before anything heavy, so that signals work while the rest is imported, too.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

_BAD_INPUT = 2
# [s] A signal leaves that long for an orderly end; the threads of the node get a part of it.
_PATIENCE, _THREADS = 1.2, 0.9
# [s] And so much longer for a map that is being saved.
_SAVING = 4.5
# [s] Pause after an error, so that one which recurs does not keep a core busy.
_BREATH = 0.05
# [s] How long the interpreter lets the solver's own Python run before a callback may.
_TURN = 5e-4


class Signals:
    """
    Waits for a signal in a thread of its own: no other thread need be where it can take one.

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
            # The terminal may go, unless `nohup` says that this is nothing to the node.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, lambda *_: None)
        threading.Thread(target=self._wait, name='signals', daemon=True).start()

    def orderly(self, wake: Callable[[], None]) -> None:
        """From now on a signal calls `wake`, which is to make the main thread end all."""
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
        # Nobody may be listening any more, or ever have been: then it is None.
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
    name : what it is called where it cannot begin
    load : imports what makes it, and returns that
    ready : what it says once it is there

    """
    signals = Signals()
    sys.setswitchinterval(_TURN)
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from l1slam_ros.core.errors import L1SlamError

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
    signals.orderly(rclpy.try_shutdown)
    try:
        node = make()
        signals.saving = node.is_saving
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.get_logger().info(f'ready: {ready}')
        _spin(executor, node)
    except L1SlamError as error:
        print(f'{name}: {error}', file=sys.stderr)
        code = 1
    except Exception:
        # A signal can shut ROS down under any call; what that call then raises is no failure.
        if rclpy.ok():
            raise
    if node is None or node.close(_THREADS):
        rclpy.try_shutdown()
    # Not by returning: a thread that is within ROS when the interpreter is torn down aborts.
    leave(code)


def _spin(executor: Any, node: Any) -> None:
    """Serve callbacks until ROS is shut down, whatever ROS itself raises meanwhile."""
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
