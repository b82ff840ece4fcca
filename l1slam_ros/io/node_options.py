# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""The options of the node and its parameter file; without ROS, so that `l1slam` reads it, too."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from l1slam_ros.core.errors import FileError, OptionError
from l1slam_ros.core.names import OF_ROS
from l1slam_ros.core.options import Options, Scalar, dotted, option
from l1slam_ros.core.running.backend import BackendOptions
from l1slam_ros.io.bounded import read_text, read_yaml
from l1slam_ros.io.files import reported

# A robot's name, which topics begin with.
_NAME = re.compile('[A-Za-z][A-Za-z0-9_]*')
# The default name of the node.
_NODE = 'backend'


@dataclass(frozen=True)
class UpdateOptions(Options):
    """How often the node updates the map, and how long an update may take."""

    period: float = option(
        0.2, 'time from the begin of one update to the begin of the next', 's', 1e-3, 3600)
    budget: float = option(0.1, 'longest time that one update may take', 's', 1e-3, 3600)


@dataclass(frozen=True)
class NodeOptions(BackendOptions):
    """All options of the node: those of the back end, and its own."""

    PASSED_OVER = OF_ROS

    autostart: bool = option(
        True, 'configure and activate the node at start; false: a lifecycle manager does that',
        fixed=True)
    dimension: int = option(
        2, '2: poses in the plane, SE(2); 3: poses in space, SE(3)', '', 2, 3, fixed=True)
    map_frame: str = option('map', 'frame of the optimised poses', fixed=True)
    odom_frame: str = option('odom', 'frame of the odometry', fixed=True)
    publish_tf: bool = option(
        True, 'publish map -> odom on /tf, where tf2_msgs is installed', fixed=True)
    transform_period: float = option(
        0.05, 'time between two publications of map -> odom', 's', 1e-3, 3600)
    transform_tolerance: float = option(
        0.1, 'how far, at least, map -> odom is stamped ahead of the newest odometry; odometry '
        'with a long period is stamped further ahead', 's', 0, 3600)
    save_path: str = option('', 'the .g2o file that ~/save writes and ~/load reads')
    autosave_period: float = option(
        60.0, 'with save_path set, a map that changed is saved within this time, and when the '
        'node ends; 0: off', 's', 0, 1e9)
    load_on_start: bool = option(False, 'load the map at save_path at start', fixed=True)
    robots: tuple[str, ...] = option(
        ('',), 'names of the robots that share one map; the topics and frames of each begin with '
        'its name. One empty name: a single robot, whose topics and frames have no prefix',
        fixed=True)
    update: UpdateOptions = UpdateOptions()

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the robots; empty for a single robot without a name."""
        return () if self.robots == ('',) else self.robots

    def __post_init__(self) -> None:
        """Check every field, and the fields that depend on each other."""
        super().__post_init__()
        for name in ('map_frame', 'odom_frame', 'base_frame'):
            # tf2 has no leading slash.
            object.__setattr__(self, name, getattr(self, name).removeprefix('/'))
        frames = self.map_frame, self.odom_frame
        if '' in frames or frames[0] == frames[1]:
            raise OptionError(f'map_frame is {frames[0]!r} and odom_frame {frames[1]!r}, expected '
                              'two different names')
        # ROS cannot read an empty list from a parameter file.
        object.__setattr__(self, 'robots', self.robots or ('',))
        wrong = not all(_NAME.fullmatch(name) for name in self.names)
        if wrong or len({*self.names}) < len(self.robots) > 1:
            raise OptionError(f'robots is {list(self.robots)}, expected different names of '
                              'letters, digits and underscores')
        if self.save_path and not self.save_path.endswith('.g2o'):
            raise OptionError(f'save_path is {self.save_path!r}, expected the name of a .g2o file')


def read_params_file(path: Path) -> NodeOptions:
    """
    Return the options that a ROS parameter file sets for the node, by its name or for all nodes.

    Raises
    ------
    FileError : it cannot be read, is not a parameter file, or sets a value that is refused.

    """
    with reported(path, 'read'):
        written = read_text(path)
    try:
        content = read_yaml(written.decode())
    except (ValueError, yaml.YAMLError) as error:
        raise FileError(path, 'expected a YAML file: ' + ' '.join(str(error).split())) from error
    sections = list(_sections(content))
    named = any(name == _NODE for name, _ in sections)
    values: dict[str, Scalar] = {}
    for name, section in sections:
        if not named or name in (_NODE, '*', '**'):
            values.update(dotted(section))
    if not values:
        raise FileError(path, 'sets no parameters; expected `/**: {ros__parameters: {...}}`')
    try:
        return NodeOptions.from_mapping(values)
    except OptionError as error:
        raise FileError(path, str(error)) from error


def _sections(content: Any, name: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield name, without namespaces, and parameters of each node of a parameter file."""
    for key, value in content.items() if isinstance(content, Mapping) else ():
        if key == 'ros__parameters' and isinstance(value, Mapping):
            yield name, value
        else:
            yield from _sections(value, str(key).rpartition('/')[2])
