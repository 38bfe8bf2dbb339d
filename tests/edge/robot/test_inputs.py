"""From a robot's reports to the command that leaves the loop: rows 8 to 12 and 35, with the real gate and estimator.

The robot is made up and walks as it is told; the control loop around it is the one of `control_bench`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edge.odometry.camera_geometry import Attitude
from edge.robot import inputs
from edge.robot.inputs import RobotInputs
from edge.safety.faults.table import FAULTS
from edge.state.frame import Frame
from firmware_bridge.core.config import load_robot_config
from firmware_bridge.core.robot_state import CameraError, RobotState
from firmware_bridge.unitree import client
from firmware_bridge.unitree.client import Go2Reader
from sim_hil.protocols.unitree.state import LowStateMessage
from tests.firmware_bridge.unitree.test_unitree_rpc import GO2_SIM
from tests.support.runner.control_bench import MS, PERIOD_NS, Bench

REPORT_NS = 20 * MS
BRIDGE_NS = 20 * MS

Alter = Callable[[RobotState], RobotState | None]


class FakeReader:
    """Hands over what the test says; has no camera."""

    malformed = 0

    def __init__(self, _robot: object, *, on_death: Callable[[str], None] = lambda why: None) -> None:
        self.on_death = on_death
        self.hear: Callable[[RobotState], None] = lambda state: None

    def set_state_listener(self, listener: Callable[[RobotState], None]) -> None:
        self.hear = listener

    def request_frame(self, _timeout_s: float) -> bytes:
        raise CameraError("camera: none")

    def battery(self) -> None:
        return None


class Rig:
    """A robot at 50 Hz, what the runner makes of it, and the loop that drives it at 0.5 m/s."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bench = Bench()
        self.deaths: list[str] = []
        monkeypatch.setattr("firmware_bridge.unitree.client.Go2Reader", FakeReader)
        monkeypatch.setattr(inputs, "time", SimpleNamespace(monotonic_ns=lambda: self.bench.now_ns))
        self.inputs = RobotInputs(
            load_robot_config(GO2_SIM), image_px=32, period_ns=PERIOD_NS, commanded=lambda: self.command,
            say=self.deaths.append, on_death=self.deaths.append,
        )  # fmt: skip
        self.inputs.findings = self.bench.findings
        self.reader: FakeReader = self.inputs.reader  # type: ignore[assignment]
        self.alter: Alter = lambda state: state
        self.pose = (3.0, 1.0, 0.0)
        self.spin_radps = 0.0
        self.blocked = False
        self.wall_m = math.inf
        self.ticks = 0
        self.bench.see()
        self.bench.think()

    @property
    def command(self) -> tuple[float, float, float]:
        sent = self.bench.sink.commands
        return (sent[-1][1], 0.0, sent[-1][2]) if sent else (0.0, 0.0, 0.0)

    def report(self) -> None:
        """The robot has walked as commanded for 20 ms, and says so."""
        vx = self.command[0]
        if self.blocked or (vx > 0.0 and self.pose[0] >= self.wall_m):
            vx = 0.0
        x, y, theta = self.pose
        self.pose = (x + 0.02 * vx, y, theta + 0.02 * self.spin_radps)
        now_ns = self.bench.now_ns
        state = self.alter(
            RobotState(
                now_ns, self.pose, vx * math.cos(theta), -vx * math.sin(theta), self.spin_radps, 3, 0, now_ns, 0.3,
                0.0, 0.0, self.spin_radps, (20, 20, 20, 20),
            )
        )  # fmt: skip
        if state is not None:
            self.reader.hear(state)

    def drive(self, seconds: float) -> None:
        """Ticks, with a report and a poll_urgent_faults every 20 ms."""
        bench = self.bench
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            began_ns = bench.now_ns
            bench.see()
            self.ticks += 1
            bench.think(self.ticks)
            bench.tick()
            for part in range(1, PERIOD_NS // REPORT_NS + 1):
                bench.now_ns = began_ns + part * REPORT_NS
                self.report()
                if not bench.loop.supervision.stop:
                    bench.loop.poll_urgent_faults()

    @property
    def active(self) -> tuple[str, ...]:
        return self.bench.loop.supervision.active

    def zero_after_ms(self, since_ns: int) -> float:
        """From an instant to the first zero on the wire."""
        sink = self.bench.sink
        sent = zip(sink.stamps_ns, sink.commands, strict=True)
        return (
            next(stamp_ns - since_ns + BRIDGE_NS for stamp_ns, (_, vx, _) in sent if stamp_ns >= since_ns and not vx)
            / MS
        )

    def moving_s(self, since_ns: int) -> float:
        """For how long the robot was told to walk since an instant."""
        sink = self.bench.sink
        ends = [*sink.stamps_ns[1:], self.bench.now_ns]
        sent = zip(sink.stamps_ns, ends, sink.commands, strict=True)
        return sum(end - begin for begin, end, (_, vx, _) in sent if begin >= since_ns and vx) / 1e9


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    rig = Rig(monkeypatch)
    rig.drive(3)
    assert rig.command[0] == pytest.approx(0.5) and rig.active == ()
    return rig


def shifted(dx_m: float) -> Alter:
    return lambda state: replace(
        state, T_odom_base=(state.T_odom_base[0] + dx_m, state.T_odom_base[1], state.T_odom_base[2])
    )


def test_one_jump_of_the_pose_stops_the_robot_for_a_second(rig: Rig) -> None:
    began_ns = rig.bench.now_ns
    rig.alter = shifted(1.0)
    rig.drive(0.5)
    assert rig.active == ("odometry-jump",)
    assert rig.zero_after_ms(began_ns) <= FAULTS["odometry-jump"].bound_ms
    rig.drive(1.5)
    assert rig.active == () and rig.command[0] > 0.4


def test_two_jumps_of_the_pose_within_ten_seconds_stop_the_run(rig: Rig) -> None:
    rig.alter = shifted(1.0)
    rig.drive(5)
    began_ns = rig.bench.now_ns
    rig.alter = shifted(0.0)
    rig.drive(1)
    assert "odometry-jumps" in rig.active and rig.bench.loop.supervision.stop
    assert rig.zero_after_ms(began_ns) <= FAULTS["odometry-jumps"].bound_ms


def test_a_pose_that_stays_while_the_robot_is_told_to_walk_stops_it_for_a_second(rig: Rig) -> None:
    began_ns = rig.bench.now_ns
    rig.blocked = True
    rig.drive(0.8)
    assert rig.active == ("odometry-frozen",)
    assert rig.zero_after_ms(began_ns) <= FAULTS["odometry-frozen"].bound_ms
    rig.blocked = False
    rig.drive(3)
    assert not rig.bench.loop.supervision.stop and rig.command[0] > 0.4


@pytest.mark.slow
def test_a_pose_that_stays_for_good_is_tried_twice_and_then_stops_the_run(rig: Rig) -> None:
    began_ns = rig.bench.now_ns
    rig.blocked = True
    rig.drive(20)
    assert "odometry-stays-frozen" in rig.active and rig.bench.loop.supervision.stop
    assert rig.moving_s(began_ns) <= 2.5  # 0.7 s each, and 1 s back in between


@pytest.mark.slow
def test_a_robot_that_is_blocked_again_and_again_is_stopped_the_fifth_time(rig: Rig) -> None:
    """It gets away from the obstacle and drives into it again."""
    rig.wall_m = rig.pose[0]
    rig.drive(60)
    assert "robot-stays-blocked" in rig.active and rig.bench.loop.supervision.stop
    assert rig.bench.loop.statistics.faults["odometry-frozen"] == 1
    assert rig.bench.loop.statistics.faults["robot-blocked"] == 5


@pytest.mark.parametrize("field", ["vx_mps", "gyro_wz_radps", "T_odom_base"])
def test_a_pose_that_is_not_finite_stops_the_robot_within_its_bound(rig: Rig, field: str) -> None:
    began_ns = rig.bench.now_ns
    nan = (math.nan, 0.0, 0.0) if field == "T_odom_base" else math.nan
    rig.alter = lambda state: replace(state, **{field: nan})  # type: ignore[arg-type]
    rig.drive(0.1)
    assert rig.active == ("odometry-not-finite",)
    assert rig.zero_after_ms(began_ns) <= FAULTS["odometry-not-finite"].bound_ms


@pytest.mark.slow
@pytest.mark.parametrize(("delay_ms", "fault"), [(200, "odometry-late"), (300, "odometry-stale")])
def test_reports_that_stay_late_limit_the_speed_for_as_long_as_they_do(rig: Rig, delay_ms: int, fault: str) -> None:
    stamped = rig.bench.now_ns
    rig.alter = lambda state: replace(state, robot_stamp_ns=max(stamped, state.robot_stamp_ns - delay_ms * MS))
    rig.drive(1)
    for _ in range(20):
        rig.drive(1)
        assert fault in rig.active


@pytest.mark.parametrize(
    ("spin_radps", "alter"),
    [
        (0.0, lambda state: replace(state, vx_mps=state.vx_mps + 0.8)),
        (1.0, lambda state: replace(state, gyro_wz_radps=0.0)),
    ],
    ids=["velocity", "a gyro that shows no turn"],
)
def test_two_speeds_that_disagree_stop_the_run_within_their_bound(rig: Rig, spin_radps: float, alter: Alter) -> None:
    began_ns = rig.bench.now_ns
    rig.spin_radps, rig.alter = spin_radps, alter
    rig.drive(1)
    assert "odometry-speed-mismatch" in rig.active and rig.bench.loop.supervision.stop
    assert rig.zero_after_ms(began_ns) <= FAULTS["odometry-speed-mismatch"].bound_ms


def test_a_robot_that_turns_and_whose_gyro_shows_it_drives_on(rig: Rig) -> None:
    rig.spin_radps = 1.0
    rig.alter = lambda state: replace(state, gyro_wz_radps=state.gyro_wz_radps + 0.2)
    rig.drive(3)
    assert rig.active == ()


def every(nth: int, lost: int) -> Alter:
    """Of every `nth` reports, `lost` do not arrive."""
    count = 0

    def alter(state: RobotState) -> RobotState | None:
        nonlocal count
        count += 1
        return None if count % nth < lost else state

    return alter


def test_half_of_the_states_lost_from_the_start_limits_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch)
    rig.alter = every(4, 2)
    rig.drive(2.5)
    assert rig.active == ("link-lossy",)
    assert rig.command[0] == pytest.approx(0.4)
    few = Rig(monkeypatch)
    few.alter = every(10, 1)
    few.drive(6)
    assert few.active == (), "a tenth is no fault"


