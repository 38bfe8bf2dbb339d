"""Stops of the real `edge-bridge` process, judged by a robot that obeys, that is leased, or that is not alone.

Each property is one function of one repetition: it runs once in `make test`, and 20 times or more with `make stops`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from random import Random

import pytest

from firmware_bridge.client import BridgeClient
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import SportModeState_, WirelessController_
from firmware_bridge.unitree.rpc import RpcClient
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.services.idl_command import LowCmd_
from sim_hil.protocols.unitree.services.service import APPLY
from sim_hil.protocols.unitree.state import sport_mode_state
from tests.process.bridge.stop_rig import L2, MANY, REPETITIONS, REST_MPS, B, Peer, Rig, report
from tests.support.processes import HostStall, Running, wait_for
from tests.support.robot.fake_go2 import FakeGo2, standing

Series = dict[str, list[float]]

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def rig(robot: FakeGo2, dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Rig:
    rig = Rig(robot, dds_domain, tmp_path_factory.mktemp("stops"))
    rig.reset()
    return rig


@pytest.fixture(scope="module")
def bridge(rig: Rig) -> Iterator[Running]:
    """One bridge for all tests that do not end it."""
    with rig.bridge() as started:
        yield started


@pytest.fixture
def host() -> Iterator[HostStall]:
    with HostStall() as host:
        yield host


def repeat(name: str, repetitions: int, once: Callable[[int], dict[str, float]]) -> Series:
    """Repeat and collect the measured numbers; those of many repetitions are reported."""
    series: Series = {}
    for number in range(repetitions):
        for key, value in once(number).items():
            series.setdefault(key, []).append(value)
    if repetitions >= MANY and series:
        report(name, series)
    return series


def allow(bound_ms: float, since_ns: int, found_ms: float, host: HostStall) -> None:
    """Assert a bound, plus what this machine stood still meanwhile."""
    stall_ms = host.between_ns(since_ns, since_ns + round(found_ms * 1e6)) / 1e6
    assert found_ms <= bound_ms + stall_ms, f"{found_ms:.1f} ms, allowed {bound_ms:g} ms and {stall_ms:.1f} ms stalled"


class TestRemoteKeys:
    """Issue: L2 is pressed before B, and the next runner was driven."""

    @REPETITIONS
    def test_after_the_keys_the_next_runner_drives_only_when_an_operator_arms_it(
        self, rig: Rig, bridge: Running, host: HostStall, repetitions: int
    ) -> None:
        random = Random(1)

        def once(number: int) -> dict[str, float]:
            first, second = random.choice(((L2, B), (B, L2)))
            spacing_s, overlap = random.uniform(0.0, 0.48), random.random() < 0.5
            with rig.driving():
                since_ns = time.monotonic_ns()
                rig.robot.remote = (0.0, 0.0, 0.0, 0.0, first)
                time.sleep(spacing_s)
                rig.robot.remote = (0.0, 0.0, 0.0, 0.0, first | second if overlap else second)
                time.sleep(0.06)
                rig.robot.remote = (0.0, 0.0, 0.0, 0.0, 0)
                zero_ms = rig.zero_after_ms(since_ns)
            allow(100, since_ns, zero_ms, host)
            wait_for(lambda: rig.operate("status")[1]["blocked_by"] == "estop", 2, "the latch")
            time.sleep(1.1)  # the remote counts as in use for a second
            since_ns = time.monotonic_ns()
            with rig.driver() as runner:
                time.sleep(0.8)
                assert not rig.moved_since(since_ns), f"driven {spacing_s * 1e3:.0f} ms apart, overlapping {overlap}"
                rig.arm_for(runner)
                wait_for(lambda: rig.moved_since(since_ns), 10, "the runner that an operator has armed")
            return {"first key to zero, ms": zero_ms}

        repeat("L2 then B", repetitions, once)


class TestConfirmation:
    """Issue: a stop was confirmed although the robot denied it."""

    @REPETITIONS
    def test_a_robot_that_obeys_is_confirmed_when_it_is_at_rest(
        self, rig: Rig, bridge: Running, repetitions: int
    ) -> None:
        def once(number: int) -> dict[str, float]:
            with rig.driving():
                since_ns = time.monotonic_ns()
                code, values, message = rig.operate("stop")
                confirmed_ns = time.monotonic_ns()
                assert code == 0, message
                assert rig.robot.speed_mps < REST_MPS and values["motion"] == "still"
                rest_ms, distance_m = rig.rest_after(since_ns)
            confirmed_ms = (confirmed_ns - since_ns) / 1e6
            assert confirmed_ms >= rest_ms
            return {"stop to rest, ms": rest_ms, "stop to confirmation, ms": confirmed_ms, "distance, m": distance_m}

        series = repeat("stop of a robot that obeys", repetitions, once)
        assert max(series["distance, m"]) < 0.8 * 0.25 + 0.8**2 / (2 * 2.0) + 0.1

    @pytest.mark.slow
    @REPETITIONS
    def test_a_robot_that_another_client_drives_on_is_never_confirmed(
        self, rig: Rig, bridge: Running, host: HostStall, repetitions: int
    ) -> None:
        """The lease was taken unseen: only the robot's denials and its own velocity tell."""

        def once(number: int) -> dict[str, float]:
            with rig.driving():
                rig.robot.take_lease(0.8)
                since_ns = time.monotonic_ns()
                code, values, message = rig.operate("stop")
                told_ms = (rig.first_line_ns - since_ns) / 1e6
                allow(800, since_ns, told_ms, host)
                assert message.startswith("edge-bridge: stop sent; the robot still moves")
                assert code == 1 and "STILL MOVES" in message, message
                assert "press L2 and B" in message and values["motion"] == "moving"
                assert rig.robot.speed_mps > 0.7
                rig.robot.give_lease_back()
            code, values, message = rig.operate("stop")
            while code != 0:
                assert rig.robot.speed_mps >= REST_MPS or values["motion"] != "still"
                code, values, message = rig.operate("stop")
            assert rig.robot.speed_mps < REST_MPS
            return {"stop to `the robot still moves`, ms": told_ms}

        repeat("stop that the robot denies", repetitions, once)

    @pytest.mark.slow
    @REPETITIONS
    def test_a_lease_request_while_driving_is_a_second_commander(
        self, rig: Rig, bridge: Running, host: HostStall, repetitions: int
    ) -> None:
        other = RpcClient(rig.robot.bus, f"{ids.SPORT_SERVICE}_lease")

        def once(number: int) -> dict[str, float]:
            with rig.driving():
                since_ns = time.monotonic_ns()
                other.send(APPLY, "{}")
                zero_ms = rig.zero_after_ms(since_ns)
                allow(500, since_ns, zero_ms, host)
                status = rig.operate("status")[1]
                assert (status["state"], status["cause"]) == ("stopped", "second_commander")
            time.sleep(2.1)  # a foreign request counts for 2 s, the lease for 1 s
            return {"lease request to zero, ms": zero_ms}

        repeat("lease taken while driving", repetitions, once)


