# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The compiled core: loops in C++17, one submodule for each header of this folder.

It is built twice from the same sources, for AVX2 with FMA and for any processor, and the better
one that this processor runs is used. L1SLAM_ROS_SIMD=portable forces the other. `__init__.pyi`
lists the functions with shapes and units.
"""

import os
import sys
from importlib import import_module

from l1slam_ros.core.errors import MissingError, OptionError

LEVELS = ('avx2', 'portable')


def _load():
    asked = os.environ.get('L1SLAM_ROS_SIMD', '')
    if asked not in ('', *LEVELS):
        raise OptionError(f'L1SLAM_ROS_SIMD is {asked!r}; expected one of {", ".join(LEVELS)}')
    try:
        portable = import_module(f'{__name__}._portable')
        level = asked or ('avx2' if portable.has_avx2() else 'portable')
        return level, (portable if level == 'portable' else import_module(f'{__name__}._{level}'))
    except ImportError as error:
        raise MissingError(
            f'the compiled core does not load ({" ".join(str(error).split())}); `pip install .` '
            'or `colcon build` builds it, with a C++17 compiler and the headers of Python (apt '
            'install g++ python3-dev)') from error


level, _module = _load()
for _name, _part in vars(_module).items():
    if not _name.startswith('_') and isinstance(_part, type(sys)):
        globals()[_name] = _part
