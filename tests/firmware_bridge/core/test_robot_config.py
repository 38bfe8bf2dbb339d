"""Robot files: every key checked, one clear line for what is wrong."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_bridge.core.config import CameraConfig, ConfigError, load_robot_config
from tests.support.processes import GO2_SIM

GO2 = GO2_SIM.with_name("go2.toml")


def test_simulated_and_real_robot_differ_in_addresses_and_arming_only() -> None:
    simulated, real = load_robot_config(GO2_SIM), load_robot_config(GO2)
    assert simulated.dds.interface == "lo" != real.dds.interface and real.bridge.deadman_ms == 250
    assert replace(simulated, dds=real.dds, safety=replace(simulated.safety, operator_arm=True)) == real


@pytest.mark.parametrize("path", sorted(GO2_SIM.parent.glob("*.toml")), ids=lambda path: path.stem)
def test_a_runner_arms_by_itself_on_simulated_robots_only(path: Path) -> None:
    """Who copies a real robot's file and starts the programs must not set it in motion by that."""
    assert load_robot_config(path).safety.operator_arm == (not path.stem.endswith("_sim"))


def test_a_relative_socket_lies_in_the_runtime_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert load_robot_config(GO2_SIM).bridge.socket == tmp_path / "tic-vla-edge" / "bridge.sock"


def test_a_dbc_file_is_that_of_the_robot_files_folder_else_the_shipped_one(tmp_path: Path) -> None:
    shipped = GO2_SIM.with_name("example_can.toml")
    copied, mine = tmp_path / "base.toml", tmp_path / "example_base.dbc"
    copied.write_text(shipped.read_text())
    before = load_robot_config(copied).can
    mine.write_text(shipped.with_name("example_base.dbc").read_text())
    after = load_robot_config(copied).can
    assert before is not None and before.dbc_path == shipped.with_name("example_base.dbc")
    assert after is not None and after.dbc_path == mine


def test_arguments_override_socket_and_domain(tmp_path: Path) -> None:
    config = load_robot_config(GO2_SIM, socket=tmp_path / "s", domain=7)
    assert (config.bridge.socket, config.dds.domain) == (tmp_path / "s", 7)


def test_a_dbc_file_in_a_folder_that_cannot_be_read_is_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(_: Path) -> bool:
        raise PermissionError(13, "Permission denied")

    copied = tmp_path / "base.toml"
    copied.write_text(GO2_SIM.with_name("example_can.toml").read_text())
    with monkeypatch.context() as patch:
        patch.setattr(Path, "is_file", denied)
        config = load_robot_config(copied).can
    assert config is not None and config.dbc_path == GO2_SIM.with_name("example_base.dbc")


@pytest.mark.parametrize(
    ("file", "address"),
    [
        ("go2_sim.toml", r"DDS domain \d+ on lo"),
        ("ros2_base.toml", r"DDS domain \d+ on \S+"),
        ("rover_px4.toml", r"MAVLink \S+"),
        ("example_can.toml", r"CAN \S+:\S+"),
    ],
)
def test_messages_name_the_robots_address(file: str, address: str) -> None:
    assert re.fullmatch(address, load_robot_config(GO2_SIM.with_name(file)).address)


def test_a_mavlink_link_is_an_address_of_the_network_or_a_serial_device_with_its_speed() -> None:
    rover = load_robot_config(GO2_SIM.with_name("rover_px4.toml")).mavlink
    assert rover is not None
    network = replace(rover, link="udp:10.0.0.7:14540")
    assert (network.address, network.serial) == (("10.0.0.7", 14540), None)
    line = replace(rover, link="serial:/dev/ttyACM0:57600")
    assert line.serial == line.address == ("/dev/ttyACM0", 57600)


