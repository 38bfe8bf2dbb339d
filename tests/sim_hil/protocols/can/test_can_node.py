"""The base's CAN node on a fake clock: what arms it, what it obeys, what stops it, what it reports."""

from __future__ import annotations

from dataclasses import replace

import pytest

from edge.core.geometry import SE2
from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_RESTARTED, Frame
from firmware_bridge.can.protection import Verdict
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.frames import Decoder, Encoder, Received
from sim_hil.protocols.can.node import BUS_OFF_RECOVERY_S, CanNode
from sim_hil.robots.carter.sensors import Sensors
from tests.support.robot.fake_base import FakeBase

REST = Sensors(
    T_odom_base=SE2(0.0, 0.0, 0.0), v_mps=0.0, w_radps=0.0, wheel_radps=(0.0, 0.0), wheel_nm=(0.0, 0.0),
    wheel_counts=(0, 0), gyro_radps=(0.0, 0.0, 0.0), accel_mps2=(0.0, 0.0, 9.81), charge_percent=80.0, voltage_v=40.0,
    current_a=3.0, bumpers=(False, False, False, False), overload=False,
)  # fmt: skip
TICK_S = 0.002


class Bench:
    """A node, a controller and a clock of 2 ms."""

    def __init__(self) -> None:
        self.base = FakeBase()
        self.node = CanNode(self.base)
        self.encoder = Encoder()
        self.decoder = Decoder("Base")
        self.tick = 0
        self.sensors = REST
        self.reports: list[Received] = []
        self.sent: list[Frame] = []

    @property
    def now_s(self) -> float:
        return self.tick * TICK_S

    def send(self, name: str, times: int = 1, **signals: float) -> list[Received | None]:
        return [self.node.receive(self.encoder.encode(name, **signals), self.now_s) for _ in range(times)]

    def drive(self, vx: float, wz: float = 0.0, times: int = 1) -> None:
        self.send("VelocityCommand", times, Vx=vx, Wz=wz)

    def run(self, seconds: float, *, alive: bool = True, vx: float | None = None) -> None:
        for _ in range(round(seconds / TICK_S)):
            if alive and self.tick % 50 == 0:
                self.send("ControllerHeartbeat")
            if vx is not None and self.tick % 10 == 0:
                self.drive(vx)
            self.tick += 1
            self.node.step(self.now_s)
            for frame in self.node.due(self.now_s, lambda: self.sensors):
                self.sent.append(frame)
                received = self.decoder.decode(frame)
                assert received is not None
                self.reports.append(received)

    def armed(self) -> Bench:
        self.send("ControllerHeartbeat", 2)
        self.send("ModeCommand", 3, Request=frames.MODE_ARM)
        assert self.node.state == frames.STATE_ARMED
        return self

    def last(self, name: str) -> dict[str, float]:
        return next(dict(received.signals) for received in reversed(self.reports) if received.name == name)

    def stopped_after_s(self, limit_s: float = 2.0) -> float:
        """How long the base goes on obeying its last velocity from now."""
        begin_s = self.now_s
        while self.base.velocity != (0.0, 0.0, 0.0) and self.base.powered:
            assert self.now_s - begin_s < limit_s
            self.run(TICK_S)
        return self.now_s - begin_s


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_it_starts_idle_and_obeys_no_velocity(bench: Bench) -> None:
    bench.run(0.2, vx=0.5)
    assert bench.node.state == frames.STATE_IDLE
    assert bench.base.velocity == (0.0, 0.0, 0.0) and not bench.base.powered


def test_it_is_not_armed_without_the_controllers_heartbeat(bench: Bench) -> None:
    bench.send("ModeCommand", 3, Request=frames.MODE_ARM)
    assert bench.node.state == frames.STATE_IDLE


def test_it_is_not_armed_with_an_empty_battery(bench: Bench) -> None:
    bench.sensors = replace(REST, charge_percent=8.0)
    bench.run(0.2)
    bench.send("ModeCommand", 3, Request=frames.MODE_ARM)
    bench.run(0.1)
    assert bench.node.state == frames.STATE_IDLE
    assert bench.last("Faults")["BatteryLow"] == 1


def test_100_ms_without_a_velocity_stop_it_and_raise_a_fault_bit(bench: Bench) -> None:
    bench.armed()
    bench.run(0.2, vx=0.5)
    bench.drive(0.5)
    assert bench.stopped_after_s() == pytest.approx(0.100, abs=2 * TICK_S)
    bench.run(0.05)
    assert bench.node.state == frames.STATE_ARMED
    assert bench.last("Faults")["CommandTimeout"] == 1


