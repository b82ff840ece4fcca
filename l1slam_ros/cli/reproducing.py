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
