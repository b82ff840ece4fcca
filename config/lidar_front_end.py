# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""A front end for a 3D lidar, of kiss-icp and map_closures: copy it, and adapt its numbers."""

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.voxelization import voxel_down_sample
from map_closures.map_closures import MapClosures
from map_closures.voxel_map import VoxelMap
from nav_msgs.msg import Odometry
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

RANGE = 60.0  # [m] of the lidar
CELL = 0.5  # [m] of a local map
WAY = 40.0  # [m] driven in a local map
INLIERS = 5  # more of them make a loop
SIGMAS = 0.1, 0.01  # [m], [rad] of a loop
KINDS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


def points_in(cloud):
    """Return the points (n, 3) of a cloud, and when each was seen, (n,), or (0,): not known."""
    order = '<>'[cloud.is_bigendian]
    table = np.frombuffer(cloud.data, np.dtype({
        'names': [field.name for field in cloud.fields],
        'formats': [order + KINDS[field.datatype] for field in cloud.fields],
        'offsets': [field.offset for field in cloud.fields], 'itemsize': cloud.point_step}))
    xyz = np.stack([table[axis] for axis in 'xyz'], axis=1).astype(float)
    seen = np.isfinite(xyz).all(axis=1)
    times = [name for name in ('t', 'time', 'timestamp') if name in table.dtype.names]
    return xyz[seen], table[times[0]][seen].astype(float) if times else np.zeros(0)


def filled(message, frame, stamp, pose):
    """Return the message with its header, and with a pose (4, 4)."""
    message.header.frame_id, message.header.stamp = frame, stamp
    p, q = message.pose.pose.position, message.pose.pose.orientation
    p.x, p.y, p.z = pose[:3, 3].tolist()
    q.x, q.y, q.z, q.w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return message


class LidarFrontEnd(Node):
    """Publishes how the lidar moved, and a loop for each place that is recognised."""

    def __init__(self):
        super().__init__('lidar_front_end')
        self.config = load_config(None)
        self.config.data.max_range = RANGE
        self.config.mapping.voxel_size = 2 * CELL
        self.kiss = KissICP(self.config)
        self.places = MapClosures()
        self.map = VoxelMap(CELL, RANGE)
        self.maps = []
        self.began = None
        self.way = 0.0
        self.odometry = self.create_publisher(Odometry, 'odom', 100)
        self.loops = self.create_publisher(PoseWithCovarianceStamped, 'loop_closures', 100)
        self.create_subscription(PointCloud2, 'points', self._on_points, 100)

    def _on_points(self, cloud):
        points, _ = self.kiss.register_frame(*points_in(cloud))
        now, stamp = self.kiss.last_pose, cloud.header.stamp
        self.odometry.publish(filled(Odometry(child_frame_id='base_link'), 'odom', stamp, now))
        self.way += np.linalg.norm(self.kiss.last_delta[:3, 3])
        if self.began is None or self.way > WAY:
            self._look_back()
            self.began, self.way = (stamp, now), 0.0
        self.map.integrate_frame(points, np.linalg.inv(self.began[1]) @ now)

    def _look_back(self):
        """End a local map, in the frame of its first cloud; look for the place in earlier ones."""
        if self.began is None:
            return
        points = self.map.point_cloud()
        self.map.clear()
        for found in self.places.get_closures(len(self.maps), points):
            if found.number_of_inliers > INLIERS:
                # Where the earlier map lies in this one, true to a cell: it is matched anew.
                before, others = self.maps[found.source_id]
                there = get_voxel_hash_map(self.config)
                there.add_points(others)
                pose = self.kiss.registration.align_points_to_map(
                    voxel_down_sample(points, CELL), there, np.linalg.inv(found.pose), 2.0, CELL)
                loop = PoseWithCovarianceStamped()
                loop.pose.covariance = np.diag(np.repeat(SIGMAS, 3) ** 2).ravel()
                self.loops.publish(filled(
                    loop, f'base_link@{before.sec}.{before.nanosec:09d}', self.began[0], pose))
        self.maps.append((self.began[0], points))


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(LidarFrontEnd())
