"""Files that keep the nodes running on a vehicle: systemd units and the compose file."""

import configparser
import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest
import yaml

from uw_dslam_ros2.node_names import NODES

ROOT = Path(__file__).parents[2]
UNITS = sorted((ROOT / "config" / "systemd").glob("*.service"))
NAMES = {"sonar_mapper", "registration_server", "map_queue_manager"}


def read(path):
    parser = configparser.ConfigParser(interpolation=None, strict=True, delimiters=("=",))
    parser.optionxform = str
    parser.read_string(path.read_text())
    return parser


def executable(unit):
    return re.search(r"ros2 run uw_dslam_ros2 (\w+)", unit["Service"]["ExecStart"])[1]


def test_there_is_a_unit_for_each_node_that_a_mission_needs():
    assert {executable(read(path)) for path in UNITS} == NAMES
    assert set(NODES) >= NAMES


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)
def test_a_unit_restarts_its_node_and_watches_it(path):
    unit = read(path)
    service = unit["Service"]
    assert (service["Type"], service["Restart"]) == ("notify", "always")
    assert int(service["WatchdogSec"]) >= 10
    assert unit["Unit"]["PartOf"] == unit["Install"]["WantedBy"] == "uw-dslam.target"
    settings = re.search(r"/etc/uw_dslam/(\w+[.]yaml)", service["ExecStart"])[1]
    assert (ROOT / "config" / settings).is_file()


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)
def test_a_unit_keeps_what_a_restart_would_lose_where_it_may_write(path):
    service = read(path)["Service"]
    session = re.search(r"session:=(\S+)'", service["ExecStart"])
    if executable(read(path)) == "registration_server":
        assert session is None
        return
    folder = Path("/var/lib") / service["StateDirectory"]
    assert Path(session[1]).is_relative_to(folder)
    # One unit for many vehicles: each has its own.
    assert ("%i" in session[1]) == ("@" in path.name)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
def test_systemd_takes_the_units(tmp_path):
    paths = [shutil.copy(path, tmp_path) for path in (ROOT / "config" / "systemd").iterdir()]
    done = subprocess.run(
        ["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False
    )
    assert "Unknown" not in done.stderr


def test_the_containers_restart_and_are_looked_after():
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    for name, service in services.items():
        assert service["command"][0] == "run"
        assert service["command"][1] in NODES
        if name == "bag_player":
            assert service["healthcheck"] == {"disable": True}
            continue
        assert service["restart"] == "unless-stopped"
        file = service["environment"]["UW_ALIVE_FILE"]
        assert file in service["healthcheck"]["test"][1]


def test_the_containers_keep_what_a_restart_would_lose_outside():
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    sessions = []
    for service in services.values():
        if service["command"][1] in ("sonar_mapper", "map_queue_manager"):
            (session,) = re.findall(r"session:=(\S+)", " ".join(service["command"]))
            mounted = [volume.rsplit(":", 1)[1] for volume in service["volumes"]]
            assert any(Path(session).is_relative_to(folder) for folder in mounted)
            sessions.append(session)
    assert len(set(sessions)) == len(sessions) == 4


@pytest.fixture
def listener(tmp_path):
    receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    receiver.bind(str(tmp_path / "notify"))
    receiver.settimeout(1.0)
    yield receiver
    receiver.close()


def test_a_heartbeat_reaches_systemd_and_the_file(listener, tmp_path):
    heartbeat_module = pytest.importorskip("uw_dslam_ros2.ros.plumbing.heartbeat")
    file = tmp_path / "alive"
    heart = heartbeat_module.Heartbeat(
        {
            "NOTIFY_SOCKET": listener.getsockname(),
            "WATCHDOG_USEC": "30000000",
            "UW_ALIVE_FILE": str(file),
        }
    )
    assert not file.exists()
    heart.is_ready()
    heart.beat()
    heart.beat()  # too soon
    heart.is_stopping()
    said = [listener.recv(100) for _ in range(3)]
    assert said == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]
    assert file.exists()
    listener.close()
    heart.is_ready()  # nobody listens any more


def test_without_anybody_who_asks_nothing_is_told():
    heartbeat_module = pytest.importorskip("uw_dslam_ros2.ros.plumbing.heartbeat")
    heart = heartbeat_module.Heartbeat({})
    heart.is_ready()
    heart.beat()
