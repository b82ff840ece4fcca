# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The command of `l1slam` that runs the paper's experiments."""

import argparse

from l1slam_ros.cli.commands import Ending
from l1slam_ros.paper.experiments import Effort
from l1slam_ros.paper.printed import WORLDS
from l1slam_ros.paper.reproduce import REPORT
from l1slam_ros.paper.reproduce import reproduce as run_experiments


def reproduce(arguments: argparse.Namespace) -> Ending:
    """Run the paper's experiments; write the report and say where it is."""
    run_experiments(arguments.datasets, WORLDS[arguments.worlds], arguments.output, Effort(),
                    arguments.force)
    print(arguments.output / REPORT)
    return Ending()
