"""What the bridge takes from a ROS 2 base in one step, what it writes, and how it notices a second commander."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.step_types import Identify, Move, Report, Stand, StopMotion
from firmware_bridge.dds import bus as bus_module
from firmware_bridge.ros2.messages.common import Twist_, TwistStamped_, Vector3_
from firmware_bridge.ros2.messages.navigation import Odometry_
from firmware_bridge.ros2.robot_link import RobotLink
from tests.support.processes import GO2_SIM, wait_for
from tests.support.robot.fake_ros2_base import FakeRos2Base, battery, imu, leave, odometry, second_bus

CARTER: Path = GO2_SIM.with_name("carter_ros2_sim.toml")


def settings_of(domain: int, **changes: Any) -> RobotConfig:
    """The simulated Carter's robot file, with `changes` of [ros2]."""
    config = load_robot_config(CARTER, domain=domain)
    assert config.ros2 is not None
    return replace(config, ros2=replace(config.ros2, **changes))


Opener = Callable[..., tuple[RobotLink, FakeRos2Base]]


@pytest.fixture
def opened(dds_domain: int) -> Iterator[Opener]:
    """Open the link and a base in another participant."""
    links: list[RobotLink] = []

    def open_link(**changes: Any) -> tuple[RobotLink, FakeRos2Base]:
        links.append(RobotLink(settings_of(dds_domain, **changes), lambda _: None))
        return links[0], FakeRos2Base(second_bus(dds_domain), stamped=bool(changes.get("stamped")))

    yield open_link
    links[0].close()


def read_until(link: RobotLink, base: FakeRos2Base | None, done: Callable[[Report], object]) -> Report:
    """Let the base report and the bridge step until `done(report)`."""
    found: list[Report] = []

    def step() -> bool:
        if base is not None:
            base.report()
        found.append(link.read(time.monotonic_ns()))
        return bool(done(found[-1]))

    wait_for(step, 5, "a report")
    return found[-1]


def commands_of(link: RobotLink, base: FakeRos2Base, *requests: Any) -> list[Any]:
    """What the base receives of these requests."""
    read_until(link, base, lambda report: report.unsafe is None)
    received: list[Any] = []

    def arrived() -> bool:
        received.extend(base.commands())
        return len(received) >= len(requests)

    for request in requests:
        link.write(request)
        time.sleep(0.02)  # the writer keeps the newest command only
    wait_for(arrived, 5, "the commands")
    return received


def test_a_base_that_reports_is_ready_to_drive(opened: Opener) -> None:
    link, base = opened()
    report = read_until(link, base, lambda report: report.state and report.battery and report.unsafe is None)
    assert report.state is not None and report.state.mode == 0
    assert report.battery is not None and report.battery.soc_percent == 80
    assert (report.foreign, report.publishers, report.writes_fail) == (None, None, False)


def test_a_move_is_a_twist_and_a_stop_is_a_twist_of_zero(opened: Opener) -> None:
    link, base = opened()
    sent = commands_of(link, base, Move(0.5, -0.1, 0.3), StopMotion())
    assert (sent[0].linear, sent[0].angular) == (Vector3_(0.5, -0.1, 0.0), Vector3_(0.0, 0.0, 0.3))
    assert (sent[1].linear, sent[1].angular) == (Vector3_(0.0, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0))


def test_what_a_base_without_modes_does_not_know_is_not_sent(opened: Opener) -> None:
    link, base = opened()
    link.write(Identify())
    link.write(Stand(0))
    assert [sent.linear.x for sent in commands_of(link, base, Move(0.1, 0.0, 0.0))] == [0.1]


def test_a_stamped_command_continues_the_clock_of_the_base(opened: Opener) -> None:
    link, base = opened(stamped=True)
    [sent] = commands_of(link, base, Move(0.5, 0.0, 0.0))
    stamp_ns = sent.header.stamp.sec * 1_000_000_000 + sent.header.stamp.nanosec
    assert 0 <= stamp_ns - base._stamp_ns < 500_000_000
    assert sent.header.frame_id == "base_link" and sent.twist.linear.x == 0.5


def test_our_own_commands_are_not_a_second_commanders(opened: Opener) -> None:
    link, base = opened()
    commands_of(link, base, Move(0.5, 0.0, 0.0))
    time.sleep(0.1)
    assert link.read(time.monotonic_ns()).foreign is None


def test_another_publisher_of_the_command_topic_is_a_second_commander_before_it_sends(
    opened: Opener, dds_domain: int
) -> None:
    link, base = opened()
    rogue = second_bus(dds_domain)
    writer = rogue.writer("rt/cmd_vel", Twist_)
    report = read_until(link, base, lambda report: report.foreign)
    assert report.foreign == "1 publishers of rt/cmd_vel, expected 0"
    leave(rogue)
    read_until(link, base, lambda report: report.foreign is None)
    assert writer is not None


def test_a_publisher_of_another_type_on_the_command_topic_counts_too(opened: Opener, dds_domain: int) -> None:
    link, base = opened()
    rogue = second_bus(dds_domain)
    writer = rogue.writer("rt/cmd_vel", TwistStamped_)
    assert read_until(link, base, lambda report: report.foreign).foreign == "1 publishers of rt/cmd_vel, expected 0"
    assert writer is not None
    leave(rogue)