@pytest.mark.parametrize(
    ("link", "complaint"),
    [
        ("udp:10.0.0.7:" + "1" * 5000, "mavlink.link: expected udp:HOST:PORT or serial:PATH:BAUD"),
        ("serial:/dev/ttyACM0:" + "9" * 5000, "mavlink.link: expected udp:HOST:PORT or serial:PATH:BAUD"),
        ("serial:/dev/ttyACM0:20000000", "mavlink.link: expected udp:HOST:PORT or serial:PATH:BAUD"),
        ("serial:/dev/ttyACM0:1000001", "mavlink.link: expected a speed of 57600"),
        ("udp:10.0.0.7:0", "mavlink.link: expected an IPv4 address and a port"),
        ("udp:10.0.0.7:65536", "mavlink.link: expected an IPv4 address and a port"),
        ("udp:10.0.0." + "1" * 5000 + ":14540", "mavlink.link: expected an IPv4 address and a port"),
        ("udp:10.0.0.256:14540", "mavlink.link: expected an IPv4 address and a port"),
        ("udp:010.0.0.7:14540", "mavlink.link: expected an IPv4 address and a port"),
        ("udp:rover:14540", "mavlink.link: expected an IPv4 address and a port"),
    ],
)
def test_a_mavlink_link_of_another_form_is_refused_in_one_line(link: str, complaint: str) -> None:
    rover = load_robot_config(GO2_SIM.with_name("rover_px4.toml")).mavlink
    assert rover is not None
    with pytest.raises(ConfigError, match=re.escape(complaint)):
        replace(rover, link=link)


@pytest.mark.parametrize("number", ["2", "-2", "2.5", "2.", ".5", "-.5", "9" * 20, "0." + "9" * 20])
def test_a_constant_of_a_can_message_is_a_decimal_number(number: str) -> None:
    base = load_robot_config(GO2_SIM.with_name("example_can.toml")).can
    assert base is not None
    replace(base, constants=(f"DriveCommand.Gear={number}",))


@pytest.mark.parametrize(
    "number", ["", "-", ".", "--2", "+2", "2-", "1e3", "0x2", "2.5.1", "٣", "9" * 21, "0." + "9" * 21]
)
def test_another_constant_of_a_can_message_is_refused(number: str) -> None:
    base = load_robot_config(GO2_SIM.with_name("example_can.toml")).can
    assert base is not None
    with pytest.raises(ConfigError, match=r'can.constants: expected "MESSAGE.SIGNAL=NUMBER", found'):
        replace(base, constants=(f"DriveCommand.Gear={number}",))


def test_a_base_whose_latched_stop_the_bridge_resets_must_name_its_state_after_a_stop() -> None:
    base = load_robot_config(GO2_SIM.with_name("carter_can_sim.toml")).can
    assert base is not None and base.state is not None and base.estop is not None
    unnamed = replace(base.state, estop=-1)
    for changes in ({"state": unnamed}, {"state": None, "mode": None}):
        with pytest.raises(ConfigError, match=r"missing key can.state.estop"):
            replace(base, **changes)
        for part in ("latched", "request"):
            replace(base, **changes, estop=replace(base.estop, **{part: ""}))
        replace(base, **changes, estop=None)
    replace(base, state=replace(base.state, estop=0))


def test_the_bridge_has_the_rovers_mavlink_system_number_unless_it_has_one_of_its_own() -> None:
    rover = load_robot_config(GO2_SIM.with_name("rover_px4.toml")).mavlink
    assert rover is not None
    assert replace(rover, own_system=0, system=7).station == 7
    assert replace(rover, own_system=9, system=7).station == 9


@pytest.mark.parametrize(("value", "reliable"), [("reliable", True), ("best_effort", False)])
def test_the_inputs_of_a_ros_2_robot_are_reliable_where_its_file_says_so(value: str, reliable: bool) -> None:
    base = load_robot_config(GO2_SIM.with_name("ros2_base.toml")).ros2
    assert base is not None
    assert replace(base, input_reliability=value).reliable_inputs == reliable


