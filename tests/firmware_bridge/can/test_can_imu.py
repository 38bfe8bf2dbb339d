"""A tilt or yaw rate that the base cannot tell is not level and not straight: decoder and DBC file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_bridge.can.database import CanDatabase, load_database
from firmware_bridge.can.frame import Frame
from firmware_bridge.can.reader import BaseReader
from firmware_bridge.core.config import load_robot_config
from firmware_bridge.core.config_can import CanConfig
from firmware_bridge.core.sections import ConfigError
from firmware_bridge.core.step_types import Report
from tests.support.robot.dbc_base import EXAMPLE, MS

RANGE = "[-90|90]"
TILT = f"""BO_ 436 Tilt: 4 Drive
 SG_ Roll : 7|16@0- (0.01,0) {RANGE} "deg" Computer
 SG_ Alive : 19|4@0+ (1,0) [0|14] "" Computer
 SG_ Checksum : 31|8@0+ (1,0) [0|255] "" Computer

"""
CYCLE = 'BA_ "GenMsgCycleTime" BO_ 434 10;'


def base_with_tilt(folder: Path, range_: str = RANGE) -> tuple[CanConfig, CanDatabase]:
    """The example base with a message of its roll."""
    dbc = folder / "example_base.dbc"
    text = EXAMPLE.with_name(dbc.name).read_text().replace("BO_ 435 Supply", f"{TILT}BO_ 435 Supply")
    dbc.write_text(text.replace(CYCLE, f"{CYCLE}\n{CYCLE.replace('434', '436')}").replace(RANGE, range_))
    robot = folder / EXAMPLE.name
    robot.write_text(EXAMPLE.read_text().replace('wz = "Gyro.YawRate"', 'wz = "Gyro.YawRate"\nroll = "Tilt.Roll"'))
    config = load_robot_config(robot)
    assert config.can is not None
    return config.can, load_database(config)


def reports(
    can: CanConfig, database: CanDatabase, rolls_deg: Iterable[float | None], cycle_ns: int = 10 * MS
) -> list[Report]:
    """Reports of a standing base, one each `cycle_ns`, with these rolls; None: no message of it."""
    messages = {message.name: message for message in database.received.values()}
    reader, found = BaseReader(can, database, 0, (0,)), []
    for cycle, roll_deg in enumerate(rolls_deg):
        now_ns = cycle * cycle_ns
        sent = {"WheelSpeed": bytes(4), "Gyro": bytes(2), "DriveStatus": bytes((0x40, 0, 3, 0))}
        if roll_deg is not None:
            sent["Tilt"] = round(roll_deg * 100).to_bytes(2, "big", signed=True)
        for name, values in sent.items():
            message = messages.get(name)
            if message is None:  # not in use
                continue
            assert message.protection is not None
            data = values + bytes(message.length - len(values))
            frame = Frame(message.identifier, message.protection.protect(message.identifier, data, cycle % 15))
            reader.put(frame, now_ns)
        found.append(reader.take(now_ns))
    return found


def test_a_roll_reaches_the_state(tmp_path: Path) -> None:
    last = reports(*base_with_tilt(tmp_path), [40.0] * 20)[-1]
    assert last.state is not None and last.state.roll_rad == pytest.approx(0.698, abs=1e-3)
    assert last.unsafe is None


@pytest.mark.parametrize("roll_deg", [95.0, -327.68], ids=["beyond the range", "the sensor's code for invalid"])
def test_a_roll_outside_its_range_is_unsafe_and_not_level(tmp_path: Path, roll_deg: float) -> None:
    last = reports(*base_with_tilt(tmp_path), [0.0] * 20 + [roll_deg] * 2)[-1]
    assert last.unsafe == "can.imu.roll is outside its range in the DBC file"


def test_a_roll_that_comes_back_into_its_range_is_safe_again(tmp_path: Path) -> None:
    assert reports(*base_with_tilt(tmp_path), [95.0] * 20 + [0.0] * 2)[-1].unsafe is None


def test_there_is_no_state_before_the_first_roll(tmp_path: Path) -> None:
    found = reports(*base_with_tilt(tmp_path), [None] * 10 + [0.0] * 10)
    assert all(report.state is None for report in found[:11]) and found[-1].state is not None


def test_a_roll_whose_range_ends_below_the_bridges_own_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"can.imu.roll: Tilt.Roll: expected a range of more than ±30°, found ±20°"):
        base_with_tilt(tmp_path, "[-20|20]")


def test_a_base_without_an_imu_needs_none(tmp_path: Path) -> None:
    config = load_robot_config(EXAMPLE)
    assert config.can is not None
    can = replace(config.can, imu=None)
    last = reports(can, load_database(replace(config, can=can)), [None] * 20)[-1]
    assert last.state is not None and last.unsafe is None
    assert last.state.gyro_wz_radps is None, "wheels are no gyroscope"


@pytest.mark.parametrize("share", [0.982, 1.018])
def test_a_base_whose_cycle_is_not_quite_that_of_the_dbc_file_is_neither_early_nor_late(share: float) -> None:
    """For 20 s: a count of the file's cycle would be 0.36 s off at the end."""
    config, cycle_ns = load_robot_config(EXAMPLE), round(share * 10 * MS)
    assert config.can is not None
    can = replace(config.can, imu=None)
    found = reports(can, load_database(replace(config, can=can)), [None] * 2000, cycle_ns)
    ages_ns = [
        cycle * cycle_ns - report.state.robot_stamp_ns for cycle, report in enumerate(found) if report.state is not None
    ]
    assert len(ages_ns) > 1900 and max(ages_ns) - min(ages_ns) < 50 * MS
