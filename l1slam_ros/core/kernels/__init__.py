# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops, each module imported when it is first asked for: numba takes a third of a second.

    from l1slam_ros.core import kernels

    kernels.symbolic.neighbours(...)
"""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith('_'):
        raise AttributeError(name)
    return import_module(f'{__name__}.{name}')
