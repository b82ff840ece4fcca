# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests of mathematics."""

import sys
from importlib import import_module

import pytest

from l1slam_ros.core import native


@pytest.fixture(params=native.LEVELS)
def level(request, monkeypatch):
    """Let the compiled core be that of each level of processors; return its name."""
    if native.LEVELS.index(request.param) < native.LEVELS.index(native.level):
        pytest.skip('this processor, or L1SLAM_ROS_SIMD, has it not')
    module = import_module(f'{native.__name__}._{request.param}')
    for name, part in vars(module).items():
        if isinstance(part, type(sys)):
            monkeypatch.setattr(native, name, part)
    return request.param
