# Copyright 2026 l1slam_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
# SPDX-License-Identifier: Apache-2.0
"""What `ros2 node info` and `ros2 lifecycle` show: the node's interface."""

from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from node_bench import call, odometry, parameters_of
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy, qos_profile_sensor_data

import l1slam_ros as l1

CONFIG = Path(__file__).parents[2] / 'config'
INPUTS = {
    '/odom': 'nav_msgs/msg/Odometry',
    '/loop_closures': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/trusted_loop_closures': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/false_loop_closures': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/absolute_poses': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}
OUTPUTS = {
    '/path': 'nav_msgs/msg/Path',
    '/pose': 'geometry_msgs/msg/PoseStamped',
    '/pose_with_covariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/map_to_odom': 'geometry_msgs/msg/TransformStamped',
    '/graph': 'visualization_msgs/msg/MarkerArray',
    '/loop_status': 'diagnostic_msgs/msg/DiagnosticArray',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
SERVICES = {
    **{f'/backend/{name}': 'std_srvs/srv/Trigger' for name in ('optimize', 'reset', 'save',
                                                               'load')},
    '/backend/pause': 'std_srvs/srv/SetBool',
}
LATCHED = {'/path', '/graph', '/loop_status'}
# Only where their messages are installed.
ELSEWHERE = {'/map_graph', '/pose_graph', '/tf', '/slam_toolbox/pose_graph',
             '/slam_toolbox/new_node_event', '/cslam/keyframe_odom',
             '/cslam/intra_robot_loop_closure', '/cslam/inter_robot_loop_closure'}
# The types of what every node has, a managed one too.
OF_ROS = 'lifecycle_msgs/', 'rcl_interfaces/', 'type_description_interfaces/'


def test_topics_and_services_are_those_of_the_interface(bench):
    b = bench()

    def named():
        return [{name: kind for name, (kind,) in named_by('backend', '/')
                 if not kind.startswith(OF_ROS)}
                for named_by in (b.peer.get_subscriber_names_and_types_by_node,
                                 b.peer.get_publisher_names_and_types_by_node,
                                 b.peer.get_service_names_and_types_by_node)]

    b.until(lambda: named() == [INPUTS, OUTPUTS, SERVICES], 'this is found, and nothing else')
    assert state(b) == 'active', 'unless it is managed'
    for topic in INPUTS:
        (end,) = b.peer.get_subscriptions_info_by_topic(topic)
        assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        override = f'qos_overrides.{topic}.subscription'
        assert parameters_of(b, f'{override}.reliability', f'{override}.depth') == [
            'reliable', 1000]
    for topic in OUTPUTS:
        (end,) = b.peer.get_publishers_info_by_topic(topic)
        latched = end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert latched == (topic in LATCHED), topic
        assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE


def test_parameters_given_by_a_wrong_name_are_told_of(bench, capfd):
    """To rclpy they are none: `keyframe.translaton` would do nothing without a word."""
    bench(**{'keyframe.translaton': 2.0, 'solver.norm': 'l1', 'zzz': 1,
             'qos_overrides./odm.subscription.reliability': 'best_effort'})
    told = [line.split(': ', 1)[1] for line in capfd.readouterr().err.splitlines()
            if 'there is no parameter' in line]
    assert told == [
        "there is no parameter 'keyframe.translaton': it is not used; did you mean "
        "'keyframe.translation'?",
        "there is no parameter 'qos_overrides./odm.subscription.reliability': it is not used; "
        "did you mean 'qos_overrides./odom.subscription.reliability'?",
        "there is no parameter 'zzz': it is not used"]


def test_what_shows_the_map_shows_each_topic_as_what_it_is():
    """
    In RViz with the durability that it has, or who starts it late sees nothing of what stands.

    In both a person can say where the robot is.
    """
    rviz = yaml.safe_load((CONFIG / 'l1slam.rviz').read_text())['Visualization Manager']
    topics = {'/' + display['Topic']['Value']: (display['Class'].split('/')[1], display['Topic'])
              for display in rviz['Displays'] if 'Topic' in display}
    assert topics.keys() == {'/map', '/scan', '/path', '/pose', '/pose_with_covariance', '/graph'}
    assert topics['/scan'][1]['Reliability Policy'] == 'Best Effort', 'as a laser publishes'
    for topic in topics.keys() & OUTPUTS.keys():
        kind, qos = topics[topic]
        assert kind == OUTPUTS[topic].split('/')[2].removesuffix('Stamped')
        assert (qos['Durability Policy'] != 'Volatile') == (topic in LATCHED)
    panels = yaml.safe_load((CONFIG / 'foxglove.json').read_text())['configById']  # JSON is YAML
    shown = panels['3D!map']['topics'].keys() | {
        panels['DiagnosticSummary!all']['topicToRender'], panels['RawMessages!loops']['topicPath']}
    assert shown < OUTPUTS.keys() | {'/map', '/scan'} and len(shown) == 8
    (tool,) = (tool for tool in rviz['Tools'] if tool['Class'].endswith('/SetInitialPose'))
    for topic in '/' + tool['Topic']['Value'], panels['3D!map']['publish']['poseEstimateTopic']:
        assert INPUTS[topic] == 'geometry_msgs/msg/PoseWithCovarianceStamped'


def change(b, transition):
    request = ChangeState.Request(transition=Transition(id=transition))
    return call(b, 'change_state', request, ChangeState).success


def state(b):
    return call(b, 'get_state', kind=GetState).current_state.label


def test_a_node_that_is_managed_does_as_it_is_told(bench, tmp_path):
    path = tmp_path / 'map.g2o'
    b = bench(autostart=False, save_path=str(path))
    assert not change(b, Transition.TRANSITION_ACTIVATE) and state(b) == 'unconfigured'
    b.send('/odom', odometry(10**9, 0.0))
    b.until(lambda: b.count('odom.received') == 1, 'it has come')
    assert not b.received['pose'] and not b.received['map_to_odom']
    assert change(b, Transition.TRANSITION_CONFIGURE) and state(b) == 'inactive'
    assert change(b, Transition.TRANSITION_ACTIVATE) and state(b) == 'active'
    b.drive(1, 3)
    b.map_of(2)
    b.until(lambda: b.received['map_to_odom'], 'a transform')
    assert len(b.received['pose']) == 2
    assert change(b, Transition.TRANSITION_DEACTIVATE)
    b.drive(3, 4)
    b.until(lambda: b.count('odom.received') == 4, 'it has come')
    assert change(b, Transition.TRANSITION_CLEANUP) and state(b) == 'unconfigured'
    b.map_of(0)
    b.until(path.exists, 'it is saved; the next autosave would be a minute later')
    assert l1.read_graph(path)[0].n_poses == 2
    assert change(b, Transition.TRANSITION_CONFIGURE) and change(b, Transition.TRANSITION_ACTIVATE)
    assert change(b, Transition.TRANSITION_ACTIVE_SHUTDOWN) and state(b) == 'finalized'
    b.drive(4, 5)
    b.until(lambda: b.count('odom.received') == 5, 'it has come')
    assert len(b.received['pose']) == 2


def test_publishers_that_cannot_be_heard_are_noticed(bench, capfd):
    """The drivers of many robots publish odometry best effort; the node would wait for ever."""
    b = bench()
    b.until(lambda: b.status()[1] == 'ok', 'all is fine')
    deaf = b.peer.create_publisher(Odometry, '/odom', qos_profile_sensor_data)
    b.until(lambda: b.status()[1] == (
        '1 of the publishers of /odom cannot be heard: best effort publisher and reliable '
        'subscription; expected the same QoS, or qos_overrides./odom.subscription.reliability: '
        'best_effort'), 'it is said')
    assert b.status()[0] == DiagnosticStatus.WARN
    assert "[backend]: New publisher discovered on topic 'odom', offering incompat" in (
        capfd.readouterr().err)
    b.peer.destroy_publisher(deaf)
    b.until(lambda: b.status()[1] == 'ok', 'it is gone')


def test_two_nodes_of_one_name_are_noticed(bench):
    b = bench()
    b.until(lambda: b.status()[1] == 'ok', 'one is fine')
    other = bench()
    b.until(lambda: '2 nodes are called /backend; expected one' in b.status()[1], 'it is said')
    # So do two robots that send their odometry there.
    assert b.status()[0] == DiagnosticStatus.WARN
    b.until(lambda: 'odom has 2 publishers; expected one' in b.status()[1], 'this, too')
    other.close()
