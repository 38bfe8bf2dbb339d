"""`edge-doctor` and a robot of another protocol: its link on machines made of files, its reports, its camera."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge.deploy.doctor.check import Check, Level
from edge.deploy.doctor.link import can_interface, dbc_file, robot_links, serial_line, signing_key
from edge.deploy.doctor.rights import UserRights, current_user
from edge.deploy.doctor.robot import bridge, robot_link
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import BatteryState, CameraError, RobotState
from tests.edge.deploy.test_doctor import jpeg
from tests.edge.deploy.test_link_rights import robot as parts_of
from tests.edge.robot.test_reader import robot_with
from tests.support.processes import GO2_SIM

BITRATE_BPS = 500_000
CAN = {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": BITRATE_BPS}}
STRANGER = UserRights("tic-vla-bridge", 4242, frozenset({4242}), other=True)


def machine(root: Path, *, up: bool = True, kind: int = 280) -> Path:
    device = root / "sys/class/net/can0"
    device.mkdir(parents=True)
    (device / "type").write_text(f"{kind}\n")
    (device / "flags").write_text("0x40081\n" if up else "0x40080\n")
    return root


def ip_says(info: dict[str, Any], kind: str = "can") -> Callable[[Sequence[str]], tuple[int, str]]:
    return lambda _words: (0, json.dumps([{"ifname": "can0", "linkinfo": {"info_kind": kind, "info_data": info}}]))


@pytest.mark.parametrize(
    ("change", "level", "text"),
    [
        ({}, Level.OK, "500000 bit/s, ERROR-ACTIVE, restart-ms 100"),
        ({"restart_ms": 0}, Level.WARN, "restart-ms 100"),
        ({"state": "ERROR-PASSIVE"}, Level.WARN, "is the base on"),
        ({"state": "BUS-OFF"}, Level.FAIL, "termination"),
        ({"bittiming": {"bitrate": 250000}}, Level.FAIL, "correct the robot file, or sudo ip link set can0 down"),
        ({"bittiming": {}}, Level.FAIL, "None bit/s"),
        ({"bittiming": {}, "bittiming_bitrate": BITRATE_BPS}, Level.OK, "500000 bit/s"),  # an adapter with fixed ones
        ({"ctrlmode": ["LISTEN-ONLY"]}, Level.FAIL, "a stop neither: sudo ip link set can0 down"),
        ({"ctrlmode": ["LOOPBACK"]}, Level.FAIL, "restart-ms 100 loopback off"),
        ({"ctrlmode": ["BERR-REPORTING"]}, Level.OK, "500000 bit/s"),
    ],
)
def test_a_can_interface_is_judged_by_its_state_and_its_restart(
    tmp_path: Path, change: dict[str, Any], level: Level, text: str
) -> None:
    check = can_interface("can0", BITRATE_BPS, machine(tmp_path), ip_says({**CAN, **change}))
    assert check.level is level and text in check.found + check.advice


def test_a_can_interface_that_is_down_or_absent_names_the_command(tmp_path: Path) -> None:
    absent = can_interface("can0", BITRATE_BPS, tmp_path, ip_says(CAN))
    down = can_interface("can0", BITRATE_BPS, machine(tmp_path, up=False), ip_says(CAN))
    for check in (absent, down):
        assert check.level is Level.FAIL and "sudo ip link set can0 up type can bitrate" in check.advice


def test_another_kind_of_interface_is_refused(tmp_path: Path) -> None:
    assert can_interface("can0", BITRATE_BPS, machine(tmp_path, kind=1), ip_says(CAN)).level is Level.FAIL


def test_a_virtual_can_interface_needs_no_bitrate(tmp_path: Path) -> None:
    assert can_interface("can0", BITRATE_BPS, machine(tmp_path), ip_says({}, "vcan")).level is Level.OK


@pytest.mark.parametrize("answer", [(1, "Cannot find device"), (0, "no json"), (0, "[]"), (0, '[{"linkinfo": 7}]')])
def test_without_an_answer_of_ip_the_bitrate_is_unknown(tmp_path: Path, answer: tuple[int, str]) -> None:
    assert can_interface("can0", BITRATE_BPS, machine(tmp_path), lambda _words: answer).level is Level.WARN


@pytest.mark.parametrize("error", [FileNotFoundError("ip"), subprocess.TimeoutExpired("ip", 60)])
def test_a_machine_without_ip_is_no_crash(tmp_path: Path, error: Exception) -> None:
    def fail(_words: Sequence[str]) -> tuple[int, str]:
        raise error

    assert can_interface("can0", BITRATE_BPS, machine(tmp_path), fail).level is Level.WARN


def test_a_serial_line_must_be_a_device_that_the_user_may_open() -> None:
    # Character devices cannot be made without root: two that every machine has stand for an open and a closed line.
    assert serial_line(Path("/dev/null"), Path("/"), current_user()).level is Level.OK
    closed = serial_line(Path("/dev/mem"), Path("/"), STRANGER) if Path("/dev/mem").exists() else None
    assert closed is None or (closed.level is not Level.OK and "usermod -aG dialout" in closed.advice)


def test_a_missing_line_and_a_plain_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    assert "by-id" in serial_line(Path("/dev/ttyACM0"), tmp_path, current_user()).advice
    (tmp_path / "dev/ttyACM0").write_text("")
    assert "is no device" in serial_line(Path("/dev/ttyACM0"), tmp_path, current_user()).found


@pytest.mark.parametrize(
    ("mode", "level"), [(0o600, Level.OK), (0o400, Level.OK), (0o640, Level.FAIL), (0o604, Level.FAIL)]
)
def test_a_signing_key_must_be_secret(tmp_path: Path, mode: int, level: Level) -> None:
    (tmp_path / "key").write_bytes(bytes(32))
    (tmp_path / "key").chmod(mode)
    assert signing_key(Path("/key"), "10.0.0.1", tmp_path).level is level


def test_a_missing_key_fails_and_an_unsigned_network_is_a_warning(tmp_path: Path) -> None:
    assert signing_key(Path("/key"), "10.0.0.1", tmp_path).level is Level.FAIL
    assert signing_key(None, "10.0.0.1", tmp_path).level is Level.WARN
    assert signing_key(None, "127.0.0.1", tmp_path).level is Level.OK
    assert signing_key(None, "", tmp_path).level is Level.OK


def can_base(interface: str = "socketcan", **changes: Any) -> RobotConfig:
    """The example base, with changes of [can]."""
    base = load_robot_config(GO2_SIM.with_name("example_can.toml"))
    assert base.can is not None
    return replace(base, can=replace(base.can, interface=interface, **changes))


def test_a_dbc_file_that_fits_the_robot_file_shows_its_messages_and_its_load() -> None:
    check = dbc_file(can_base())
    assert check.level is Level.OK and "4 messages received, 3 sent" in check.found and "% of the bus" in check.found


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"dbc": Path("/nowhere/base.dbc")}, "can.dbc: /nowhere/base.dbc: expected a DBC file"),
        ({"node": "Nobody"}, "can.node: expected a node of"),
        ({"heartbeat": "WheelSpeed"}, "can.heartbeat: WheelSpeed: expected Computer as its sender"),
        ({"bitrate_bps": 20_000}, "can.max_load"),
    ],
)
def test_a_dbc_file_that_does_not_fit_is_named_without_a_bus(changes: dict[str, Any], text: str) -> None:
    check = dbc_file(can_base(**changes))
    assert check.level is Level.FAIL and text in check.found and "\n" not in check.found


@pytest.mark.parametrize(
    ("of", "names"),
    [
        (can_base("socketcan"), ["CAN interface", "DBC file"]),
        (can_base("udp_multicast"), ["CAN interface", "DBC file"]),
        (can_base("serial", channel="/dev/ttyUSB0"), ["serial line", "DBC file"]),
        (parts_of(mavlink="serial:/dev/ttyACM0:57600"), ["serial line", "MAVLink signing"]),
        (parts_of(mavlink="udp:10.0.0.1:14550"), ["MAVLink signing"]),
        (load_robot_config(GO2_SIM), ["robot's cable"]),
    ],
    ids=["socketcan", "simulated CAN", "CAN adapter", "serial", "udp", "go2"],
)
def test_every_protocol_has_its_checks(tmp_path: Path, of: Any, names: list[str]) -> None:
    checks = list(robot_links(of, tmp_path, current_user(), ip_says(CAN)))
    assert [check.name for check in checks] == names


def test_a_failsafe_that_is_too_weak_is_explained() -> None:
    status = BridgeStatus(
        1, "disarmed", "FS_ACTION is 0", 0, 0, 0, (0.0, 0.0, 0.0), True, "none", blocked_by="unsafe_robot"
    )
    check = bridge(load_robot_config(GO2_SIM), lambda _robot: status)
    assert check.level is Level.FAIL and "FS_ACTION is 0" in check.found and "correct on the robot" in check.advice


class FakeReader:
    """A robot whose state arrives at a rate while a listener is set."""

    malformed = 0

    def __init__(self, rate_hz: float = 50.0, battery: BatteryState | None = None, *, silent: bool = False) -> None:
        self._rate_hz, self._battery, self._silent = rate_hz, battery, silent
        self._since = 0.0
        self._listener: Callable[[RobotState], None] | None = None
        self.closed = False

    def state(self) -> RobotState | None:
        now_ns = time.monotonic_ns()
        made = RobotState(now_ns, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 1, 0, 0, 0.0, 0.0, 0.0, 0.0, (0, 0, 0, 0))
        return None if self._silent else made

    def battery(self) -> BatteryState | None:
        return self._battery

    def surplus_publishers(self) -> str | None:
        return None

    def set_state_listener(self, listener: Callable[[RobotState], None] | None) -> None:
        if listener is None and self._listener is not None:
            state = self.state()
            assert state is not None
            for _ in range(round((time.monotonic() - self._since) * self._rate_hz)):
                self._listener(state)
        self._listener, self._since = listener, time.monotonic()

    def close(self) -> None:
        self.closed = True


class FakeCamera:
    """A camera with a picture every `period_s`, or an error."""

    captured_ns = None

    def __init__(self, period_s: float = 0.05, error: str = "") -> None:
        self._period_s, self._error = period_s, error
        self.closed = False

    def request_frame(self, timeout_s: float) -> bytes:
        if self._error:
            raise CameraError(self._error)
        time.sleep(self._period_s)
        return jpeg(None)

    def close(self) -> None:
        self.closed = True


def checked(robot: RobotConfig, reader: FakeReader, camera: FakeCamera | None = None) -> dict[str, Check]:
    source = camera or FakeCamera()
    checks = robot_link(robot, 224, opener=lambda _robot: (reader, source), timeout_s=0.0, measure_s=0.25)
    assert reader.closed and source.closed
    return {check.name: check for check in checks}


@pytest.fixture
def robot(tmp_path: Path) -> RobotConfig:
    return robot_with(tmp_path, "http://127.0.0.1:9/s")


@pytest.mark.parametrize(("rate_hz", "level"), [(50.0, Level.OK), (14.0, Level.WARN), (4.0, Level.FAIL)])
def test_a_state_must_arrive_often_enough(robot: RobotConfig, rate_hz: float, level: Level) -> None:
    check = checked(robot, FakeReader(rate_hz))["robot"]
    assert check.level is level and "states a second" in check.found


def test_a_silent_robot_does_not_hide_its_camera(robot: RobotConfig) -> None:
    checks = checked(robot, FakeReader(silent=True))
    assert [check.level for check in checks.values()] == [Level.FAIL, Level.SKIP, Level.OK]
    assert "edge-bridge status" in checks["robot"].advice


@pytest.mark.parametrize(
    ("battery", "least", "level"),
    [
        (BatteryState(1, 80, 24.0, 0.0), 10, Level.OK),
        (BatteryState(1, 9, 24.0, 0.0), 10, Level.FAIL),
        (None, 10, Level.FAIL),
        (None, 0, Level.SKIP),
    ],
)
def test_the_battery_is_judged_as_the_bridge_judges_it(
    robot: RobotConfig, battery: BatteryState | None, least: int, level: Level
) -> None:
    asks = replace(robot, safety=replace(robot.safety, battery_min_percent=least))
    assert checked(asks, FakeReader(battery=battery))["battery"].level is level


@pytest.mark.parametrize(
    ("camera", "level", "text"),
    [
        (FakeCamera(0.05), Level.OK, "pictures a second"),
        (FakeCamera(0.3), Level.WARN, "camera.rate_hz"),
        (FakeCamera(error="camera http://127.0.0.1:9/s: no connection"), Level.FAIL, "no connection"),
    ],
    ids=["fast", "slow", "absent"],
)
def test_a_camera_of_its_own_is_judged_by_its_rate(
    robot: RobotConfig, camera: FakeCamera, level: Level, text: str
) -> None:
    check = checked(robot, FakeReader(), camera)["camera"]
    assert check.level is level and text in check.found + check.advice