def test_half_of_the_states_lost_later_is_found_in_time(rig: Rig) -> None:
    rig.alter = every(4, 2)
    rig.drive(FAULTS["link-lossy"].bound_ms / 1e3)
    assert "link-lossy" in rig.active


def test_a_rate_that_the_bridge_lowers_before_the_robot_moves_is_no_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(monkeypatch)
    for _ in range(150):  # 3 s
        rig.bench.now_ns += REPORT_NS
        rig.report()
    rig.alter = every(2, 1)
    rig.bench.now_ns += REPORT_NS
    rig.drive(4)
    assert rig.active == ()


def test_a_picture_is_seen_with_the_attitude_of_its_own_instant(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Attitude] = []
    eye = SimpleNamespace(step=lambda grey, stamp_ns, attitude: seen.append(attitude))
    poller: dict[str, Callable[[Frame], None]] = {}
    monkeypatch.setattr(inputs, "VisualOdometry", lambda _geometry: eye)
    monkeypatch.setattr(inputs, "CameraPoller", lambda _request, **named: poller.update(see=named["on_frame"]))
    rig = Rig(monkeypatch)
    began_ns = rig.bench.now_ns
    rig.alter = lambda state: replace(state, pitch_rad=(state.received_ns - began_ns) / 1e9)
    rig.drive(0.3)
    jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, dtype=np.uint8))[1].tobytes()
    poller["see"](Frame(began_ns + 150 * MS, np.zeros((1, 32, 32, 3), dtype=np.uint8), jpeg))
    assert [one.pitch_rad for one in seen] == [pytest.approx(0.15)]


