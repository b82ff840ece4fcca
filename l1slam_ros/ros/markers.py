# SPDX-License-Identifier: Apache-2.0
"""The graph as RViz and Foxglove draw it: keyframes as points, factors as lines."""

from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from l1slam_ros.core.geometry.manifold import Array
from l1slam_ros.core.graph.factor_graph import BetweenFactors
from l1slam_ros.core.online.loop_states import ACCEPTED, REJECTED, SUSPECT, LoopStates
from l1slam_ros.ros.publishing import header

# Okabe and Ito's colours, as in the pictures.
_BLUE, _GREY, _GREEN = (0.0, 0.447, 0.698), (0.5, 0.5, 0.5), (0.0, 0.62, 0.451)
_YELLOW, _RED = (0.902, 0.624, 0.0), (0.835, 0.369, 0.0)
_POINT, _LINE = 0.1, 0.03  # [m]


def graph_markers(frame: str, stamp: int, pose3: Array, factors: BetweenFactors,
                  loops: LoopStates) -> MarkerArray:
    """
    Return one marker for each namespace.

    They are `keyframes`, `odometry`, `loops`, `suspect_loops` and `rejected_loops`.

    Parameters
    ----------
    frame, stamp : of the markers; stamp [ns]
    pose3 : (n, 7) optimised keyframes, x y z qx qy qz qw
    factors : which keyframes are tied to each other
    loops : what has become of the loops among them

    """
    points = [Point(x=x, y=y, z=z) for x, y, z in pose3[:, :3].tolist()]
    state = loops.state[: len(loops.rows)]
    pairs, is_odometry = factors.pairs, factors.is_odometry

    def marker(namespace: str, kind: int, size: float, colour: tuple[float, float, float],
               rows: list[int]) -> Marker:
        r, g, b = colour
        return Marker(header=header(frame, stamp), ns=namespace, type=kind, action=Marker.ADD,
                      scale=Vector3(x=size, y=size, z=size), color=ColorRGBA(r=r, g=g, b=b, a=1.0),
                      points=[points[row] for row in rows])

    return MarkerArray(markers=[
        marker('keyframes', Marker.POINTS, _POINT, _BLUE, list(range(len(points)))),
        marker('odometry', Marker.LINE_LIST, _LINE, _GREY, pairs[is_odometry].ravel().tolist()),
        *(marker(namespace, Marker.LINE_LIST, _LINE, colour,
                 pairs[loops.rows[state == kind]].ravel().tolist())
          for namespace, kind, colour in (('loops', ACCEPTED, _GREEN),
                                          ('suspect_loops', SUSPECT, _YELLOW),
                                          ('rejected_loops', REJECTED, _RED))),
    ])
