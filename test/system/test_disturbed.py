"""A replay in which everything goes wrong that can: what is saved is as true as undisturbed."""

import os
import signal
import time
from collections import defaultdict
from dataclasses import replace

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger
from uw_dslam_msgs.msg import MergeStatus, Submap
from uw_dslam_msgs.srv import SaveSession

from uw_dslam_ros2.cli.running.mapping import map_recording, settle
from uw_dslam_ros2.cli.running.processes import Children
from uw_dslam_ros2.core.chart.redraw import redrawn
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.metrics import trajectory_error
from uw_dslam_ros2.core.registration import GridRegistrationConfig
from uw_dslam_ros2.io.recordings import BagWriter, open_bag
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.io.vehicles import find_recordings
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]

VEHICLES = ("auv_1", "auv_2")
PATIENCE_S = 120.0
ASK_AGAIN_S = 5.0
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MANY = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
IS_LATCHED = ("/tf_static",)


class Fleet:
    """Processes that can be killed and started again, and a client that meddles."""

    def __init__(self, domain_id, children):
        self._children, self._running = children, {}
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node("meddler", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.status = None
        self._seen = set()
        self.num_doubled = 0
        self.node.create_subscription(MergeStatus, "/merge_status", self._on_status, LATCHED)
        for vehicle in VEHICLES:
            publisher = self.node.create_publisher(Submap, f"/{vehicle}/submap", MANY)
            self.node.create_subscription(
                Submap, f"/{vehicle}/submap", lambda m, p=publisher: self._double(m, p), MANY
            )

    def _on_status(self, msg):
        self.status = msg

    def _double(self, msg, publisher):
        """Each submap is sent again, once whole and once cut off."""
        key = (msg.vehicle_id, msg.run_id, msg.sequence, msg.revision)
        if key not in self._seen:
            self._seen.add(key)
            content = bytes(serialize_message(msg))
            publisher.publish(content)
            publisher.publish(content[: len(content) // 2])
            self.num_doubled += 1

    def start(self, name, node, *arguments):
        """Start a node of ours, also in the place of one that has ended."""
        child = self._children.start(
            name, f"uw_dslam_ros2.ros.nodes.{node}", arguments, may_end=True
        )
        self._running[name] = (child, node, arguments)
        return child

    def end(self, name, number):
        """End a process by a signal; one that may tidy up leaves with 0."""
        child, node, arguments = self._running[name]
        os.kill(child._process.pid, number)
        code = child._process.wait(10.0)
        assert code == (-number if number == signal.SIGKILL else 0), child.tail()
        return node, arguments

    def restart(self, **number):
        """End nodes by these signals, all at once, and start them again."""
        ended = {name: self.end(name, signal_number) for name, signal_number in number.items()}
        self.status = None
        for name, (node, arguments) in ended.items():
            self.start(name, node, *arguments)
        self.until(lambda: self.status and self.status.num_servers == 1, "manager and server")

    def play(self, bags, start_s, duration_s):
        """Play a part of the bags, to whoever listens now."""
        arguments = [*map(str, bags), "--start-s", str(start_s), "--duration-s", str(duration_s)]
        arguments += ["--rate", "1000", "--max-lag-s", "5", "--wait-s", str(PATIENCE_S)]
        arguments += ["--wait-for"]
        arguments += [f"/{v}/{sensor}" for v in VEHICLES for sensor in ("sonar", "imu", "dvl")]
        player = self.start("player", "bag_player", *arguments)
        self.until(lambda: player.poll() is not None, "the end of the bags")
        assert player.poll() == 0, player.tail()

    def runs(self):
        """Sequence numbers by vehicle and run, of what the manager has told of."""
        found = defaultdict(lambda: defaultdict(set))
        for info in self.status.submaps if self.status else ():
            found[info.vehicle_id][info.run_id].add(info.sequence)
        return found

    def until(self, is_true, what, patience_s=PATIENCE_S):
        end_s = time.monotonic() + patience_s
        while not is_true():
            message = self.status.message if self.status else "no status"
            assert time.monotonic() < end_s, f"not within {patience_s} s: {what}: {message}"
            self._executor.spin_once(timeout_sec=0.1)

    def call(self, service_type, name, **fields):
        """Ask until there is an answer: a node that was killed still seems to be there."""
        client = self.node.create_client(service_type, name)
        futures = []

        def is_answered():
            if len(futures) <= (time.monotonic() - begun_s) // ASK_AGAIN_S:
                futures.append(client.call_async(service_type.Request(**fields)))
            return any(future.done() for future in futures)

        self.until(client.service_is_ready, name)
        begun_s = time.monotonic()
        self.until(is_answered, f"answer of {name}")
        return next(future.result() for future in futures if future.done())

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    """Two vehicles that survey mostly the same water, with a small sonar."""
    config = replace(tiny_mission_config(3), duration_s=100.0)
    return simulate_mission(tmp_path_factory.mktemp("mission"), config, num_processes=2)


@pytest.fixture
def fleet(ros_domain_id, tmp_path):
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "ros_logs"),
        "OMP_NUM_THREADS": "1",
    }
    with Children(environment, tmp_path / "logs") as children:
        made = Fleet(ros_domain_id, children)
        yield made
        made.close()


def error_of(mission, trajectories):
    truth = {
        vehicle: read_tum(path)
        for vehicle, path in zip(mission.vehicle_ids, mission.truth_trajectories, strict=True)
    }
    return trajectory_error(trajectories, truth)


def undisturbed(mission):
    """What the same core makes of the same bags when nothing happens, the last pass included."""
    queue, config = MapQueue(), VehicleMapperConfig()
    for recording in find_recordings(list(mission.bags))[0]:
        mapped = map_recording(recording, config)
        for submap in redrawn(mapped.submaps, mapped.pings, config.occupancy):
            queue.add_submap(submap)
    settle(queue, GridRegistrationConfig())
    return error_of(mission, queue.trajectories())


def disturbed_copy(bag, path):
    """Of the sensors' messages every 20th is lost, every 7th comes twice, every 50th is cut."""
    with open_bag(bag) as reader, BagWriter(path) as writer:
        for topic, msgtype in reader.topics.items():
            writer.add_topic(topic, msgtype, is_latched=topic in IS_LATCHED)
        for number, raw in enumerate(reader.raw()):
            is_sensor = raw.topic not in IS_LATCHED
            if is_sensor and number % 20 == 10:
                continue
            is_cut = is_sensor and number % 50 == 25
            data = raw.data[: len(raw.data) // 2] if is_cut else raw.data
            for _ in range(1 + (number % 7 == 3)):
                writer.write_raw(raw.topic, raw.stamp_ns, data)
    return path


def test_restarts_and_bad_messages_leave_the_trajectories_true(fleet, mission, tmp_path):
    bags = [disturbed_copy(bag, tmp_path / bag.name) for bag in mission.bags]
    ros = ["--ros-args", "-p", "use_sim_time:=true"]
    for vehicle in VEHICLES:
        mapper = ["-r", f"__ns:=/{vehicle}", "-p", "is_reliable:=true"]
        mapper += ["-p", f"session:={tmp_path / vehicle}"]
        fleet.start(vehicle, "sonar_mapper", *ros, *mapper)
    fleet.start("server", "registration_server", *ros)
    session = ["-p", f"session:={tmp_path / 'session'}", "-p", "publish_period_s:=0.1"]
    fleet.start("manager", "map_queue_manager", *ros, *session)
    fleet.until(lambda: fleet.status and fleet.status.num_servers == 1, "the server")

    fleet.play(bags, 0.0, 35.0)
    fleet.until(lambda: set(fleet.runs()) == set(VEHICLES), "a submap of each vehicle")
    fleet.restart(auv_1=signal.SIGKILL)
    fleet.play(bags, 35.0, 30.0)
    fleet.restart(auv_2=signal.SIGTERM, server=signal.SIGKILL, manager=signal.SIGTERM)
    fleet.play(bags, 65.0, 100.0)
    for vehicle in VEHICLES:
        answer = fleet.call(Trigger, f"/{vehicle}/sonar_mapper/finish")
        assert answer.success, answer.message
    fleet.restart(server=signal.SIGTERM, manager=signal.SIGKILL)
    fleet.call(Trigger, "/map_queue_manager/settle")
    fleet.until(
        lambda: fleet.status.num_waiting == fleet.status.num_in_flight == 0, "all are merged"
    )

    assert fleet.num_doubled
    # With a session on disk a mapper that is started again goes on with its run.
    assert [len(fleet.runs()[vehicle]) for vehicle in VEHICLES] == [1, 1]
    assert fleet.status.num_components == 1
    saved = fleet.call(SaveSession, "/map_queue_manager/save_session", path=str(tmp_path / "out"))
    assert saved.result == SaveSession.Response.DONE, saved.message
    found = error_of(
        mission,
        {v: read_tum(tmp_path / "out" / "trajectories" / f"{v}.tum") for v in VEHICLES},
    )
    expected = undisturbed(mission)
    assert found.num_poses > 0.7 * expected.num_poses
    assert found.rmse_m <= 1.2 * expected.rmse_m, (found, expected)
