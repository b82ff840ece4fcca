# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""
The tags of graph files: how the lines of each are read, and which lines are not used, and why.

A line is a tag, one or two vertex ids, a pose, and the upper triangle of an information matrix:

    VERTEX_SE2 id x y theta                                VERTEX2 id x y theta
    EDGE_SE2 i j x y theta xx xy xt yy yt tt               EDGE2 i j x y theta xx xy yy tt xt yt
    EDGE_PRIOR_SE2 id x y theta xx xy xt yy yt tt          EDGE_PRIOR_SE2_XY id x y xx xy yy
    VERTEX_SE3:QUAT id x y z qx qy qz qw                   VERTEX3 id x y z roll pitch yaw
    EDGE_SE3:QUAT i j x y z qx qy qz qw xx xy ...          EDGE3 i j x y z roll pitch yaw xx xy ...
    EDGE_SE3_PRIOR id 0 x y z qx qy qz qw xx xy ...        EDGE_SE3_XYZPRIOR id 0 x y z xx xy ...
    EDGE_SE3_PRIORXYZ id x y z xx xy ...                   EDGE_SE3_PRIORXY id x y xx xy yy
    EDGE_SE3_SWITCHABLE i j k x y z qx qy qz qw xx ...     EDGE_SE2_SWITCHABLE i j k x y theta ...

The last lines but one are GPS positions of hdl_graph_slam. The last ones are loops of Vertigo and
RTAB-Map with a switch variable, vertex k, which is ignored: here the robust solve judges loops.

Priors are absolute factors; a component with a zero row and column in the information is not
measured. The number after the id of a prior in space is that of a `PARAMS_SE3OFFSET`, the pose of
the sensor on the robot; only the identity is supported.

`EQUIV i j` of TORO says that two vertices are one place: the loops between them are true. TORO
collapses the edge between them; here it is vouched for, and both vertices stay. Without such an
edge their poses are tied to each other. Lines of unknown tags are not used; what ties poses is
refused: unknown edges, and lines that begin with the ids of two vertices.

**TORO orders the information of the plane differently** (forward, sideways, rotation: `ff fs ss rr
fr sr`); some programs write g2o's order under TORO's tags. **The rotation error of g2o in space is
the vector part of the quaternion**, half the angle: the rotation block of its information is four
times that of the angle, and the blocks beside it are twice. Some programs that write g2o ignore
that; TORO's information is that of the angles.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l1slam_ros.core.geometry import se2, se3
from l1slam_ros.core.geometry.manifold import Array, Manifold
from l1slam_ros.core.names import QUATERNION


def _from_angles(values: Array) -> Array:
    """Return poses (m, 7) of rows x y z roll pitch yaw: turns about z, then y, then x."""
    turn = np.zeros((3, len(values), 7))
    turn[..., 6] = np.cos(values[:, 3:].T / 2)
    for axis in range(3):
        turn[axis, :, 3 + axis] = np.sin(values[:, 3 + axis] / 2)
    roll, pitch, yaw = turn
    yaw[:, :3] = values[:, :3]
    return se3.compose(se3.compose(yaw, pitch), roll)


@dataclass(frozen=True)
class Tag:
    """
    How the lines of one tag are read.

    kind : vertex, between, switched (a between factor), absolute, position (an absolute factor);
    ids : number of leading whole numbers, the first `vertices` of which are vertex ids; values :
    number of values of the pose that follow; `read` converts them to the first values of a pose of
    the manifold, and the others are those of the identity; information : row and column of each
    entry of the upper triangle, in the order of the file; empty for a vertex.
    """

    kind: str
    manifold: Manifold
    ids: int
    values: int
    information: tuple[tuple[int, int], ...] = ()
    read: Callable[[Array], Array] = np.asarray

    @property
    def vertices(self) -> int:
        """How many vertices a line names."""
        return 2 if self.kind in ('between', 'switched') else 1

    @property
    def has_quaternion(self) -> bool:
        """Whether the pose ends in a quaternion."""
        return self.values == se3.POSE_SIZE

    def units(self, rotation_information: str) -> Array:
        """
        Return the size of a unit of each residual component, in the units of the file, (d,).

        rotation_information : of `names.ROTATION_INFORMATION`
        """
        units = np.ones(self.manifold.TANGENT_SIZE)
        if self.has_quaternion and rotation_information == QUATERNION:
            units[self.manifold.ROTATION] = 0.5
        return units


def _triangle(size: int) -> tuple[tuple[int, int], ...]:
    """Return row and column of each entry of an upper triangle, row by row."""
    return tuple((row, column) for row in range(size) for column in range(row, size))


