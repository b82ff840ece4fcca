# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The middleware that a shell names, where it cannot be loaded; before anything of ROS is."""

import ctypes
import os
import sys

_NAMED = 'RMW_IMPLEMENTATION'


def use_what_is_there() -> str:
    """
    Forget the middleware that the environment names if it cannot be loaded: ROS would exit.

    ROS takes the one that is there instead.

    Returns
    -------
    a sentence about that, or nothing where there is nothing to say

    Raises
    ------
    ImportError : there is no ROS.

    """
    named = os.environ.get(_NAMED)
    if not named or sys.platform != 'linux' or _can_be_loaded(named):
        return ''
    del os.environ[_NAMED]
    from rclpy.utilities import get_rmw_implementation_identifier

    return (f'{_NAMED} is {named}, which cannot be loaded here; '
            f'{get_rmw_implementation_identifier()} is used instead')


def _can_be_loaded(name: str) -> bool:
    """Return whether ROS, which looks for the library by the same rules, will find it."""
    try:
        ctypes.CDLL(f'lib{name}.so')
    except OSError:
        return False
    return True