def test_after_a_pause_one_frame_alone_does_not_move_it(bench: Bench) -> None:
    bench.armed()
    bench.run(0.2, vx=0.5)
    bench.run(0.3)
    bench.drive(0.5)
    assert bench.base.velocity == (0.0, 0.0, 0.0)
    bench.drive(0.5)
    assert bench.base.velocity == (0.5, 0.0, 0.0)


def test_frames_with_a_wrong_crc_are_counted_and_stop_it_when_no_others_come(bench: Bench) -> None:
    bench.armed()
    bench.run(0.1, vx=0.5)
    for _ in range(20):
        frame = bench.encoder.encode("VelocityCommand", Vx=1.0, Wz=0.0)
        bench.node.receive(Frame(frame.identifier, frame.data[:-1] + bytes((frame.data[-1] ^ 1,))), bench.now_s)
        bench.run(0.01)
    assert bench.base.velocity == (0.0, 0.0, 0.0)
    assert bench.node.counts.wrong_crc == 20
    bench.run(0.1)
    assert bench.last("Faults")["CrcErrors"] == 20


def test_the_same_frame_over_and_over_does_not_keep_it_moving(bench: Bench) -> None:
    bench.armed()
    bench.run(0.1, vx=0.5)
    frame = bench.encoder.encode("VelocityCommand", Vx=0.5, Wz=0.0)
    for _ in range(20):
        bench.node.receive(frame, bench.now_s)
        bench.run(0.01)
    assert bench.base.velocity == (0.0, 0.0, 0.0)
    # One was new, and one began a stream again after 100 ms of silence: no second new one ever followed it.
    assert bench.node.counts.wrong_counter == 18


def test_half_a_second_without_a_heartbeat_disarms_it(bench: Bench) -> None:
    bench.armed()
    bench.run(0.49, alive=False, vx=0.5)
    assert bench.base.powered
    bench.run(0.03, alive=False, vx=0.5)
    assert not bench.base.powered and bench.node.state == frames.STATE_IDLE
    bench.run(0.5, vx=0.5)
    assert bench.node.state == frames.STATE_IDLE, "a heartbeat that is back does not arm it again"


def test_an_emergency_stop_over_the_bus_is_latched(bench: Bench) -> None:
    bench.armed().drive(0.5, times=2)
    bench.send("EstopControl", 1, Request=frames.ESTOP_STOP)
    assert bench.base.stopped and bench.node.state == frames.STATE_ESTOP
    bench.send("ModeCommand", 3, Request=frames.MODE_ARM)
    bench.run(0.2, vx=0.5)
    assert bench.base.stopped and not bench.base.powered
    assert bench.last("EstopState") == pytest.approx(
        {**bench.last("EstopState"), "Latched": 1, "Button": 0, "Source": frames.SOURCE_BUS}
    )


def test_a_repeated_stop_frame_still_stops(bench: Bench) -> None:
    bench.armed()
    frame = bench.encoder.encode("EstopControl", Request=frames.ESTOP_NONE)
    bench.node.receive(frame, bench.now_s)
    again = Encoder().encode("EstopControl", Request=frames.ESTOP_STOP)
    received = bench.node.receive(again, bench.now_s)
    assert received is not None and received.verdict is Verdict.REPEATED
    assert bench.base.stopped


def test_a_stop_frame_with_a_wrong_crc_does_not_stop(bench: Bench) -> None:
    bench.armed()
    frame = bench.encoder.encode("EstopControl", Request=frames.ESTOP_STOP)
    bench.node.receive(Frame(frame.identifier, bytes((frame.data[0] ^ 0xFF, frame.data[1]))), bench.now_s)
    assert not bench.base.stopped


def test_a_reset_makes_it_idle_and_no_more(bench: Bench) -> None:
    bench.armed()
    bench.send("EstopControl", 3, Request=frames.ESTOP_STOP)
    bench.send("EstopControl", 3, Request=frames.ESTOP_RESET)
    assert bench.node.state == frames.STATE_IDLE
    assert not bench.base.stopped and not bench.base.powered


def test_while_the_button_is_held_a_reset_is_refused(bench: Bench) -> None:
    bench.armed()
    bench.node.button = True
    bench.run(0.02)
    assert bench.base.stopped
    bench.send("EstopControl", 3, Request=frames.ESTOP_RESET)
    assert bench.node.state == frames.STATE_ESTOP
    bench.run(0.1)
    assert (bench.last("EstopState")["Button"], bench.last("EstopState")["Source"]) == (1, frames.SOURCE_BUTTON)
    bench.node.button = False
    bench.send("EstopControl", 3, Request=frames.ESTOP_RESET)
    assert bench.node.state == frames.STATE_IDLE