class TestPermission:
    """Issue: an operator's arm was kept for ever."""

    @REPETITIONS
    def test_it_is_refused_without_a_runner_and_void_after_a_disconnection(
        self, rig: Rig, bridge: Running, repetitions: int
    ) -> None:
        rig.reset()
        assert rig.operate("stop")[0] == 0
        time.sleep(2.0)

        def once(number: int) -> dict[str, float]:
            time.sleep(0.05)
            code, _, message = rig.operate("arm")
            assert code == 3 and "no runner asks to arm" in message
            first = BridgeClient(rig.socket)
            first.arm()
            wait_for(lambda: rig.operate("arm")[0] == 0, 5, "the permission")
            first.close()
            since_ns = time.monotonic_ns()
            with rig.driver() as second:
                wait_for(lambda: second.asked, 5, "the second runner's request")
                time.sleep(0.3)
                assert not rig.moved_since(since_ns)
                assert rig.operate("status")[1]["permit"] == "needed"
            return {}

        repeat("permission", repetitions, once)

    @pytest.mark.slow
    @REPETITIONS
    def test_it_expires_after_ten_seconds(self, rig: Rig, bridge: Running, repetitions: int) -> None:
        rig.reset()
        assert rig.operate("stop")[0] == 0
        time.sleep(2.0)

        def once(number: int) -> dict[str, float]:
            client = BridgeClient(rig.socket)
            client.arm()
            wait_for(lambda: rig.operate("arm")[0] == 0, 5, "the permission")
            given_ns = time.monotonic_ns()
            wait_for(lambda: client.poll().permit == "needed", 12, "the end of the permission")  # type: ignore[union-attr]
            lasted_s = (time.monotonic_ns() - given_ns) / 1e9
            assert 9.0 < lasted_s < 11.0
            since_ns = time.monotonic_ns()
            client.arm()
            time.sleep(0.3)
            assert not rig.moved_since(since_ns)
            client.close()
            return {"permission lasts, s": lasted_s}

        repeat("permission expires", repetitions, once)


