"""The autopilot's own failsafes: read at every arming, and a weak one refuses it with the parameter's name."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.mavlink.failsafes import FailsafeCheck, expectations
from tests.support.robot.rover_bench import ROBOTS, RoverBench, robot_file

REAL, INT32 = 9, 6
S = 1_000_000_000
PX4 = robot_file().mavlink
ARDUPILOT = robot_file(ROBOTS / "rover_ardupilot.toml", link="udp:127.0.0.1:14580").mavlink
GOOD = {
    "px4": {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5, "COM_DL_LOSS_T": 3.5},
    "ardupilot": {
        "FS_GCS_ENABLE": 1, "FS_ACTION": 2, "FS_TIMEOUT": 1.5, "FS_GCS_TIMEOUT": 5.0, "SYSID_MYGCS": 254,
    },
}  # fmt: skip
WEAK = {
    "px4": {"COM_OF_LOSS_T": 1.5, "COM_OBL_RC_ACT": 0, "COM_DL_LOSS_T": 20.0},
    "ardupilot": {
        "FS_GCS_ENABLE": 0, "FS_ACTION": 0, "FS_TIMEOUT": 30.0, "FS_GCS_TIMEOUT": 60.0, "SYSID_MYGCS": 255,
    },
}  # fmt: skip
EACH = [(name, parameter) for name, values in WEAK.items() for parameter in values]


def give(check: FailsafeCheck, autopilot: str, name: str, value: float) -> None:
    """PARAM_VALUE as this autopilot encodes it: PX4 puts an integer's bytes into the float."""
    integer = isinstance(value, int)
    wire = struct.unpack("<f", struct.pack("<i", int(value)))[0] if integer and autopilot == "px4" else float(value)
    check.value(name, wire, INT32 if integer else REAL)


def asked(autopilot: str) -> FailsafeCheck:
    config = PX4 if autopilot == "px4" else ARDUPILOT
    assert config is not None
    check = FailsafeCheck(config)
    check.begin()
    return check


@pytest.mark.parametrize("autopilot", list(GOOD))
def test_good_values_complete_the_check(autopilot: str) -> None:
    check = asked(autopilot)
    for name, value in GOOD[autopilot].items():
        assert not check.is_complete
        give(check, autopilot, name, value)
    assert check.is_complete and check.unsafe is None


@pytest.mark.parametrize(("autopilot", "weak"), EACH)
def test_a_weak_value_is_named_with_its_correction(autopilot: str, weak: str) -> None:
    check = asked(autopilot)
    for name, value in (GOOD[autopilot] | {weak: WEAK[autopilot][weak]}).items():
        give(check, autopilot, name, value)
    assert check.unsafe is not None and check.unsafe.startswith(f"{weak} is ") and f"param set {weak} " in check.unsafe


@pytest.mark.parametrize(("autopilot", "weak"), EACH)
def test_a_corrected_value_ends_the_complaint(autopilot: str, weak: str) -> None:
    check = asked(autopilot)
    give(check, autopilot, weak, WEAK[autopilot][weak])
    give(check, autopilot, weak, GOOD[autopilot][weak])
    assert check.unsafe is None


@given(value=st.floats(width=32), integer=st.sampled_from(range(0, 11)), name=st.sampled_from(sorted(GOOD["px4"])))
def test_no_value_passes_that_is_not_within_the_bound(value: float, integer: int, name: str) -> None:
    check = asked("px4")
    check.value(name, value, REAL)
    assert PX4 is not None
    (expected,) = [each for each in expectations(PX4) if name in each.names]
    good = value in expected.values if expected.values else 0 <= value <= expected.most
    assert (check.unsafe is None) is good


def test_each_missing_parameter_is_requested_again_until_it_is_answered() -> None:
    check, now_ns = asked("px4"), 10 * S
    for name, value in GOOD["px4"].items():
        assert name in check.due(now_ns)
        assert check.due(now_ns) == []
        give(check, "px4", name, value)
        now_ns += S
    assert check.due(now_ns) == [] and check.missing == ""


def test_a_weak_parameter_is_read_again_without_a_new_arming() -> None:
    check = asked("px4")
    for name, value in (GOOD["px4"] | {"COM_OF_LOSS_T": 1.5}).items():
        give(check, "px4", name, value)
    assert "COM_OF_LOSS_T" in check.due(20 * S)


def test_both_names_of_a_renamed_parameter_are_tried() -> None:
    check = asked("ardupilot")
    requested = {name for second in range(4) for name in check.due(second * S + S)}
    assert {"SYSID_MYGCS", "MAV_GCS_SYSID"} <= requested
    give(check, "ardupilot", "MAV_GCS_SYSID", 254)
    assert "SYSID_MYGCS" not in check.missing


def test_the_bridge_refuses_a_rover_with_a_weak_failsafe_by_its_name() -> None:
    bench = RoverBench()
    bench.node.parameters._values["COM_OBL_RC_ACT"] = 0.0
    bench.speed = (0.5, 0.0)
    bench.until(lambda: bench.status is not None and bench.status.cause == "unsafe_robot", 3.0, "a refusal")
    assert bench.status is not None and "COM_OBL_RC_ACT" in bench.status.reason and not bench.node.vehicle.armed


def test_a_failsafe_that_is_weakened_while_driving_stops_the_rover() -> None:
    bench = RoverBench()
    bench.drive()
    bench.arrive(bench.pack(bench.node.parameters.message("COM_OF_LOSS_T")))
    assert bench.step().state == "armed"
    bench.node.parameters._values["COM_OF_LOSS_T"] = 4.0
    bench.arrive(bench.pack(bench.node.parameters.message("COM_OF_LOSS_T")))
    status = bench.step()
    assert status.state == "stopped" and "COM_OF_LOSS_T" in status.reason and status.last_command == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_a_rover_that_never_answers_for_its_parameters_is_not_armed() -> None:
    bench = RoverBench()
    bench.to_bridge = lambda packet: () if packet[7:10] == b"\x16\x00\x00" else (packet,)  # 22: PARAM_VALUE
    bench.speed = (0.5, 0.0)
    bench.run(17.0)
    assert not bench.node.vehicle.armed and any("does not answer for its parameters" in line for line in bench.lines)