def test_a_bumper_contact_is_reported_within_10_ms(bench: Bench) -> None:
    bench.run(0.3)
    bench.reports.clear()
    bench.sensors = replace(REST, bumpers=(True, False, False, False))
    bench.run(0.01)
    assert bench.last("Faults")["BumperFront"] == 1


def test_bus_off_disarms_and_silences_it_until_it_has_recovered(bench: Bench) -> None:
    bench.armed()
    bench.run(0.1, vx=0.5)
    bench.node.receive(Frame(ERROR_BUS_OFF, bytes(8), error=True), bench.now_s)
    assert bench.node.bus_off and not bench.base.powered
    sent = len(bench.sent)
    bench.run(BUS_OFF_RECOVERY_S - 2 * TICK_S)
    assert len(bench.sent) == sent
    bench.run(0.1)
    assert not bench.node.bus_off and len(bench.sent) > sent
    assert bench.last("Faults")["BusOffs"] == 1
    bench.run(0.3, vx=0.5)
    assert bench.node.state == frames.STATE_IDLE, "a controller has to arm it again"
    bench.armed()


def test_it_rejoins_the_bus_at_once_after_a_restart_error_frame(bench: Bench) -> None:
    bench.node.receive(Frame(ERROR_BUS_OFF, bytes(8), error=True), bench.now_s)
    bench.node.receive(Frame(ERROR_RESTARTED, bytes(8), error=True), bench.now_s)
    bench.run(TICK_S)
    assert bench.sent


def test_other_error_frames_and_unknown_frames_change_nothing(bench: Bench) -> None:
    bench.armed().drive(0.5, times=2)
    bench.node.receive(Frame(0x004, bytes(8), error=True), bench.now_s)
    bench.node.receive(Frame(0x123, b"hello"), bench.now_s)
    assert bench.base.velocity == (0.5, 0.0, 0.0) and bench.base.powered
    assert (bench.node.counts.error_frames, bench.node.counts.unknown) == (1, 1)


def test_disarming_takes_the_drives_power(bench: Bench) -> None:
    bench.armed()
    bench.send("ModeCommand", 3, Request=frames.MODE_DISARM)
    assert not bench.base.powered and bench.node.state == frames.STATE_IDLE


def test_every_message_is_sent_in_its_cycle_time(bench: Bench) -> None:
    bench.run(2.0)
    for name, period_s in frames.periods_s("Base").items():
        sent = sum(received.name == name for received in bench.reports)
        # The reports of changes come on top: the first heartbeat is one.
        assert sent == pytest.approx(2.0 / period_s, abs=3), name


def test_it_reports_its_sensor_readings(bench: Bench) -> None:
    bench.sensors = Sensors(
        T_odom_base=SE2(1.5, -0.25, 3.5), v_mps=0.5, w_radps=-0.25, wheel_radps=(3.0, -4.0), wheel_nm=(1.25, -2.5),
        wheel_counts=(-1, 70_000), gyro_radps=(0.01, -0.02, 0.3), accel_mps2=(0.5, -0.1, 9.8), charge_percent=62.5,
        voltage_v=37.5, current_a=-1.25, bumpers=(False, True, False, True), overload=True,
    )  # fmt: skip
    bench.run(1.1)
    expected = {
        "OdometryPosition": {"X": 1.5, "Y": -0.25},
        "OdometryMotion": {"Heading": 3.5 - 2 * 3.14159265, "Vx": 0.5, "Wz": -0.25},
        "WheelSpeeds": {"Left": 3.0, "Right": -4.0},
        "WheelTorques": {"Left": 1.25, "Right": -2.5},
        "WheelCounts": {"Left": 2**24 - 1, "Right": 70_000},
        "ImuGyro": {"X": 0.01, "Y": -0.02, "Z": 0.3},
        "ImuAccel": {"X": 0.5, "Y": -0.1, "Z": 9.8},
        "Battery": {"Charge": 62.5, "Voltage": 37.5, "Current": -1.25},
        "Faults": {"BumperRear": 1, "BumperRight": 1, "BumperFront": 0, "DriveOverload": 1},
        "BaseHeartbeat": {"State": 0, "Version": 1, "Uptime": 1.1},
    }
    for name, signals in expected.items():
        found = bench.last(name)
        assert {key: found[key] for key in signals} == pytest.approx(signals, abs=0.002), name


def test_the_two_frames_of_an_odometry_sample_have_the_same_counter(bench: Bench) -> None:
    bench.run(0.5)
    counters = {
        name: [received.signals["Counter"] for received in bench.reports if received.name == name]
        for name in ("OdometryPosition", "OdometryMotion")
    }
    assert counters["OdometryPosition"] == counters["OdometryMotion"]