def test_a_domain_for_a_robot_without_dds_is_refused() -> None:
    with pytest.raises(ConfigError, match="protocol can: expected one that uses DDS"):
        load_robot_config(GO2_SIM.with_name("example_can.toml"), domain=7)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("rate_hz = 50", "rate_hz = 50\nspeed = 1", "unknown key bridge.speed"),
        ("deadman_ms = 250", "deadman_ms = 251", "bridge.deadman_ms: expected 20..250, found 251"),
        ("deadman_ms = 250", "deadman_ms = true", "bridge.deadman_ms: expected int, found True"),
        ("vx_max_mps = 0.8", "vx_max_mps = 4.0", "limits.vx_max_mps: expected 0..3.8, found 4.0"),
        ("vx_max_mps = 0.8", "vx_max_mps = nan", "limits.vx_max_mps: expected float, found nan"),
        ("accel_mps2 = 2.0", "", "missing key limits.accel_mps2"),
        ('interface = "lo"', 'interface = "lo\\"/>"', "dds.interface/peers"),
        ('protocol = "unitree"', 'protocol = "carrier pigeon"', "protocol: expected one of"),
        ('velocity_frame = "odom"', 'velocity_frame = "map"', "odometry.velocity_frame"),
        ("[limits]", "[limits", "cannot be read"),
        ("[camera]", "[[camera]]", "[camera]: expected a table, found ["),
        ("accel_mps2 = 2.0", f"accel_mps2 = {10**400}", "limits.accel_mps2: expected float, found 1"),
        ("accel_mps2 = 2.0", "accel_mps2 = 1e301", "limits.accel_mps2: expected float, found 1e+301"),
        ('protocol = "unitree"', 'protocol = ["can"]', "protocol: expected str, found ['can']"),
        ('protocol = "unitree"', "protocol = {can = 1}", "protocol: expected str, found {'can': 1}"),
        (
            'protocol = "unitree"',
            'protocol = ["ros2"]\n[ros2]\npublish = true',
            "protocol: expected str, found ['ros2']",
        ),
        (
            "battery_min_percent = 10",
            "battery_min_percent = 91",
            "safety.battery_min_percent: expected 0..90, found 91",
        ),
        ('["L2", "B"]', '["L2", "C"]', "safety.remote_estop_keys: expected one or more of R1"),
        ('["L2", "B"]', "[]", "safety.remote_estop_keys: expected one or more of R1"),
        ("remote_deadband = 0.1", "remote_deadband = 0", "safety.remote_deadband: expected 0.01..0.5, found 0.0"),
        ("remote_deadband = 0.1", 'estop_file = "gpio"', "safety.estop_file: expected an absolute path"),
        ("operator_arm = false", "operator_arm = 1", "safety.operator_arm: expected bool, found 1"),
        ("accepted_error_codes = [0]", "accepted_error_codes = [true]", "expected int, found True"),
        ('socket = "bridge.sock"', 'socket = "a\\u0000b"', "bridge.socket: expected Path"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, before: str, after: str, complaint: str) -> None:
    path = tmp_path / "robot.toml"
    text = GO2_SIM.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(ConfigError) as error:
        load_robot_config(path)
    assert complaint in str(error.value) and str(path) in str(error.value)
    assert "\n" not in str(error.value)