class FakeBus:
    """Readers hand over what a test puts into `waiting`."""

    def __init__(self) -> None:
        self.waiting: dict[str, list[object]] = {}

    def reader(self, name: str, _kind: object, **_options: object) -> list[object]:
        return self.waiting.setdefault(name, [])

    def waitset(self, *_readers: object) -> SimpleNamespace:
        return SimpleNamespace(wait=lambda _ns: None)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    def take(waiting: list[object], *_rest: object) -> list[object]:
        taken = [waiting.pop(0) for _ in list(waiting)]
        for one in taken:
            if isinstance(one, Exception):
                raise one
        return taken

    monkeypatch.setattr(client, "take_each", take)
    monkeypatch.setattr(client, "RpcClient", lambda bus, service: None)
    return FakeBus()


def until(done: Callable[[], bool]) -> None:
    for _ in range(500):
        if done():
            return
        client.time.sleep(0.01)
    raise AssertionError("it did not happen within 5 s")


def test_a_battery_report_that_cannot_be_is_no_fault_of_the_odometry(bus: FakeBus) -> None:
    message = LowStateMessage().message
    message.power_v = math.nan
    bus.waiting[client.LF_LOW_STATE_TOPIC] = [message, None]
    reader = Go2Reader(load_robot_config(GO2_SIM), bus=bus)  # type: ignore[arg-type]
    until(lambda: reader.malformed_battery == 2)
    reader.close()
    assert reader.malformed == 0 and reader.battery() is None


def test_a_reading_thread_that_dies_is_reported(bus: FakeBus) -> None:
    bus.waiting[client.SPORT_STATE_TOPIC] = [RuntimeError("the bus is gone")]
    deaths: list[str] = []
    reader = Go2Reader(load_robot_config(GO2_SIM), bus=bus, on_death=deaths.append)  # type: ignore[arg-type]
    until(lambda: bool(deaths))
    reader.close()
    assert deaths == ["robot state thread died: RuntimeError: the bus is gone"]
