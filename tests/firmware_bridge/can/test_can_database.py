"""A robot file and a DBC file that do not fit each other are refused in one line that names the place."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_bridge.can.database import load_database
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.sections import ConfigError
from tests.support.robot.dbc_base import CARTER, EXAMPLE


def carter(table: str = "", **changes: object) -> RobotConfig:
    """The Carter's robot file with other values in [can], or in one of its tables."""
    config = load_robot_config(CARTER)
    assert config.can is not None
    given = {table: replace(getattr(config.can, table), **changes)} if table else changes
    return replace(config, can=replace(config.can, **given))


@pytest.mark.parametrize("path", [CARTER, EXAMPLE])
def test_the_shipped_files_fit_and_leave_room_on_the_bus(path: Path) -> None:
    database = load_database(load_robot_config(path))
    assert 0.01 < database.load < 0.7
    assert set(database.sent).isdisjoint(message.name for message in database.received.values())


REFUSED: list[tuple[str, dict[str, object], str]] = [
    ("", {"node": "Robot"}, "can.node: expected a node of carter.dbc (Controller, Base), found 'Robot'"),
    ("", {"dbc": Path("no_such.dbc")}, "expected a DBC file, found: "),
    ("", {"heartbeat": "Heartbeat"}, "can.heartbeat: expected a message of carter.dbc, found 'Heartbeat'"),
    ("", {"faults": ("Faults.Fire",)}, "can.faults[0]: expected a signal of Faults (Crc, Counter, "),
    ("", {"uptime": "Faults.CrcErrors"}, "can.uptime: Faults.CrcErrors: expected a unit of s, ms, found"),
    ("", {"heartbeat": "BaseHeartbeat"}, "can.heartbeat: BaseHeartbeat: expected Controller as its sender, found Base"),
    ("", {"bitrate_bps": 50_000}, "can.max_load: expected cyclic messages of at most 70% of 50000 bit/s, found "),
    ("", {"constants": ("VelocityCommand.Vx=x",)}, 'can.constants: expected "MESSAGE.SIGNAL=NUMBER"'),
    ("", {"constants": ("VelocityCommand.Vx=--2",)}, 'can.constants: expected "MESSAGE.SIGNAL=NUMBER"'),
    ("", {"constants": ("VelocityCommand.Vx=" + "9" * 400,)}, 'can.constants: expected "MESSAGE.SIGNAL=NUMBER"'),
    ("", {"constants": ("VelocityCommand.Vx=" + "9" * 20,)}, "VelocityCommand.Vx: expected a value that fits 16 bits"),
    ("", {"heartbeat": "VelocityCommand"}, "can.heartbeat: expected a message other than that of can.command.vx (Vel"),
    ("", {"dbc": Path("/dev/zero")}, "expected a DBC file, found: [Errno 22] is not a regular file"),
    ("", {"constants": ("VelocityCommand.Gear=1",)}, "expected a signal of VelocityCommand, found 'Gear'"),
    ("", {"constants": ("Faults.CrcErrors=1",)}, "can.constants: expected a message that the bridge sends, found "),
    ("command", {"vx": "WheelSpeeds.Left"}, "can.command.vx: WheelSpeeds.Left: expected a unit of m/s, mm/s"),
    ("command", {"wz": "ModeCommand.Request"}, "can.command.wz: ModeCommand.Request: expected a unit of rad/s"),
    ("command", {"vx": "OdometryMotion.Vx"}, "can.command.vx: OdometryMotion: expected Controller as its sender"),
    ("command", {"base_timeout_ms": 40}, "base_timeout_ms: expected more than 40 (one lost command at 50 Hz"),
    ("odometry", {"x": "OdometryPosition.Crc"}, "can.odometry.x: OdometryPosition.Crc: expected a unit of m, mm, cm"),
    ("odometry", {"x": "EstopControl.Request"}, "can.odometry.x: EstopControl"),
    ("state", {"armed": 9}, "can.state.signal: BaseHeartbeat.State: expected values in 0..2, found 9"),
    ("state", {"estop": 9}, "can.state.signal: BaseHeartbeat.State: expected values in 0..2, found 9"),
    ("state", {"estop": -1}, "missing key can.state.estop: can.estop with latched and request needs the state in "),
    ("mode", {"arm": 5}, "can.mode.request: ModeCommand.Request: expected values in 0..1, found 5"),
    ("mode", {"request": "VelocityCommand.Vx"}, "can.mode.request: VelocityCommand.Vx: expected factor 1 and offset 0"),
    ("estop", {"request": "ModeCommand.Request"}, "can.estop.request: expected a message other than that of can.mode"),
    ("estop", {"stop": 7}, "can.estop.request: EstopControl.Request: expected values in 0..2, found 7"),
    ("protection", {"crc": "Checksum"}, "VelocityCommand: expected a signal 'Checksum', found none"),
    ("protection", {"polynomial": 0x1021}, "can.protection.polynomial: expected less than 0x100"),
    ("protection", {"counter_period": 17}, "can.protection.counter_period: "),
    ("protection", {"max_ahead": 9}, "expected 2 * max_ahead (18) to 16, found 16"),
    ("protection", {"covers": ("id_low",)}, 'can.protection.covers: expected "data" and any of'),
]  # fmt: skip