def robot_file(folder: Path, limits: dict[str, float], *, above_walking_speed: bool = False) -> Path:
    """The simulated robot's file with other limits."""
    text = GO2_SIM.read_text()
    for key, value in limits.items():
        text, changed = re.subn(rf"^{key} = \S+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert changed == 1
    if above_walking_speed:
        text = text.replace("above_walking_speed = false", "above_walking_speed = true")
    path = folder / "robot.toml"
    path.write_text(text)
    return path


# (key, largest magnitude without the opt-in, and with it)
FASTEST = [
    ("vx_max_mps", 1.5, 3.8),
    ("vx_min_mps", -1.0, -2.5),
    ("vy_max_mps", 0.5, 1.0),
    ("wz_max_radps", 2.0, 4.0),
    ("accel_mps2", 4.0, 8.0),
    ("alpha_radps2", 10.0, 20.0),
]


@pytest.mark.parametrize(("key", "walking", "documented"), FASTEST)
def test_above_walking_speed_is_refused_without_the_opt_in_and_the_key_is_named(
    tmp_path: Path, key: str, walking: float, documented: float
) -> None:
    assert getattr(load_robot_config(robot_file(tmp_path, {key: walking})).limits, key) == walking
    above = math.nextafter(walking, 2 * walking)
    with pytest.raises(ConfigError) as error:
        load_robot_config(robot_file(tmp_path, {key: above}))
    text = str(error.value)
    assert f"limits.{key}: expected {walking:g} at most" in text and f"found {above}" in text
    assert "safety.above_walking_speed = true" in text and "\n" not in text


@pytest.mark.parametrize(("key", "walking", "documented"), FASTEST)
def test_with_the_opt_in_the_robots_own_range_is_accepted_and_no_more(
    tmp_path: Path, key: str, walking: float, documented: float
) -> None:
    config = load_robot_config(robot_file(tmp_path, {key: documented}, above_walking_speed=True))
    assert getattr(config.limits, key) == documented
    above = math.nextafter(documented, 2 * documented)
    with pytest.raises(ConfigError, match=rf"limits\.{key}: expected .*, found {re.escape(str(above))}"):
        load_robot_config(robot_file(tmp_path, {key: above}, above_walking_speed=True))


@pytest.mark.parametrize("value", [2.9, 5.0])
def test_a_speed_that_resembles_kilometres_an_hour_is_refused_with_a_hint(tmp_path: Path, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"if it is in km/h, write {value / 3.6:.2f}"):
        load_robot_config(robot_file(tmp_path, {"vx_max_mps": value}))


def test_the_shipped_files_stay_at_walking_speed_without_the_opt_in() -> None:
    assert not any(load_robot_config(path).safety.above_walking_speed for path in (GO2_SIM, GO2))


def test_a_socket_path_the_system_cannot_bind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the system allows 107"):
        load_robot_config(GO2_SIM, socket=tmp_path / ("x" * 120))


SOURCES = (
    "http://127.0.0.1:8080/stream.mjpg",
    "http://[::1]:8080/stream?topic=/front&quality=80",
    "http://camera.local",
    "v4l2:/dev/video0",
    "v4l2:/dev/v4l/by-id/usb-Maker_Camera-video-index0",
    "gstreamer:nvarguscamerasrc ! nvvidconv ! video/x-raw, format=BGRx ! videoconvert ! appsink drop=true",
    "ros2:/front/image/compressed",
    "ros2raw:/image",
)


@pytest.mark.parametrize("source", ["robot", *SOURCES])
def test_a_camera_source_of_a_known_form_is_accepted(source: str) -> None:
    assert CameraConfig(10.0, 50.0, 500, source).source == source


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("rtsp://camera/1", "expected robot, http://HOST:PORT/PATH"),
        ("", "expected robot, http://HOST:PORT/PATH"),
        ("robot:1", "expected robot, http://HOST:PORT/PATH"),
        ("http://", "expected http://HOST:PORT/PATH"),
        ("http://host:0/", "expected http://HOST:PORT/PATH"),
        ("http://host:65536/", "expected http://HOST:PORT/PATH"),
        ("http://user:secret@host/", "expected http://HOST:PORT/PATH"),
        ("http://host/a b", "expected http://HOST:PORT/PATH"),
        ("http://host/a\r\nX: 1", "expected http://HOST:PORT/PATH"),
        ("http://host/#part", "expected http://HOST:PORT/PATH"),
        ("v4l2:0", "expected v4l2:/dev/videoN"),
        ("v4l2:/dev/video0 ", "expected v4l2:/dev/videoN"),
        ("v4l2:/dev/../etc/passwd", "expected v4l2:/dev/videoN"),
        ("gstreamer:v4l2src ! fakesink", "expected gstreamer:PIPELINE that ends in an appsink"),
        ("gstreamer:appsink", "expected gstreamer:PIPELINE that ends in an appsink"),
        ("ros2:image", "expected ros2:/TOPIC"),
        ("ros2:/image/", "expected ros2:/TOPIC"),
        ("ros2raw:/1image", "expected ros2raw:/TOPIC"),
    ],
)
def test_another_camera_source_is_refused_with_the_form_that_was_expected(source: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"camera.source: {expected}")) as raised:
        CameraConfig(10.0, 50.0, 500, source)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("protocol", "source", "complaint"),
    [
        ("unitree", "robot", ""),
        ("unitree", "v4l2:/dev/video0", ""),
        ("unitree", "ros2:/image", "camera.source: ros2 needs protocol ros2, found protocol unitree"),
        ("can", "robot", "camera.source: protocol can carries no pictures; expected http://"),
        ("mavlink", "http://127.0.0.1:8080/s", ""),
        ("mavlink", "ros2raw:/image", "camera.source: ros2raw needs protocol ros2, found protocol mavlink"),
        ("ros2", "robot", "camera.source: protocol ros2 carries no pictures; expected http://"),
        ("ros2", "ros2:/image", ""),
    ],
)
def test_a_protocol_permits_the_sources_that_it_can_have(protocol: str, source: str, complaint: str) -> None:
    camera = CameraConfig(10.0, 50.0, 500, source)
    if complaint:
        with pytest.raises(ConfigError, match=re.escape(complaint)):
            camera.check_protocol(protocol)
    else:
        camera.check_protocol(protocol)
