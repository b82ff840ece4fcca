# SPDX-License-Identifier: Apache-2.0
"""The lines of graph files that are known and not used, and why."""

_LANDMARKS = 'landmarks are no part of a pose graph'
SENSORS = 'sensor data and calibration are no part of a pose graph'
# Known and left out, with the reason that is told; PARAMS_... and FIX are, too.
TAGS_LEFT_OUT = {
    **dict.fromkeys((
        'VERTEX_XY', 'EDGE_SE2_XY', 'EDGE_BEARING_SE2_XY', 'EDGE_SE2_XY_CALIB', 'EDGE_POINTXY',
        'EDGE_SE2_POINTXY_OFFSET', 'EDGE_SE2_TWOPOINTSXY', 'EDGE_SE2_LOTSOFXY',
        'VERTEX_SEGMENT2D', 'VERTEX_LINE2D', 'EDGE_SE2_SEGMENT2D', 'EDGE_SE2_SEGMENT2D_LINE',
        'EDGE_SE2_SEGMENT2D_POINTLINE', 'EDGE_SE2_LINE2D', 'EDGE_LINE2D', 'EDGE_LINE2D_POINTXY',
        'VERTEX_TRACKXYZ', 'EDGE_SE3_TRACKXYZ', 'EDGE_POINTXYZ', 'EDGE_XYZPRIOR',
        'EDGE_PROJECT_DEPTH', 'EDGE_PROJECT_DISPARITY',
    ), _LANDMARKS),
    **dict.fromkeys((
        'ROBOTLASER1', 'RAWLASER1', 'FRONTLASER1', 'REARLASER1', 'VERTEX_TAG', 'VERTEX_ELLIPSE',
    ), SENSORS),
    'EDGE_PRIOR_SE2_XY': 'a prior on a position without a heading is not supported',
}
