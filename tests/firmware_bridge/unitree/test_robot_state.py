"""What a robot reports: converted when every field can be true, dropped whole when one cannot."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.core.robot_state import BatteryState, RobotState, StampOrder, within
from firmware_bridge.unitree.messages.idl import SportModeState_, TimeSpec_
from firmware_bridge.unitree.report import battery_state, robot_state
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.state import LowStateMessage, sport_mode_state
from tests.support.robot.fake_go2 import standing

S = 1_000_000_000
wild = st.floats(width=32, allow_nan=True, allow_infinity=True)


def sample(**changes: object) -> SportModeState_:
    """A report of a robot that stands, with `changes`; dotted names reach into the IMU."""
    made = sport_mode_state(standing(), OdometryFrame((0.0, 0.0, 0.0)))
    for name, value in changes.items():
        setattr(made.imu_state if hasattr(made.imu_state, name) else made, name, value)
    return made


def state(robot_stamp_ns: int, received_ns: int = 10 * S) -> RobotState:
    converted = robot_state(sample(stamp=TimeSpec_(robot_stamp_ns // S, robot_stamp_ns % S)), received_ns, "odom")
    assert converted is not None
    return converted


def test_every_field_arrives() -> None:
    report = sample(
        stamp=TimeSpec_(3, 5), position=[1.0, 2.0, 0.3], velocity=[0.5, 0.1, 0.0], yaw_speed=0.2, rpy=[0.1, -0.2, 0.0],
        gyroscope=[0.0, 0.0, 0.25], foot_force=[10, 20, 30, 40], mode=3, error_code=7,
    )  # fmt: skip
    converted = robot_state(report, 99, "odom")
    assert converted == RobotState(
        99, (1.0, 2.0, 0.0), 0.5, 0.1, 0.2, 3, 7, robot_stamp_ns=3 * S + 5, position_z_m=0.3, roll_rad=0.1,
        pitch_rad=-0.2, gyro_wz_radps=0.25, foot_forces=(10, 20, 30, 40),
    )  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        {"position": [math.nan, 0.0, 0.0]},
        {"position": [0.0, 0.0, 1.1e6]},
        {"velocity": [0.0, 20.1, 0.0]},
        {"velocity": [0.0, 0.0, math.inf]},
        {"yaw_speed": 51.0},
        {"gyroscope": [0.0, -math.inf, 0.0]},
        {"rpy": [0.0, 0.0, 7.0]},
        {"quaternion": [0.0, 0.0, 0.0, 0.0]},
        {"quaternion": [2.0, 0.0, 0.0, 0.0]},
        {"quaternion": [math.nan, 0.0, 0.0, 0.0]},
        {"mode": 14},
        {"stamp": TimeSpec_(-1, 0)},
        {"stamp": TimeSpec_(1, S)},
    ],
)
def test_a_report_with_an_impossible_field_is_dropped(change: dict[str, object]) -> None:
    assert robot_state(sample(**change), 1, "odom") is None


@given(st.lists(wild, min_size=3, max_size=3), st.lists(wild, min_size=3, max_size=3), wild, wild)
def test_every_output_is_finite_and_bounded(
    position: list[float], velocity: list[float], yaw_speed: float, roll: float
) -> None:
    report = sample(position=position, velocity=velocity, yaw_speed=yaw_speed, rpy=[roll, 0.0, 0.0])
    converted = robot_state(report, 1, "odom")
    if converted is not None:
        assert math.hypot(converted.vx_mps, converted.vy_mps) <= 30
        assert all(abs(value) <= 1e6 for value in (*converted.T_odom_base, converted.wz_radps, converted.roll_rad))


def test_the_battery_is_read_from_the_low_state() -> None:
    message = LowStateMessage().message
    message.bms_state.soc, message.power_v, message.power_a = 57, 28.5, 3.25
    assert battery_state(message, 5) == BatteryState(5, 57, 28.5, 3.25)


@pytest.mark.parametrize(("field", "value"), [("power_v", math.nan), ("power_v", -1.0), ("power_a", 1e9), ("soc", 101)])
def test_an_impossible_battery_is_dropped(field: str, value: float) -> None:
    message = LowStateMessage().message
    setattr(message.bms_state if field == "soc" else message, field, value)
    assert battery_state(message, 5) is None


class TestOrder:
    def test_an_older_report_and_a_repeated_one_are_dropped_and_counted(self) -> None:
        order = StampOrder()
        assert [order.accept(state(stamp)) for stamp in (100, 300, 200, 300, 301)] == [True, True, False, False, True]
        assert order.dropped == 2

    def test_a_robot_without_a_clock_is_believed(self) -> None:
        order = StampOrder()
        assert all(order.accept(state(0)) for _ in range(3))

    def test_a_robot_whose_clock_starts_over_is_believed_after_a_second(self) -> None:
        order = StampOrder()
        order.accept(state(500 * S, received_ns=10 * S))
        assert not order.accept(state(1 * S, received_ns=11 * S))
        assert order.accept(state(1 * S + 1, received_ns=11 * S + 1))
        assert order.accept(state(1 * S + 2, received_ns=11 * S + 2))

    def test_a_publisher_that_repeats_itself_for_ever_is_never_believed(self) -> None:
        order = StampOrder()
        order.accept(state(5, received_ns=0))
        assert not any(order.accept(state(5, received_ns=k * S)) for k in range(1, 10))
        assert not any(order.accept(state(5, received_ns=k * S)) for k in range(15, 60, 6)), "after a silence too"

    def test_a_stamp_from_the_future_does_not_hide_the_reports_after_it(self) -> None:
        order = StampOrder()
        assert order.accept(state(500 * S, received_ns=10 * S))
        assert not order.accept(state(900 * S, received_ns=10 * S + 10))
        assert order.accept(state(500 * S + 20, received_ns=10 * S + 20))

    def test_a_forger_that_creeps_into_the_future_is_not_followed(self) -> None:
        """Each of its stamps is 0.4 s ahead of the one before, which alone would pass for jitter."""
        order = StampOrder()
        ahead_ns, hidden_ms, longest_ms, ms = 0, 0, 0, S // 1000
        for k in range(500):
            now_ns = k * 20 * ms
            genuine = order.accept(state(100 * S + now_ns, received_ns=now_ns))
            hidden_ms = 0 if genuine else hidden_ms + 20
            longest_ms = max(longest_ms, hidden_ms)
            ahead_ns += 400 * ms
            order.accept(state(100 * S + now_ns + ahead_ns, received_ns=now_ns + 10 * ms))
        assert longest_ms <= 520

    @pytest.mark.slow
    def test_a_robots_clock_may_drift_and_its_reports_may_be_late(self) -> None:
        order, ms = StampOrder(), S // 1000
        for k in range(20_000):
            stamp_ns = 100 * S + k * 20 * ms + k * 2000  # 100 ppm fast
            assert order.accept(state(stamp_ns, received_ns=k * 20 * ms + (400 * ms if k % 50 < 10 else 0)))

    def test_a_robot_without_a_clock_is_not_hidden_by_a_forger_with_one(self) -> None:
        order = StampOrder()
        assert order.accept(state(0, received_ns=S))
        assert not order.accept(state(10**18, received_ns=S + 1))
        assert order.accept(state(0, received_ns=S + 2))


class TestDelay:
    """A late report shows where the robot was: it must not pass for where it is."""

    @staticmethod
    def accepted(delays_s: list[float]) -> list[bool]:
        """Whether reports are accepted that come every 20 ms, made in order, each so much late."""
        order = StampOrder()
        stamps = [100.0 + k * 0.02 - delay for k, delay in enumerate(delays_s)]
        return [
            order.accept(replace(state(0), robot_stamp_ns=round(stamp * S), received_ns=round((10 + k * 0.02) * S)))
            for k, stamp in enumerate(stamps)
        ]

    def test_a_delay_that_grows_beyond_half_a_second_is_never_believed(self) -> None:
        growing = [min(5.0, 0.01 * k) for k in range(1000)]
        found = self.accepted(growing)
        assert all(found[:50]) and not any(found[53:])

    def test_after_a_delay_the_timely_reports_are_believed_at_once(self) -> None:
        found = self.accepted([0.0] * 10 + [0.01 * k for k in range(100)] + [0.0] * 10)
        assert all(found[-10:])

    def test_a_clock_that_is_set_back_is_believed_after_a_second(self) -> None:
        found = self.accepted([0.0] * 10 + [0.8] * 100)
        assert not any(found[10:60]) and all(found[61:])

    def test_a_robot_that_is_switched_on_again_without_a_battery_for_its_clock_is_believed(self) -> None:
        order = StampOrder()
        assert order.accept(state(100 * S, received_ns=10 * S))
        assert order.accept(state(102 * S, received_ns=40 * S))
        assert order.accept(state(102 * S + 1, received_ns=40 * S + 1))

    @pytest.mark.parametrize(("more_ns", "believed"), [(0, False), (1, True)])
    def test_only_a_silence_of_more_than_five_seconds_is_a_new_start(self, more_ns: int, believed: bool) -> None:
        order = StampOrder()
        assert order.accept(state(100 * S, received_ns=10 * S))
        assert order.accept(state(102 * S, received_ns=15 * S + more_ns)) is believed
        assert order.dropped == (not believed)
        assert order.accept(state(102 * S + 1, received_ns=15 * S + more_ns + 1)) is believed

    @pytest.mark.parametrize(("back_ns", "believed"), [(S // 10, False), (S // 10 + 1, True)])
    def test_only_a_clock_that_goes_back_by_more_than_100_ms_was_set(self, back_ns: int, believed: bool) -> None:
        order = StampOrder()
        assert order.accept(state(100 * S, received_ns=10 * S))
        assert not order.accept(state(100 * S - back_ns, received_ns=10 * S + 1))
        assert order.accept(state(100 * S + 1, received_ns=12 * S)) is believed

    @pytest.mark.parametrize(("late_ns", "believed"), [(500_900_000, True), (500_900_001, False)])
    def test_a_report_may_be_late_by_half_a_second_and_the_drift_since_the_last_one(
        self, late_ns: int, believed: bool
    ) -> None:
        order, now_ns = StampOrder(), 10_900_000_000
        assert order.accept(state(10 * S, received_ns=10 * S))
        assert order.accept(state(now_ns - late_ns, received_ns=now_ns)) is believed

    def test_a_clock_of_one_nanosecond_is_one(self) -> None:
        order = StampOrder()
        assert all(order.accept(state(0, received_ns=k * S)) for k in range(1, 100))
        assert order.accept(state(1, received_ns=100 * S))
        assert order.accept(state(2, received_ns=100 * S + 1))

    def test_a_report_after_the_first_nanosecond_of_a_clock_may_be_late_too(self) -> None:
        order = StampOrder()
        assert order.accept(state(1, received_ns=10 * S))
        assert not order.accept(state(2, received_ns=10 * S + S * 9 // 10))

    def test_a_robot_that_begins_to_fill_in_stamps_late_is_believed(self) -> None:
        order = StampOrder()
        assert all(order.accept(state(0, received_ns=k * S)) for k in range(1, 100))
        assert all(order.accept(state(k * S, received_ns=(k + 99) * S)) for k in range(1, 4))


class TestClock:
    """How far ahead of ours a robot's clock may be: 500 ms more than it was, and 1 ms a second of drift."""

    def order(self, *reports: tuple[float, float]) -> StampOrder:
        """An order that has accepted reports of (robot's stamp, our time), s."""
        made = StampOrder()
        for stamp_s, received_s in reports:
            assert made.accept(replace(state(0), robot_stamp_ns=round(stamp_s * S), received_ns=round(received_s * S)))
        return made

    def farthest(self, reports: list[tuple[float, float]], received_s: float) -> int:
        """The largest stamp that is accepted after `reports`, less our time, ns; found by bisection."""
        low, high = -S, 5 * S
        while high - low > 1:
            middle = (low + high) // 2
            stamp_ns = round(received_s * S) + middle
            report = replace(state(0), robot_stamp_ns=stamp_ns, received_ns=round(received_s * S))
            low, high = (middle, high) if self.order(*reports).accept(report) else (low, middle)
        return low

    def test_a_stamp_may_be_ahead_by_half_a_second_and_the_drift_since_the_last_report(self) -> None:
        assert self.farthest([(10.0, 10.0)], 10.5) == 500_500_000
        assert self.farthest([(10.0, 10.0)], 11.0) == 501_000_000

    def test_the_offset_follows_late_reports_and_early_ones_no_faster_than_a_clock_drifts(self) -> None:
        assert self.farthest([(10.0, 10.0), (10.9, 11.0)], 11.5) == 499_500_000
        assert self.farthest([(10.0, 10.0), (11.1, 11.0)], 11.5) == 501_500_000
        assert self.farthest([(10.0, 10.0), (10.9999, 11.0)], 11.5) == 500_400_000

    def test_a_robot_that_begins_to_fill_in_stamps_is_compared_with_its_first_report(self) -> None:
        self.order((0.0, 10.0), (0.0, 11.0), (0.9, 11.1))

    def test_a_first_stamp_before_zero_is_dropped(self) -> None:
        order = StampOrder()
        assert not order.accept(replace(state(0), robot_stamp_ns=-1, received_ns=S // 2)) and order.dropped == 1


def test_a_bound_itself_is_within_it_and_nothing_that_is_no_number() -> None:
    assert within(2.0, -2.0, 0.0, 2.0) and within(2.0)
    assert not any(within(2.0, wrong) for wrong in (2.0000001, -2.0000001, math.nan, math.inf))
