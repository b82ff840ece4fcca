"""Several robots in one back end: their maps, what joins them, and what is saved of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from problems import covariance6, seconds

from l1slam_ros.core.geometry import se2
from l1slam_ros.core.graph.factor_graph import FactorGraph
from l1slam_ros.core.graph.measurements import LoopClosure, OdometrySample
from l1slam_ros.core.robust.batch import robust_solve
from l1slam_ros.core.running.backend import Backend, BackendOptions
from l1slam_ros.core.running.snapshot import ACCEPTED
from l1slam_ros.core.worlds.simulate import WorldOptions, simulate_world, with_false_loops
from l1slam_ros.core.worlds.false_loops import random_false_loops
from l1slam_ros.io.graphs.saved_map import load_map, save_map

EVERY = BackendOptions.from_mapping({
    'keyframe': {'translation': 0.0, 'rotation': 0.0}, 'on_time_jump': 'ignore',
    'odometry': {'covariance_source': 'increment'}})
UNKNOWN = np.zeros((6, 6))


class Team:
    """
    A world driven by two robots, each a half of it, with odometry of its own, and lies.

    graph : as one file has it, one robot behind the other
    """

    def __init__(self, n=400, edges=1400, lies=300, seed=3):
        options = WorldOptions(odometry_sigma_rotation=0.005)
        rng = np.random.default_rng(seed)
        world = simulate_world(n, edges, options, rng)
        if lies:
            world = with_false_loops(world, random_false_loops(
                world.graph, world.truth, lies, rng))
        self.half, whole = n // 2, world.graph.between
        self.robot = (np.arange(n) >= self.half).astype(int)
        seam = (whole.i == self.half - 1) & (whole.j == self.half)
        graph = world.graph.subset(~seam)
        self.graph = FactorGraph(se2, 0)
        self.graph.add_poses(n)
        self.graph.drive(self.robot)
        f = graph.between
        self.graph.append_between(f.i, f.j, f.measurement, f.sqrt_information)
        self.truth, self.factors = world.truth, self.graph.between
        self.odometry = np.zeros((n, 3))
        steps = self.factors.step_to
        for k in range(n):
            if steps[k] >= 0:
                self.odometry[k] = se2.compose(
                    self.odometry[k - 1:k], self.factors.measurement[steps[k]][None])[0]

    def stamp(self, k):
        return seconds(10 + k % self.half)

    def sample(self, k):
        step, cov = self.factors.step_to[k], UNKNOWN
        if step >= 0:
            root = self.factors.sqrt_information[step]
            cov = covariance6(np.linalg.inv(root.T @ root))
        pose3 = se2.to_pose3(self.odometry[k:k + 1])[0]
        return OdometrySample(self.stamp(k), pose3, cov, UNKNOWN)

    def loops(self):
        """Yield rows of loops, and them."""
        for row in np.flatnonzero(~self.factors.is_odometry):
            i, j, root = self.factors.i[row], self.factors.j[row], self.factors.sqrt_information[
                row]
            yield i, j, LoopClosure(
                self.stamp(i), self.stamp(j),
                se2.to_pose3(self.factors.measurement[row:row + 1])[0],
                covariance6(np.linalg.inv(root.T @ root)), robot=int(self.robot[j]),
                reference_robot=int(self.robot[i]))

    def messages(self, late=0):
        """Return (robot, message) as they come, those of the second robot so much later [s]."""
        events = [((k % self.half) + late * self.robot[k], 0, int(self.robot[k]), self.sample(k))
                  for k in range(len(self.robot))]
        events += [(max(i % self.half + late * self.robot[i], j % self.half + late * self.robot[
            j]), 1, int(self.robot[j]), found) for i, j, found in self.loops()]
        return [event[2:] for event in sorted(events, key=lambda event: event[:2])]

    def fill(self, backend, late=0):
        for robot, message in self.messages(late):
            if isinstance(message, LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message, robot)


def accepted_by_times(states, robots):
    return {(*robots[row].tolist(), *states.stamps[row].tolist())
            for row in np.flatnonzero(states.state[:len(robots)] == ACCEPTED)}


@pytest.mark.parametrize('late', [0, 5])
def test_the_loops_that_batch_believes_are_believed_interleaved(late):
    team, backend = Team(), Backend(EVERY)
    team.fill(backend, late)
    backend.settle()
    now = backend.snapshot()
    assert now.graph.n_poses == 400 and len(now.graph.firsts) == 1
    assert np.count_nonzero(np.diff(now.graph.robot)) > 300
    batch = robust_solve(team.graph)[0].accepted & ~team.factors.is_odometry
    expected = {(team.robot[i], team.robot[j], team.stamp(i), team.stamp(j)) for i, j in zip(
        team.factors.i[batch], team.factors.j[batch], strict=True)}
    found = accepted_by_times(now.loop_states(), now.loop_robots[0])
    assert len(expected) > 200 and len(expected ^ found) <= 0.01 * len(expected)
    assert all(one.joined for one in now.robot_maps.values())
    for robot in (0, 1):
        keyframes, poses = now.poses_in_map(robot)
        truth = se2.between(np.tile(team.truth[:1], (200, 1)), team.truth[team.robot == robot])
        assert np.abs(poses - truth)[:, :2].max() < 0.7


def test_a_robot_that_nothing_joins_has_its_own_map_and_moves_whole_when_a_loop_is_believed():
    team, backend = Team(lies=0, n=160, edges=500), Backend(EVERY)
    joins = []
    for robot, message in team.messages():
        if isinstance(message, OdometrySample):
            backend.add_odometry(message, robot)
            if message.stamp == seconds(12):  # from its first second on
                while backend.update(1.0) is not None:
                    pass
        elif message.robots == (0, 1):
            joins.append(message)
        else:
            backend.add_loop(message)
    backend.settle()
    now, one = backend.snapshot(), backend.robot(1)
    assert backend.robot(0).joined and not one.joined
    keyframes, poses = now.poses_in_map(1)
    assert_allclose(poses[0], [0.0, 0.0, 0.0], atol=1e-12)
    assert_allclose(se2.compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)
    shape = se2.between(np.tile(team.truth[80:81], (80, 1)), team.truth[80:])
    assert np.abs(poses - shape)[:, :2].max() < 0.5
    for loop in joins:
        backend.add_loop(loop)
    backend.settle()
    now, one = backend.snapshot(), backend.robot(1)
    assert one.joined and len(joins) > 5
    poses = now.poses_in_map(1)[1]
    truth = se2.between(np.tile(team.truth[:1], (80, 1)), team.truth[80:])
    assert np.abs(poses - truth)[:, :2].max() < 0.7
    assert_allclose(se2.compose(one.map_to_odom, one.odometry), poses[-1:], atol=1e-9)
    assert_array_equal(keyframes, now.poses_in_map(1)[0])


def test_a_map_of_two_robots_is_saved_and_goes_on(tmp_path):
    team, backend = Team(n=120, edges=400, lies=40), Backend(EVERY)
    messages = team.messages()
    for some in (messages[:300], messages[300:]):
        for robot, message in some:
            if isinstance(message, LoopClosure):
                backend.add_loop(message)
            else:
                backend.add_odometry(message, robot)
        backend.settle()
        save_map(tmp_path / 'map.g2o', backend.saved())
        before, backend = backend, Backend(EVERY)
        backend.restore(load_map(tmp_path / 'map.g2o')[0])
        now, then = backend.snapshot(), before.snapshot()
        assert_array_equal(now.graph.robot, then.graph.robot)
        assert_array_equal(now.graph.predecessor, then.graph.predecessor)
        assert_allclose(now.poses, then.poses, atol=1e-9)
        for robot in (0, 1):
            assert_allclose(now.poses_in_map(robot)[1], then.poses_in_map(robot)[1], atol=1e-9)
        assert_array_equal(now.loop_robots[0], then.loop_robots[0])
        assert_array_equal(now.loop_states().state, then.loop_states().state)
    assert now.graph.n_poses == 120


def test_a_robot_comes_late_and_may_be_any(tmp_path):
    """The second one alone, too: what the map is of is said by its number."""
    team, backend = Team(lies=0, n=80, edges=240), Backend(EVERY)
    for k in range(40, 80):
        backend.add_odometry(team.sample(k), 1)
    backend.settle()
    assert backend.robot() is None and backend.robot(1) is not None
    save_map(tmp_path / 'map.g2o', backend.saved())
    backend = Backend(EVERY)
    backend.restore(load_map(tmp_path / 'map.g2o')[0])
    assert (backend.snapshot().graph.robot == 1).all()
    for k in range(40):
        backend.add_odometry(team.sample(k), 0)
    for _, _, loop in team.loops():
        backend.add_loop(loop)
    backend.settle()
    now = backend.snapshot()
    assert backend.robot(0).joined and now.robot_maps[1].joined
    poses = now.poses_in_map(0)[1]
    assert_allclose(poses[0], [0.0, 0.0, 0.0], atol=1e-12)
    for robot in (0, 1):
        truth = se2.between(np.tile(team.truth[:1], (40, 1)), team.truth[team.robot == robot])
        assert np.abs(now.poses_in_map(robot)[1] - truth)[:, :2].max() < 0.7
