# SPDX-License-Identifier: Apache-2.0
"""The lines of graph files by their tags: how those are read that are used, and why others not."""

from dataclasses import dataclass

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.geometry.manifold import Manifold


@dataclass(frozen=True)
class Tag:
    """
    How the lines of one tag are read.

    kind : vertex, between, absolute or position (absolute, too); ids : how many vertex ids lead;
    values : how many numbers of the pose follow, the rest is that of the identity; information :
    row and column of each entry of the upper triangle, in the order of the file; none for a
    vertex.
    """

    file_format: str
    kind: str
    manifold: Manifold
    ids: int
    values: int
    information: tuple[tuple[int, int], ...] = ()


_G2O_2D = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO_2D = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))

TAGS = {
    'VERTEX_SE2': Tag('g2o', 'vertex', se2, 1, 3),
    'EDGE_SE2': Tag('g2o', 'between', se2, 2, 3, _G2O_2D),
    'EDGE_PRIOR_SE2': Tag('g2o', 'absolute', se2, 1, 3, _G2O_2D),
    'EDGE_PRIOR_SE2_XY': Tag('g2o', 'position', se2, 1, 2, ((0, 0), (0, 1), (1, 1))),
    'VERTEX2': Tag('toro', 'vertex', se2, 1, 3),
    'EDGE2': Tag('toro', 'between', se2, 2, 3, _TORO_2D),
}
FACTORS = 'between', 'absolute', 'position'

# Besides all that have SE3 or SIM3 in their names.
TAGS_3D = frozenset({
    'VERTEX3', 'EDGE3', 'VERTEX_TRACKXYZ', 'EDGE_POINTXYZ', 'EDGE_XYZPRIOR', 'EDGE_PROJECT_DEPTH',
    'EDGE_PROJECT_DISPARITY',
})
_LANDMARKS = 'landmarks are no part of a pose graph'
SENSORS = 'sensor data and calibration are no part of a pose graph'
# Known and left out, with the reason that is told; PARAMS_... and FIX are, too.
TAGS_LEFT_OUT = {
    **dict.fromkeys((
        'VERTEX_XY', 'EDGE_SE2_XY', 'EDGE_BEARING_SE2_XY', 'EDGE_SE2_XY_CALIB', 'EDGE_POINTXY',
        'EDGE_SE2_POINTXY_OFFSET', 'EDGE_SE2_TWOPOINTSXY', 'EDGE_SE2_LOTSOFXY',
        'VERTEX_SEGMENT2D', 'VERTEX_LINE2D', 'EDGE_SE2_SEGMENT2D', 'EDGE_SE2_SEGMENT2D_LINE',
        'EDGE_SE2_SEGMENT2D_POINTLINE', 'EDGE_SE2_LINE2D', 'EDGE_LINE2D', 'EDGE_LINE2D_POINTXY',
    ), _LANDMARKS),
    **dict.fromkeys((
        'ROBOTLASER1', 'RAWLASER1', 'FRONTLASER1', 'REARLASER1', 'VERTEX_TAG', 'VERTEX_ELLIPSE',
    ), SENSORS),
}