class TestNotAlone:
    """Issue: two robots on one network were both driven; forged messages were believed."""

    @REPETITIONS
    def test_two_robots_are_not_armed_and_a_second_one_stops_the_first(
        self, rig: Rig, bridge: Running, dds_domain: int, host: HostStall, repetitions: int
    ) -> None:
        def once(number: int) -> dict[str, float]:
            with rig.driving():
                since_ns = time.monotonic_ns()
                second = FakeGo2(dds_domain, Peer(dds_domain))
                zero_ms = rig.zero_after_ms(since_ns)
                allow(500, since_ns, zero_ms, host)
                assert rig.operate("status")[1]["cause"] == "second_publisher"
            since_ns = time.monotonic_ns()
            with rig.driver() as runner:
                time.sleep(0.5)
                assert not rig.moved_since(since_ns)
                assert runner.status is not None and runner.status.blocked_by == "second_publisher"
            driven = [one for one in second.received if one.velocity not in (None, (0.0, 0.0, 0.0))]
            assert all(one.received_ns < since_ns for one in driven), "the second robot was driven"
            second.close()
            wait_for(lambda: rig.operate("status")[1]["blocked_by"] != "second_publisher", 15, "a robot alone again")
            return {"second publisher to zero, ms": zero_ms}

        repeat("second robot", repetitions, once)

    @REPETITIONS
    def test_a_publisher_of_motor_commands_stops_a_driven_robot(
        self, rig: Rig, bridge: Running, dds_domain: int, host: HostStall, repetitions: int
    ) -> None:
        def once(number: int) -> dict[str, float]:
            with rig.driving():
                since_ns = time.monotonic_ns()
                peer = Peer(dds_domain)
                writer = peer.writer(ids.LOW_COMMAND_TOPIC, LowCmd_)
                zero_ms = rig.zero_after_ms(since_ns)
                allow(500, since_ns, zero_ms, host)
                assert "rt/lowcmd" in str(rig.operate("status")[1]["reason"])
            del writer
            peer.close()
            wait_for(lambda: rig.operate("status")[1]["blocked_by"] != "second_publisher", 15, "a robot alone again")
            return {"motor-command publisher to zero, ms": zero_ms}

        repeat("motor-command publisher", repetitions, once)

    @pytest.mark.slow
    def test_forged_states_with_future_stamps_do_not_hide_a_tipped_robot(
        self, rig: Rig, bridge: Running, dds_domain: int
    ) -> None:
        peer = Peer(dds_domain)
        with rig.driving():
            forged = peer.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
            since_ns = time.monotonic_ns()
            rig.robot.truth = {"rpy_rad": (1.5, 0.0, 0.0)}
            end_s = time.monotonic() + 2.0
            while time.monotonic() < end_s:
                ahead_s = time.monotonic() + 3600.0
                forged.write(sport_mode_state(standing(time_s=ahead_s), OdometryFrame((0.0, 0.0, 0.0))))
                time.sleep(0.01)
            assert rig.zero_after_ms(since_ns) < 1000
        since_ns = time.monotonic_ns()
        with rig.driver() as runner:
            for _ in range(50):
                forged.write(sport_mode_state(standing(time_s=time.monotonic() + 3600.0), OdometryFrame((0.0,) * 3)))
                time.sleep(0.01)
            assert not rig.moved_since(since_ns)
            assert runner.status is not None and runner.status.blocked_by != "none"
        del forged
        peer.close()
        wait_for(lambda: rig.operate("status")[1]["blocked_by"] == "tipped", 15, "the tipped robot")
        rig.reset()

    @pytest.mark.slow
    def test_forged_stick_messages_do_not_end_the_zeros(
        self, rig: Rig, bridge: Running, dds_domain: int, host: HostStall
    ) -> None:
        with rig.driving():
            rig.operate("stop")
        peer = Peer(dds_domain)
        forged = peer.writer(ids.REMOTE_TOPIC, WirelessController_)
        since_ns = time.monotonic_ns()
        while time.monotonic_ns() - since_ns < 2_000_000_000:
            forged.write(WirelessController_(0.0, 0.9, 0.0, 0.0, 0))
            time.sleep(0.01)
        zeros = [one.received_ns for one in rig.robot.moves() if one.received_ns > since_ns]
        assert len(zeros) >= 60
        for earlier_ns, later_ns in pairwise(zeros):
            allow(60, earlier_ns, (later_ns - earlier_ns) / 1e6, host)
        del forged
        peer.close()
        wait_for(lambda: rig.operate("status")[1]["blocked_by"] != "second_publisher", 15, "a robot alone again")