NAMES = [f"{number}-{table}-{next(iter(changes))}" for number, (table, changes, _) in enumerate(REFUSED)]


@pytest.mark.parametrize(("table", "changes", "line"), REFUSED, ids=NAMES)
def test_files_that_do_not_fit_are_refused_in_one_line(table: str, changes: dict[str, object], line: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_database(carter(table, **changes))
    assert line in str(error.value) and "\n" not in str(error.value)


def test_a_heartbeat_in_the_mode_request_is_refused() -> None:
    """Each heartbeat would request mode 0."""
    config = load_robot_config(EXAMPLE)
    assert config.can is not None
    with pytest.raises(ConfigError, match=r"can.heartbeat: .* other than that of can.mode.request \(ModeRequest\)"):
        load_database(replace(config, can=replace(config.can, heartbeat="ModeRequest")))


def test_a_dbc_file_that_is_a_pipe_is_refused_without_waiting_for_a_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "base.dbc")
    with pytest.raises(ConfigError, match=r"expected a DBC file, found: .* is not a regular file"):
        load_database(carter(dbc=tmp_path / "base.dbc"))


def test_a_constant_with_factor_0_is_refused(tmp_path: Path) -> None:
    text = EXAMPLE.with_name("example_base.dbc").read_text(encoding="utf-8")
    (tmp_path / "base.dbc").write_text(text.replace("Gear : 39|8@0+ (1,0)", "Gear : 39|8@0+ (0,0)"), encoding="utf-8")
    config = load_robot_config(EXAMPLE)
    assert config.can is not None
    with pytest.raises(ConfigError, match=r"can.constants: DriveCommand.Gear: expected a value that fits 8 bits"):
        load_database(replace(config, can=replace(config.can, dbc=tmp_path / "base.dbc")))


def test_a_base_without_a_battery_must_say_that_it_is_not_asked() -> None:
    config = load_robot_config(EXAMPLE)
    assert config.can is not None
    without = replace(config.can, battery=None)
    with pytest.raises(
        ConfigError, match=r"missing table \[can.battery\]; without one write safety.battery_min_percent"
    ):
        replace(config, can=without)
    replace(config, can=without, safety=replace(config.safety, battery_min_percent=0))


def test_limits_beyond_the_range_of_the_dbc_file_are_refused() -> None:
    config = load_robot_config(EXAMPLE)
    permitted = replace(config, safety=replace(config.safety, above_walking_speed=True))
    fast = replace(permitted, limits=replace(config.limits, wz_max_radps=3.2))
    with pytest.raises(ConfigError, match=r"DriveCommand.YawRate: expected a range of at least -3.2..3.2 \(limits\)"):
        load_database(fast)


