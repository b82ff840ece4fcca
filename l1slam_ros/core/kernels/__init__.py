# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops, each module imported when it is first asked for: numba takes a third of a second.

    from l1slam_ros.core import kernels

    kernels.blocks.whiten(...)
"""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith('_'):
        raise AttributeError(name)
    return import_module(f'{__name__}.{name}')