_TORO_PLANE = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
# Order of a whole information matrix in the plane -> the other one in use.
OTHER_ORDER = {_triangle(3): _TORO_PLANE, _TORO_PLANE: _triangle(3)}

# The first tag of each kind on each manifold is g2o's, which is written.
TAGS = {
    'VERTEX_SE2': Tag('vertex', se2, 1, 3),
    'EDGE_SE2': Tag('between', se2, 2, 3, _triangle(3)),
    'EDGE_PRIOR_SE2': Tag('absolute', se2, 1, 3, _triangle(3)),
    'EDGE_PRIOR_SE2_XY': Tag('position', se2, 1, 2, _triangle(2)),
    'VERTEX2': Tag('vertex', se2, 1, 3),
    'EDGE2': Tag('between', se2, 2, 3, _TORO_PLANE),
    'VERTEX_SE3:QUAT': Tag('vertex', se3, 1, 7, (), se3.from_pose3),
    'EDGE_SE3:QUAT': Tag('between', se3, 2, 7, _triangle(6), se3.from_pose3),
    'EDGE_SE3_PRIOR': Tag('absolute', se3, 2, 7, _triangle(6), se3.from_pose3),
    'EDGE_SE3_XYZPRIOR': Tag('position', se3, 2, 3, _triangle(3)),
    'EDGE_SE3_PRIORXYZ': Tag('position', se3, 1, 3, _triangle(3)),
    'EDGE_SE3_PRIORXY': Tag('position', se3, 1, 2, _triangle(2)),
    'EDGE_SE2_SWITCHABLE': Tag('switched', se2, 3, 3, _triangle(3)),
    'EDGE_SE3_SWITCHABLE': Tag('switched', se3, 3, 7, _triangle(6), se3.from_pose3),
    'VERTEX3': Tag('vertex', se3, 1, 6, (), _from_angles),
    'EDGE3': Tag('between', se3, 2, 6, _triangle(6), _from_angles),
}
FACTORS = 'between', 'switched', 'absolute', 'position'
# g2o needs this line for absolute poses in space: an offset of zero.
OFFSET = 'PARAMS_SE3OFFSET'
NO_OFFSET = f'{OFFSET} 0 0 0 0 0 0 0 1'
EQUIVALENT = 'EQUIV'

_LANDMARKS = 'landmarks are no part of a pose graph'
SENSORS = 'sensor data and calibration are no part of a pose graph'
UNKNOWN = 'unknown tags'
# Tags that are known but not used, with the reason; so are PARAMS_... and FIX.
TAGS_LEFT_OUT = {
    **dict.fromkeys((
        'VERTEX_XY', 'EDGE_SE2_XY', 'EDGE_BEARING_SE2_XY', 'EDGE_SE2_XY_CALIB', 'EDGE_POINTXY',
        'EDGE_SE2_POINTXY_OFFSET', 'EDGE_SE2_TWOPOINTSXY', 'EDGE_SE2_LOTSOFXY',
        'VERTEX_SEGMENT2D', 'VERTEX_LINE2D', 'EDGE_SE2_SEGMENT2D', 'EDGE_SE2_SEGMENT2D_LINE',
        'EDGE_SE2_SEGMENT2D_POINTLINE', 'EDGE_SE2_LINE2D', 'EDGE_LINE2D', 'EDGE_LINE2D_POINTXY',
        'VERTEX_TRACKXYZ', 'EDGE_SE3_TRACKXYZ', 'EDGE_POINTXYZ', 'EDGE_XYZPRIOR',
        'EDGE_PROJECT_DEPTH', 'EDGE_PROJECT_DISPARITY', 'EDGE_POINTXYZ_PRIOR', 'VERTEX_PLANE',
        'EDGE_SE3_PLANE', 'EDGE_PLANE_PRIOR_NORMAL', 'EDGE_PLANE_PRIOR_DISTANCE',
        'EDGE_PLANE_IDENTITY', 'EDGE_PLANE_PARALLEL', 'EDGE_PLANE_PERPENDICULAR',
        'EDGE_PLANE_PAERPENDICULAR',
    ), _LANDMARKS),
    **dict.fromkeys(('EDGE_SE3_PRIORQUAT', 'EDGE_SE3_PRIORVEC'),
                    'an attitude without a position is not read'),
    **dict.fromkeys(('VERTEX_SWITCH', 'EDGE_SWITCH_PRIOR'),
                    'which loops are true is judged here'),
    **dict.fromkeys((
        'LASER_ROBOT_DATA', 'RGBD_DATA', 'ROBOTLASER1', 'RAWLASER1', 'FRONTLASER1', 'REARLASER1',
        'VERTEX_TAG', 'VERTEX_ELLIPSE',
    ), SENSORS),
}