def test_a_signal_of_ours_without_a_value_is_refused() -> None:
    config = load_robot_config(EXAMPLE)
    assert config.can is not None
    with pytest.raises(ConfigError, match=r"DriveCommand.Gear: expected a value, found none; add DriveCommand.Gear=0"):
        load_database(replace(config, can=replace(config.can, constants=())))


TOO_LARGE = "VelocityCommand.Vx: expected a factor, an offset and values below 1e+30"
VX = '(0.001,0) [-32.768|32.767] "m/s" Base'
STATE = """ SG_ State : 12|4@1+ (1,0) [0|2] "" Controller
 SG_ Version : 16|8@1+ (1,0) [0|255] "" Controller
 SG_ Uptime : 24|32@1+ (0.001,0) [0|4294967.295] "s" Controller"""
WIDE_STATE = """ SG_ State : 12|33@1+ (1,0) [0|2] "" Controller
 SG_ Version : 45|3@1+ (1,0) [0|7] "" Controller
 SG_ Uptime : 48|8@1+ (0.001,0) [0|0] "s" Controller"""
DBC_CHANGES = [
    ('"GenMsgCycleTime" BO_ 544 20', '"GenMsgCycleTime" BO_ 544 0', "OdometryPosition: expected a GenMsgCycleTime"),
    ('"GenMsgCycleTime" BO_ 560 10', '"GenMsgCycleTime" BO_ 560 0', "ImuGyro: expected a GenMsgCycleTime"),
    ('"GenMsgCycleTime" BO_ 32 100', '"GenMsgCycleTime" BO_ 32 0', "EstopState: expected a GenMsgCycleTime"),
    ('"GenMsgCycleTime" BO_ 592 100', '"GenMsgCycleTime" BO_ 592 0', "Faults: expected a GenMsgCycleTime"),
    ("BO_ 544 OdometryPosition: 8 Base", "BO_ 2147484192 OdometryPosition: 8 Base", "expected a CAN 2.0A message"),
    ("BO_ 272 VelocityCommand: 6 Controller", "BO_ 272 VelocityCommand: 6 Base", "expected Controller as its sender"),
    (VX, '(0.001,0) [-0.1|0.1] "m/s" Base', "expected a range of at least -0.4"),
    (VX, '(0,0) [0|0] "m/s" Base', "can.command.vx: VelocityCommand.Vx: expected a factor other than 0"),
    (VX, '(0.05,0.02) [-2|2] "m/s" Base', "VelocityCommand.Vx: expected a raw value for exactly 0, found none"),
    (VX, f'({"9" * 400},0) [0|0] "m/s" Base', TOO_LARGE),
    (VX, f'(1,{"9" * 400}) [0|0] "m/s" Base', TOO_LARGE),
    (VX, f'(0.001,0) [{"9" * 400}|{"9" * 401}] "m/s" Base', "expected a range of at least -0.4"),
    ('(0.001,0) [0|4294967.295] "s"', '(2,0) [0|8589934590] "s"', "Uptime: expected a range of at most 4.61169e+09"),
    ('(0.5,0) [0|100] "%"', '(1e7,0) [0|0] "%"', "Battery.Charge: expected a range of at most 1e+06, found 2.555e+09"),
    (STATE, WIDE_STATE, "can.state.signal: BaseHeartbeat.State: expected at most 32 bits, found 33"),
    ('Counter : 8|4@1+ (1,0) [0|15] "" Base', 'Counter : 6|4@1+ (1,0) [0|15] "" Base', "expected a DBC file, found: "),
    ("VERSION", "VERSION VERSION", "expected a DBC file, found: "),
]  # fmt: skip


@pytest.mark.parametrize(("before", "after", "line"), DBC_CHANGES)
def test_a_dbc_file_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, before: str, after: str, line: str
) -> None:
    text = CARTER.with_name("carter.dbc").read_text(encoding="utf-8")
    assert before in text
    path = tmp_path / "changed.dbc"
    path.write_text(text.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_database(carter(dbc=path))
    assert line in str(error.value) and "\n" not in str(error.value)
