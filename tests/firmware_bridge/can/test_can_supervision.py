"""What the bridge makes of a bad CAN bus and a bad base: the bridge's rules, the link and a base on one fake clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import can
import pytest

from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_CONTROLLER, ERROR_RESTARTED
from firmware_bridge.core.link import Arm
from firmware_bridge.core.step_types import Inputs
from tests.support.robot.backend_contract import BridgeBench
from tests.support.robot.dbc_base import CARTER, EXAMPLE, MS, CanRig, virtual

Frames = list[tuple[int, bytes]]
Opener = Callable[..., tuple[CanRig, BridgeBench]]


@pytest.fixture
def opened() -> Iterator[Opener]:
    rigs: list[CanRig] = []

    def open_rig(
        path: Path = CARTER, accepted: tuple[int, ...] = (0,), **changes: object
    ) -> tuple[CanRig, BridgeBench]:
        config = virtual(path, **changes)
        safety = replace(config.safety, accepted_error_codes=accepted)
        rigs.append(CanRig(config=replace(config, safety=safety)))
        return rigs[-1], BridgeBench(rigs[-1])

    yield open_rig
    for rig in rigs:
        rig.close()


def stopped_by(bench: BridgeBench, cause: str, seconds: float) -> float:
    """Step until the bridge stops for that cause; return after how many seconds."""
    begin_ns = bench.rig.now_ns()
    status = bench.until(lambda status: status.state == "stopped", seconds, cause)
    assert status.cause == cause, status
    return (bench.rig.now_ns() - begin_ns) / 1e9


def changed(name: str, rig: CanRig, change: Callable[[bytes], Frames | None]) -> Callable[[int, bytes], Frames]:
    """A bus that changes the frames of one message; `change` returns their replacement."""
    identifier = rig.base.file.get_message_by_name(name).frame_id

    def on_bus(found: int, data: bytes) -> Frames:
        return (change(data) or []) if found == identifier else [(found, data)]

    return on_bus


def test_five_wrong_crcs_in_a_row_stop_the_robot_within_100_ms(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.on_bus = changed("OdometryMotion", rig, lambda data: [(545, bytes((data[0] ^ 1, *data[1:])))])
    assert stopped_by(bench, "unsafe_robot", 1.0) <= 0.14
    assert "5 invalid frames of OdometryMotion in a row (wrong crc)" in bench.core.status(rig.now_ns()).reason


@pytest.mark.parametrize("path", [CARTER, EXAMPLE])
def test_a_bus_that_corrupted_every_frame_for_a_second_can_be_used_again(opened: Opener, path: Path) -> None:
    rig, bench = opened(path)
    bench.drive()
    rig.on_bus = lambda identifier, data: [(identifier, bytes(byte ^ 0xFF for byte in data))]
    stopped_by(bench, "unsafe_robot", 1.0)
    bench.run(1.0)
    rig.on_bus = lambda identifier, data: [(identifier, data)]
    bench.asking = True
    bench.until(lambda status: status.state == "armed", 3.0, "armed after recovery")


def test_every_third_frame_with_a_wrong_crc_does_not_stop_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()

    def every_third(identifier: int, data: bytes) -> Frames:
        wrong = (data[1] & 0x0F) % 3 == 0
        return [(identifier, bytes((data[0] ^ wrong, *data[1:])))]

    rig.on_bus = every_third
    assert bench.run(3.0).state == "armed"
    assert rig.link.dropped()[0] > 100


def test_a_repeated_counter_stops_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    first: list[bytes] = []
    rig.on_bus = changed("OdometryMotion", rig, lambda data: [(545, first[0] if first else first.append(data) or data)])
    stopped_by(bench, "unsafe_robot", 1.0)
    assert "(repeated)" in bench.core.status(rig.now_ns()).reason


def test_frames_that_a_duplicating_bus_repeats_are_counted_and_harmless(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.on_bus = lambda identifier, data: [(identifier, data)] * 2
    assert bench.run(2.0).state == "armed"
    assert rig.link.dropped()[1] > 100


def test_30_percent_lost_frames_do_not_stop_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    count = iter(range(10_000))
    rig.on_bus = lambda identifier, data: [] if next(count) % 10 < 3 else [(identifier, data)]
    assert bench.run(3.0).state == "armed"


CARTER_INPUTS = ("EstopState", "OdometryPosition", "OdometryMotion", "ImuGyro", "Battery", "Faults", "BaseHeartbeat")
EXAMPLE_INPUTS = ("WheelSpeed", "DriveStatus", "Gyro", "Supply")


@pytest.mark.parametrize(
    ("path", "name"), [(CARTER, name) for name in CARTER_INPUTS] + [(EXAMPLE, name) for name in EXAMPLE_INPUTS]
)
def test_every_message_in_use_that_stays_away_stops_it_in_ten_cycles(opened: Opener, path: Path, name: str) -> None:
    rig, bench = opened(path)
    bench.drive()
    rig.base.left_out = {name}
    cycles_s = 10 * rig.base.file.get_message_by_name(name).cycle_time / 1000
    assert bench.until(lambda status: status.state == "stopped", 12.0, "a stop").cause in (
        "unsafe_robot",
        "state_silent",
    )
    assert bench.reports[-1].unsafe is None or name in bench.reports[-1].unsafe
    bench.asking = True
    assert bench.run(max(cycles_s, 1.5)).state != "armed"


@pytest.mark.parametrize(
    ("identifier", "controller", "name"),
    [
        (ERROR_BUS_OFF, 0, "bus-off"),
        (ERROR_CONTROLLER, 0x10, "error-passive"),
        (ERROR_CONTROLLER, 0x20, "error-passive"),
    ],
)
def test_an_error_frame_of_a_controller_in_trouble_stops_it_in_the_next_step(
    opened: Opener, identifier: int, controller: int, name: str
) -> None:
    rig, bench = opened()
    bench.drive()
    rig.send(identifier, bytes((0, controller, 0, 0, 0, 0, 0, 0)), error=True)
    assert stopped_by(bench, "link_down", 0.1) <= 0.04
    assert f"CAN controller is {name}: check wiring, termination and bit rate" in rig.lines
    bench.asking = True
    assert bench.run(2.0).state != "armed"  # the frames that arrive prove nothing
    rig.send(ERROR_RESTARTED if name == "bus-off" else ERROR_CONTROLLER, bytes((0, 0x40, 0, 0, 0, 0, 0, 0)), error=True)
    bench.until(lambda status: status.state == "armed", 3.0, "armed after recovery")


def test_a_warning_of_the_controller_does_not_stop_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.send(ERROR_CONTROLLER, bytes((0, 0x08, 0, 0, 0, 0, 0, 0)), error=True)
    assert bench.run(0.5).state == "armed"


def test_a_babbling_node_is_named_to_the_operator(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    for _ in range(110):
        for _ in range(80):  # 4000 a second: the whole bus
            rig.send(0x000, bytes(8))
        bench.step()
    found = [line for line in rig.lines if "CAN bus load" in line]
    assert found and "commands may be late; most unknown frames have identifier 0x0 (" in found[0]


def test_a_babbling_node_that_lets_nothing_else_pass_stops_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.reporting = False
    rig.refuse()
    assert stopped_by(bench, "link_down", 1.0) <= 0.1


def test_a_second_controller_on_the_bus_stops_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.send(272, bytes(6))
    stopped_by(bench, "second_commander", 0.1)
    assert "VelocityCommand from another controller" in bench.core.status(rig.now_ns()).reason


def test_an_emergency_stop_by_another_node_latches(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    message = rig.base.file.get_message_by_name("EstopControl")
    values = {"Crc": 0, "Counter": 9, "Request": 1}
    crc = rig.base._crc(message, bytes(message.encode(values)))
    rig.send(message.frame_id, bytes(message.encode(values | {"Crc": crc})))
    stopped_by(bench, "estop", 0.1)
    bench.asking = True
    assert bench.run(3.0).state == "stopped"


@pytest.mark.parametrize("place", ["can.estop.button", "can.estop.latched"])
def test_the_bases_own_emergency_stop_latches_until_an_operator_arms(opened: Opener, place: str) -> None:
    rig, bench = opened()
    bench.drive()
    rig.base.places = {place: 1}
    assert stopped_by(bench, "estop", 1.0) <= 0.24
    rig.base.places = {}
    bench.asking = True
    assert bench.run(4.0).state == "stopped"
    arm = Inputs((Arm(),), True, rig.link.read(rig.now_ns()), operator=(Arm(),))
    for request in bench.core.step(arm, rig.now_ns()).requests:
        rig.link.write(request)
    bench.until(lambda status: status.state == "armed", 5.0, "armed after an operator's permission")


def test_a_permitted_arming_resets_the_emergency_stop_of_the_base_and_no_other_does(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.base.state = 2
    stopped_by(bench, "estop", 1.0)
    bench.asking = True
    assert bench.run(3.0).state == "stopped" and rig.base.state == 2
    for request in bench.core.step(Inputs((Arm(),), True, operator=(Arm(),)), rig.now_ns()).requests:
        rig.link.write(request)
    bench.until(lambda status: status.state == "armed", 5.0, "armed")
    assert rig.base.state == 1


@pytest.mark.parametrize(("index", "code"), [(0, 101), (1, 102), (2, 103), (3, 104)])
def test_a_fault_bit_of_the_base_stops_it_with_its_number(opened: Opener, index: int, code: int) -> None:
    rig, bench = opened()
    bench.drive()
    rig.base.places = {f"can.faults[{index}]": 1}
    assert stopped_by(bench, "robot_error", 1.0) <= 0.16
    assert bench.core.status(rig.now_ns()).reason == f"the robot reports error {code}"


@pytest.mark.parametrize(("index", "code"), [(1, 102), (3, 104)])
def test_an_accepted_fault_hides_no_other_one(opened: Opener, index: int, code: int) -> None:
    rig, bench = opened(accepted=(0, 101))
    rig.base.places = {"can.faults[0]": 1}
    bench.drive()
    rig.base.places = {"can.faults[0]": 1, f"can.faults[{index}]": 1}
    assert stopped_by(bench, "robot_error", 1.0) <= 0.16
    assert bench.core.status(rig.now_ns()).reason == f"the robot reports error {code}"


def test_an_accepted_fault_does_not_hide_wheels_that_slip(opened: Opener) -> None:
    rig, bench = opened(accepted=(0, 101))
    rig.base.places = {"can.faults[0]": 1}
    bench.drive(0.2, 0.8)
    rig.base.turns = 0.1
    assert stopped_by(bench, "robot_error", 3.0) <= 1.1


def test_an_encoder_that_reports_nothing_is_an_error_of_the_gyroscope_check(opened: Opener) -> None:
    rig, bench = opened(EXAMPLE)
    bench.drive(0.5)
    rig.base.wheels = (1.0, 0.0)
    assert stopped_by(bench, "robot_error", 2.0) <= 0.6
    assert bench.core.status(rig.now_ns()).reason == "the robot reports error 2"


def test_wheels_that_slip_while_turning_are_an_error(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive(0.2, 0.8)
    rig.base.turns = 0.1
    assert stopped_by(bench, "robot_error", 3.0) <= 1.1


def test_a_base_that_does_not_follow_is_an_error(opened: Opener) -> None:
    rig, bench = opened()
    bench.until(lambda status: status.state == "armed", 5.0, "armed")
    rig.base.obeys, bench.asking, bench.speed = False, False, (0.6, 0.0)
    stopped_by(bench, "robot_error", 3.5)
    assert bench.core.status(rig.now_ns()).reason == "the robot reports error 1"


def test_a_base_that_drives_on_after_a_stop_gets_its_emergency_stop(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive(0.3)
    rig.base.obeys, bench.speed = False, None
    bench.until(lambda _: rig.base.state == 2, 4.0, "an emergency stop at the base")


def test_wheel_speeds_become_the_pose_of_the_base(opened: Opener) -> None:
    rig, bench = opened(EXAMPLE)
    for velocity in ((0.5, 0.3), (0.2, -0.8), (-0.2, 0.4)):
        bench.speed = velocity
        bench.run(2.0)
    state = next(report.state for report in reversed(bench.reports) if report.state)
    assert state.T_odom_base[:2] == pytest.approx(rig.base.pose[:2], abs=0.02)


def test_no_report_is_dropped_when_the_bridge_joins_a_base_that_runs_for_long(opened: Opener) -> None:
    rig, bench = opened(state=None, mode=None, estop=None)  # its clock comes later than its first odometry
    bench.run(1.5)
    assert rig.link.dropped()[1] == 0
    first = next(report.state for report in bench.reports if report.state)
    assert first.robot_stamp_ns > 100_000_000_000  # the base's own clock


def test_a_restarted_base_stops_it(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    rig.base._start_ns = rig.now_ns() + 90_000 * MS  # its clock starts over
    assert stopped_by(bench, "state_silent", 2.0) <= 0.6


def test_frames_of_another_format_with_an_identifier_of_the_base_are_not_read(opened: Opener) -> None:
    rig, bench = opened()
    bench.drive()
    data = rig.base.encode("EstopState", rig.now_ns(), Button=1)
    for kind in ({"is_fd": True, "is_extended_id": False}, {"is_extended_id": True}):
        rig.bus.send(can.Message(arbitration_id=32, data=data, **kind))
    assert bench.run(0.1).state == "armed"


def test_frames_refused_long_ago_do_not_forbid_arming(opened: Opener) -> None:
    rig, bench = opened(heartbeat="")
    assert rig.link._bus is not None
    send = rig.link._bus._bus.send
    rig.refuse()
    bench.until(lambda status: status.cause == "link_down", 3.0, "a refused arming")
    rig.link._bus._bus.send = send  # type: ignore[method-assign]
    bench.until(lambda status: status.state == "armed", 5.0, "armed")


@pytest.mark.parametrize(("pauses_ms", "expected"), [([100] * 19, 1), ([100] * 9 + [1100] + [100] * 9, 0)])
def test_only_a_base_that_disobeys_one_stop_after_the_other_gets_its_own_emergency_stop(
    opened: Opener, monkeypatch: pytest.MonkeyPatch, pauses_ms: list[int], expected: int
) -> None:
    rig, _ = opened()
    requested: list[float] = []
    monkeypatch.setattr(rig.link, "_request_estop", requested.append)
    for pause_ms in (0, *pauses_ms):
        rig.link._now_ns += pause_ms * MS
        rig.link._stop()
    assert len(requested) == expected
