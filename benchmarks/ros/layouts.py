# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
What RViz and Foxglove show of the demo bag with the layouts in `config/`, drawn without them.

    python benchmarks/ros/layouts.py [PNG]

The bag is played into the node, as `make demo` does. What the node has published then (markers,
Path, poses, diagnostics, states of loops) is drawn as the layouts say: which topics, in which
colours, sizes, panels and scale, on which background. Neither program is asked: shapes, fonts and
what a layout leaves to them are like theirs at best.
"""

import json
from collections import deque
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Ellipse
from nav_msgs.msg import Path as PathMessage
from peer import arguments
from PIL import Image
from rclpy.qos import DurabilityPolicy, QoSProfile
from visualization_msgs.msg import Marker, MarkerArray

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.io.messages.conversion import stamped_pose
from l1slam_ros.ros.demo import BACKEND, BAG, Listener, read_recording, running

CONFIG, PNG = Path('config'), Path('doc/layouts.png')
RATE, SHADES = '10', 200
_WIDE, _HIGH = 1400, 900  # [dots] of a window
_DOTS, _SHRUNK = 100, 0.7  # per inch of the figure, and how large it is drawn
_POINTS = 72 / _DOTS  # of type, in a dot
_LIST = 0.25  # of RViz's window
_SMALL = 9  # [points]
# What RViz draws by default: arrows and axes [m], the line of a Path [dots].
_SHAFT = 1.0
_THICK = 0.1
_HEAD = 0.3
_AXIS = 1.0
_HAIR = 1.0
_XYZ = 'red', 'limegreen'
_GREY = (160 / 255, 160 / 255, 164 / 255, 0.5)


class Seen:
    """The last that came of each topic, and all markers that stand."""

    def __init__(self, node: Any):
        self.markers: dict[tuple[str, int], Marker] = {}
        self.last: dict[str, Any] = {}
        self.loops: deque[Any] = deque(maxlen=4)
        self.track: list[tuple[float, float, float]] = []
        latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, topic, qos in (
                (PathMessage, '/path', latched), (PoseStamped, '/pose', 10),
                (PoseWithCovarianceStamped, '/pose_with_covariance', 10),
                (TransformStamped, '/map_to_odom', 10), (DiagnosticArray, '/diagnostics', 10)):
            node.create_subscription(kind, topic, lambda m, t=topic: self._hear(t, m), qos)
        node.create_subscription(MarkerArray, '/graph', self._draw, latched)
        node.create_subscription(
            DiagnosticArray, '/loop_status', lambda m: self.loops.extend(m.status), latched)

    def _hear(self, topic: str, message: Any) -> None:
        self.last[topic] = message
        if topic == '/pose' and '/map_to_odom' in self.last:
            stamp, pose3 = stamped_pose(message)
            other = self.last['/map_to_odom'].transform.translation.x
            self.track.append((stamp * 1e-9, pose3[0], other))

    def _draw(self, message: MarkerArray) -> None:
        for marker in message.markers:
            self.markers.pop((marker.ns, marker.id), None)
            if marker.action == Marker.ADD:
                self.markers[marker.ns, marker.id] = marker

    def pose(self, topic: str) -> Array:
        """Return the last pose of a topic as x, y, heading (3,)."""
        return se2.from_pose3(stamped_pose(self.last[topic])[1][None])[0]


class Scene:
    """A view from above; scale : dots of a metre."""

    def __init__(self, axes: Axes, scale: float, size: tuple[float, float], background: Any):
        self.axes, self.scale = axes, scale
        half = np.array(size) / scale / 2
        axes.set(xlim=(-half[0], half[0]), ylim=(-half[1], half[1]), xticks=[], yticks=[],
                 facecolor=background)

    def grid(self, cells: int, size: float, colour: Any) -> None:
        """Draw the lines of a grid around the origin."""
        at = (np.arange(cells + 1) - cells / 2) * size
        end = np.full_like(at, at[-1])
        lines = [*np.stack((np.c_[at, -end], np.c_[at, end]), axis=1),
                 *np.stack((np.c_[-end, at], np.c_[end, at]), axis=1)]
        self.axes.add_collection(LineCollection(
            lines, colors=colour, linewidths=_HAIR * _POINTS))

    def markers(self, markers: dict[tuple[str, int], Marker], shown: set[str]) -> None:
        """Draw the markers of some namespaces."""
        for (name, _), marker in sorted(markers.items()):
            points = np.array([(p.x, p.y) for p in marker.points])
            colours = [(c.r, c.g, c.b, c.a) for c in marker.colors]
            thick = self.scale * marker.scale.x * _POINTS
            if name not in shown:
                continue
            if marker.type == Marker.LINE_LIST:
                self.axes.add_collection(LineCollection(
                    points.reshape(-1, 2, 2), colors=colours[::2], linewidths=thick))
            else:
                self.axes.scatter(*points.T, s=thick**2, c=colours, marker='s', linewidths=0)

    def path(self, path: PathMessage, colour: Any, dots: float) -> None:
        """Draw a line through the poses of a Path."""
        points = np.array([(p.pose.position.x, p.pose.position.y) for p in path.poses])
        self.axes.plot(*points.T, color=colour, linewidth=dots * _POINTS)

    def arrow(self, pose: Array, colour: Any, length: float, thick: float) -> None:
        """Draw an arrow at a pose (3,)."""
        ahead = length * np.array([np.cos(pose[2]), np.sin(pose[2])])
        self.axes.arrow(*pose[:2], *ahead, color=colour, width=thick, head_length=_HEAD,
                        head_width=2 * thick, length_includes_head=False, zorder=5)

    def frame(self, pose: Array, name: str = '') -> None:
        """Draw the axes of a pose (3,), x red, y green."""
        for turn, colour in zip((0, np.pi / 2), _XYZ, strict=True):
            ahead = _AXIS * np.array([np.cos(pose[2] + turn), np.sin(pose[2] + turn)])
            self.axes.plot(*np.c_[pose[:2], pose[:2] + ahead], color=colour, linewidth=2, zorder=4)
        self.axes.text(*pose[:2], name, fontsize=_SMALL, zorder=6)

    def covariance(self, message: PoseWithCovarianceStamped, colour: Any) -> None:
        """Draw the ellipse of one sigma of a position."""
        values, turned = np.linalg.eigh(np.reshape(message.pose.covariance, (6, 6))[:2, :2])
        p = message.pose.pose.position
        self.axes.add_patch(Ellipse(
            (p.x, p.y), *2 * np.sqrt(values), color=colour, zorder=3,
            angle=np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))))


def rviz(figure: SubFigure, seen: Seen) -> None:
    """Draw the window of RViz: its list of displays, and what they show."""
    manager = yaml.safe_load((CONFIG / 'l1slam.rviz').read_text())['Visualization Manager']
    beside, axes = figure.subplots(1, 2, width_ratios=(_LIST, 1 - _LIST))
    scene = Scene(axes, manager['Views']['Current']['Scale'], ((1 - _LIST) * _WIDE, _HIGH),
                  _rgb(manager['Global Options']['Background Color']))
    lines = [('Displays', 'black', 'bold')]
    for display in manager['Displays']:
        lines.append((f'☑ {display["Name"]}', _rgb(display.get('Color', '0; 0; 0')), 'normal'))
        kind, topic = display['Class'].split('/')[1], display.get('Topic', {}).get('Value', '')
        message = seen.last.get(f'/{topic}')
        if kind == 'Grid':
            scene.grid(display['Plane Cell Count'], display['Cell Size'], _GREY)
        elif kind == 'TF':
            _frames(scene, seen)
        elif kind == 'Path':
            scene.path(message, _rgb(display['Color']), _HAIR)
        elif kind == 'MarkerArray':
            shown = {name for name, on in display['Namespaces'].items() if on}
            lines += [(f'     ☑ {name}', 'black', 'normal') for name in display['Namespaces']]
            scene.markers(seen.markers, shown)
        elif kind == 'PoseWithCovariance':
            scene.frame(seen.pose(f'/{topic}'))
            position = display['Covariance']['Position']
            scene.covariance(message, (*_rgb(position['Color']), position['Alpha']))
        else:
            scene.arrow(seen.pose(f'/{topic}'), _rgb(display['Color']), _SHAFT, _THICK)
    _write(beside, lines)


def foxglove(figure: SubFigure, seen: Seen) -> None:
    """Draw the window of Foxglove: its panels where the layout has them."""
    file = json.loads((CONFIG / 'foxglove.json').read_text())
    panels, layout = file['configById'], file['layout']
    share, row = layout['splitPercentage'] / 100, layout['second']['splitPercentage'] / 100
    left, right = figure.subfigures(1, 2, width_ratios=(share, 1 - share))
    map_ = panels['3D!map']
    # The camera's distance is what it sees from below to above.
    scene = Scene(left.subplots(), _HIGH / map_['cameraState']['distance'],
                  (share * _WIDE, _HIGH), map_['scene']['backgroundColor'])
    grid = map_['layers']['grid']
    scene.grid(grid['divisions'], grid['size'] / grid['divisions'], grid['color'])
    _frames(scene, seen)
    for topic, shown in map_['topics'].items():
        if topic == '/graph':
            scene.markers(seen.markers, {n for n, one in shown['namespaces'].items()
                                         if one['visible']})
        elif shown['type'] == 'line':
            scene.path(seen.last[topic], shown['gradient'][0], shown['lineWidth'] * scene.scale)
        elif shown['type'] == 'arrow':
            scene.arrow(seen.pose(topic), shown['color'], _SHAFT, 1.5 * _THICK)
        else:
            scene.frame(seen.pose(topic))
            scene.covariance(seen.last[topic], shown['covarianceColor'])
    top, middle, below = right.subplots(3, 1, height_ratios=(row, (1 - row) / 2, (1 - row) / 2))
    (status,) = seen.last[panels['DiagnosticSummary!all']['topicToRender']].status
    _write(top, [('Diagnostics (Summary)', 'black', 'bold'), (status.name, 'black', 'normal'),
                 (status.message, 'green' if status.level == b'\0' else 'darkorange', 'normal')])
    _write(middle, [('Raw Messages: ' + panels['RawMessages!loops']['topicPath'], 'black', 'bold'),
                    *((f'{one.name.split("loop ")[-1]}: {one.message}', 'black', 'normal')
                      for one in seen.loops)])
    times, *values = np.array(seen.track).T
    for path, value in zip(panels['Plot!pose']['paths'], values, strict=True):
        below.plot(times - times[0], value, linewidth=1, label=path['value'])
    below.set_title(panels['Plot!pose']['title'], fontsize=_SMALL, fontweight='bold', loc='left')
    below.tick_params(labelsize=_SMALL)
    below.legend(fontsize=_SMALL, frameon=False)


def _frames(scene: Scene, seen: Seen) -> None:
    scene.frame(np.zeros(3), 'map')
    scene.frame(seen.pose('/map_to_odom'), 'odom')


def _rgb(text: str) -> tuple[float, ...]:
    """Return a colour that RViz writes as red; green; blue."""
    return tuple(int(part) / 255 for part in text.split(';'))


def _write(axes: Axes, lines: list[tuple[str, Any, str]]) -> None:
    axes.axis('off')
    for k, (text, colour, weight) in enumerate(lines):
        axes.annotate(text, (0, 1), (4, -2 * _SMALL * k - 4), 'axes fraction', 'offset points',
                      va='top', color=colour, fontweight=weight, fontsize=_SMALL)


def main() -> None:
    """Play, listen and draw."""
    png = arguments(__doc__, png=PNG).png
    rclpy.init()
    listener = Listener(rclpy.create_node('onlooker'), read_recording(BAG))
    seen = Seen(listener.node)
    with running(BACKEND) as backend:
        with running('replay', str(BAG), '--rate', RATE) as replay:
            listener.wait({BACKEND: backend}, lambda: replay.poll() is not None)
        listener.wait({BACKEND: backend}, listener.is_final)
    rclpy.shutdown()
    mpl.rcParams['figure.constrained_layout.use'] = True
    figure = Figure(figsize=(_WIDE / _DOTS, 2 * _HIGH / _DOTS))
    for draw, part, title in zip((rviz, foxglove), figure.subfigures(2, 1, hspace=0.02),
                                 ('config/l1slam.rviz', 'config/foxglove.json'), strict=True):
        part.suptitle(title, fontsize=1.2 * _SMALL, x=0.01, ha='left')
        draw(part, seen)
    figure.savefig(png, dpi=_DOTS * _SHRUNK)
    # A quarter of the bytes.
    Image.open(png).convert('RGB').quantize(SHADES).save(png, optimize=True)


if __name__ == '__main__':
    main()
