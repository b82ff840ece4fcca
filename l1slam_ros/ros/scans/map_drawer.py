# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""`map` and `~/save_map`: the occupancy grid of the scans at the optimised keyframes."""

import threading
import time
from array import array
from collections.abc import Callable
from pathlib import Path

from geometry_msgs.msg import Point, Pose, Quaternion
from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from l1slam_ros.core.errors import OptionError
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.scans.occupancy.live_grid import LiveGrid
from l1slam_ros.core.scans.points import Points
from l1slam_ros.io.files import counted
from l1slam_ros.io.ours import refuse_others
from l1slam_ros.io.scans.grid_file import beside, write_grid
from l1slam_ros.ros.scans.options import ScanLoopsOptions
from l1slam_ros.ros.shell.header import header

# [s] Longest time for which drawing delays a scan.
_SLICE = 0.01


class MapDrawer:
    """
    Draws a grid a little at a time, and publishes it when it is complete.

    Parameters
    ----------
    node : to publish from
    options : returns the current options

    Attributes
    ----------
    cells : number of cells of the last published grid, for the diagnostics

    """

    def __init__(self, node: Node, options: Callable[[], ScanLoopsOptions]):
        self._options = options
        self._publisher = node.create_publisher(OccupancyGrid, 'map', QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self._lock = threading.Lock()
        self.cells = 0
        self.begin_anew()

    def begin_anew(self) -> None:
        """Begin with an empty grid."""
        with self._lock:
            self._grid = LiveGrid(self._options().map_resolution)
            self._frame = 'map'
            self._stamp = 0
            self._wanted: dict[int, tuple[Points, Array]] = {}
            self._to_draw: list[int] = []
            self._changed = False
            self._due = 0.0

    def follow(self, frame: str, stamp: int, placed: dict[int, tuple[Points, Array]]) -> None:
        """Set the points and poses of keyframes, by number; stamp : of the newest [ns]."""
        with self._lock:
            for keyframe in self._wanted.keys() - placed.keys():
                self._grid.erase(keyframe)
                self._changed = True
            self._frame = frame
            self._stamp = stamp
            self._wanted = placed
            self._to_draw = [keyframe for keyframe, (_, pose) in placed.items()
                             if not self._grid.is_as_drawn(keyframe, pose)]

    def work(self) -> bool:
        """Draw for a moment, or publish if due; return whether there is more to draw."""
        with self._lock:
            self._draw(time.monotonic() + _SLICE)
            if self._to_draw:
                return True
            now = time.monotonic()
            if self._changed and now >= self._due:
                self._publish()
                self._changed, self._due = False, now + self._options().map_period
            return False

    def save(self) -> str:
        """
        Write the grid; return a sentence for the answer.

        Raises
        ------
        OptionError : `map_path` is empty, or there is no grid yet.
        FileError : it cannot be written, or another program's grid is there.

        """
        path = self._options().map_path
        if not path:
            raise OptionError('map_path is empty, expected the name of a .pgm file')
        refuse_others((path, beside(Path(path))), instead='another map_path')
        with self._lock:
            self._draw(float('inf'))
            drawn = len(self._grid)
            grid = self._grid.grid()
        if not drawn:
            raise OptionError('there is no map yet; expected scans, and a path from the back end')
        write_grid(Path(path), grid)
        width, height = grid.log_odds.shape
        return f'{path}: {width} x {height} cells of {counted(drawn, "keyframe")}'

    def _draw(self, until: float) -> None:
        while self._to_draw and time.monotonic() < until:
            keyframe = self._to_draw.pop()
            self._grid.draw(keyframe, *self._wanted[keyframe])
            self._changed = True

    def _publish(self) -> None:
        grid = self._grid.grid()
        width, height = grid.log_odds.shape
        message = OccupancyGrid(header=header(self._frame, self._stamp))
        x, y = grid.origin.tolist()
        message.info = MapMetaData(
            map_load_time=message.header.stamp, resolution=grid.resolution, width=width,
            height=height, origin=Pose(position=Point(x=x, y=y, z=0.0),
                                       orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)))
        # Row by row of y, from the lowest.
        message.data = array('b', grid.occupancy.T.tobytes())
        self._publisher.publish(message)
        self.cells = width * height
