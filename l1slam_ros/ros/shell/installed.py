# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""Where the executables of this package are installed."""

import os
import sysconfig
from pathlib import Path


def executable(name: str) -> str:
    """Return where this package's executable is: where `ros2 run` looks, or beside Python."""
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        path = Path(prefix) / 'lib' / 'l1slam_ros' / name
        if prefix and path.exists():
            return str(path)
    return str(Path(sysconfig.get_path('scripts')) / name)