def test_a_known_silent_publisher_is_permitted_until_it_sends(opened: Opener, dds_domain: int) -> None:
    link, base = opened(other_command_publishers=1)
    rogue = second_bus(dds_domain)
    writer = rogue.writer("rt/cmd_vel", Twist_)
    read_until(link, base, lambda report: report.unsafe is None and report.state)
    time.sleep(0.2)
    assert link.read(time.monotonic_ns()).foreign is None
    writer.write(Twist_(Vector3_(0.0, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0)))
    assert read_until(link, base, lambda report: report.foreign).foreign == "a command on rt/cmd_vel"
    leave(rogue)


@pytest.mark.parametrize("topic", ["rt/odom", "rt/imu", "rt/battery_state"])
def test_a_second_publisher_of_an_input_is_named(opened: Opener, dds_domain: int, topic: str) -> None:
    link, base = opened()
    other = second_bus(dds_domain)
    writer = other.writer(topic, Odometry_)
    assert read_until(link, base, lambda report: report.publishers).publishers == f"2 publishers of {topic}, expected 1"
    assert writer is not None
    leave(other)


def test_without_a_subscriber_of_the_command_the_base_must_not_drive(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.unsafe is None)
    leave(base.bus)
    assert "no node subscribes to rt/cmd_vel as Twist;" in str(
        read_until(link, None, lambda report: report.unsafe).unsafe
    )


def test_a_base_that_takes_the_other_kind_of_command_must_not_drive(dds_domain: int) -> None:
    link = RobotLink(settings_of(dds_domain), lambda _: None)
    base = FakeRos2Base(second_bus(dds_domain), stamped=True)
    report = read_until(link, base, lambda report: report.state)
    assert "no node subscribes to rt/cmd_vel as Twist;" in str(report.unsafe)
    link.close()


def test_a_silent_imu_forbids_motion(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.unsafe is None)
    base.imu.write(imu())
    wait_for(lambda: link.read(time.monotonic_ns()).unsafe is None, 5, "the IMU")
    late_ns = time.monotonic_ns() + 600_000_000
    assert link.read(late_ns).unsafe == "no usable message on rt/imu for 500 ms"


def test_a_tilted_imu_tips_a_base_with_flat_odometry(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.unsafe is None)

    def tilted() -> bool:
        base.imu.write(imu(0.7))
        base.odometry.write(odometry(time.monotonic_ns()))
        state = link.read(time.monotonic_ns()).state
        return state is not None and state.roll_rad > 0.6

    wait_for(tilted, 5, "the tilt")


def test_an_imu_that_loses_its_orientation_forbids_motion(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.unsafe is None)
    without = imu()
    without.orientation_covariance = [-1.0, *[0.0] * 8]

    def report() -> str | None:
        base.imu.write(without)
        return link.read(time.monotonic_ns()).unsafe

    wait_for(lambda: report() == "rt/imu reports no orientation any more", 5, "the loss")


def test_an_old_stamp_is_dropped_and_counted(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.state)
    base.odometry.write(odometry(5))
    wait_for(lambda: link.read(time.monotonic_ns()).state is None and link.dropped()[1] == 1, 5, "the old report")


def test_an_odometry_with_a_name_of_a_megabyte_is_dropped(opened: Opener) -> None:
    link, base = opened()
    read_until(link, base, lambda report: report.state)
    large = odometry(time.monotonic_ns())
    large.child_frame_id = "x" * 100_000
    base.odometry.write(large)
    wait_for(lambda: link.read(time.monotonic_ns()).state is None and link.dropped()[0] == 1, 5, "the count")


def test_a_base_without_a_timeout_of_its_own_is_announced(dds_domain: int) -> None:
    lines: list[str] = []
    link = RobotLink(settings_of(dds_domain, base_timeout_ms=0, supervised=True), lines.append)
    link.close()
    assert len(lines) == 1 and "the base may drive on" in lines[0]


FORWARD = Twist_(Vector3_(1.0, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0))
GOOD = [message.serialize() for message in (odometry(5), imu(), battery(), FORWARD)]


@pytest.fixture
def lonely_link(dds_domain: int) -> Iterator[RobotLink]:
    link = RobotLink(settings_of(dds_domain), lambda _: None)
    yield link
    link.close()


def changed(good: bytes) -> st.SearchStrategy[bytes]:
    """Bytes of a good message, some of them replaced, and cut somewhere."""

    def change(cut: int, changes: list[tuple[int, bytes]]) -> bytes:
        data = bytearray(good)
        for at, replacement in changes:
            data[at : at + len(replacement)] = replacement
        return bytes(data[: len(good) - cut])

    places = st.tuples(st.integers(0, len(good) - 1), st.binary(min_size=1, max_size=8))
    return st.builds(change, st.sampled_from([0, 0, 0, 1, 9, 100]), st.lists(places, max_size=6))


@pytest.mark.slow
def test_no_bytes_raise_out_of_a_step_or_become_a_state_that_is_not_finite(
    lonely_link: RobotLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting: list[bytes] = []
    info = SimpleNamespace(valid_data=True)
    monkeypatch.setattr(bus_module, "take_undecoded", lambda reader: [(waiting.pop(), info)] if waiting else [])

    @settings(max_examples=300)
    @given(st.lists(st.one_of(st.binary(max_size=900), *map(changed, GOOD)), max_size=16))
    def holds(samples: list[bytes]) -> None:
        waiting[:] = samples
        report = lonely_link.read(time.monotonic_ns())
        if report.state is not None:
            flat = [*astuple(report.state)[2:], *report.state.T_odom_base]
            assert all(math.isfinite(value) for value in flat if not isinstance(value, tuple))
        if report.battery is not None:
            assert all(map(math.isfinite, astuple(report.battery)))

    holds()
