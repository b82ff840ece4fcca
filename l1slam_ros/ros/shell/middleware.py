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
