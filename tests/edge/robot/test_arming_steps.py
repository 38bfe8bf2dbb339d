"""Arming and disarming step by step, against a bridge whose every status is written down here."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.robot.arming import RefusedError, arm, check_bridge, disarm
from firmware_bridge.client import BridgeStatus, BridgeUnavailable
from firmware_bridge.core.config import DdsConfig, load_robot_config
from tests.support.processes import GO2_SIM

MS = 1_000_000
START_NS = 10**12


def status(at_ms: float, state: str = "disarmed", cause: str = "none", **more: Any) -> BridgeStatus:
    """A status of the bridge, stamped `at_ms` after the start."""
    values: dict[str, Any] = {"zero_after_stop": False, "blocked_by": "none", "motion": "unknown", **more}
    return BridgeStatus(
        START_NS + round(at_ms * MS), state, "why not", 0, 0, 0, (0.0, 0.0, 0.0), values["zero_after_stop"], cause,
        values["blocked_by"], motion=values["motion"],
    )  # fmt: skip


class FakeBridge:
    """Says what `says` returns for the time since the start, ms; time passes only in `sleep`."""

    def __init__(self, says: Callable[[float], BridgeStatus | None]) -> None:
        self.now_ns = START_NS
        self.says = says
        self.asked_ms: list[float] = []
        self.stopped_ms: list[float] = []
        self.sent: list[tuple[float, int, float, tuple[float, float, float]]] = []
        self.slept_s: list[float] = []
        self.said: list[str] = []
        self.waited: list[str] = []
        self.obstacle: Callable[[float], str] = lambda _ms: ""

    @property
    def ms(self) -> float:
        return (self.now_ns - START_NS) / MS

    def arm(self) -> bool:
        self.asked_ms.append(self.ms)
        return True

    def stop(self) -> bool:
        self.stopped_ms.append(self.ms)
        return True

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        self.sent.append((self.ms, seq, (stamp_ns - START_NS) / MS, (vx_mps, vy_mps, wz_radps)))
        return True

    def poll(self) -> BridgeStatus | None:
        return self.says(self.ms)

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_ns += round(seconds * 1e9)
        assert self.ms < 60_000, "no end in sight"

    def run(self, **options: Any) -> int:
        return arm(
            self, limit_s=12.0, stop_requested=lambda: False, say=self.said.append, on_wait=self.waited.append,
            obstacle=lambda: self.obstacle(self.ms), clock=lambda: self.now_ns, sleep=self.sleep, **options,
        )  # fmt: skip

    def disarm(self, limit_s: float = 2.0) -> bool:
        return disarm(self, limit_s=limit_s, clock=lambda: self.now_ns, sleep=self.sleep)


def stands_up(at_ms: float) -> BridgeStatus:
    """A bridge that arms at once and has the robot on its feet after 300 ms."""
    return status(at_ms, "armed" if at_ms >= 300 else "arming" if at_ms > 0 else "disarmed")


class TestAsking:
    def test_zeros_with_rising_numbers_are_sent_every_50_ms_and_the_last_number_is_returned(self) -> None:
        bridge = FakeBridge(stands_up)
        assert bridge.run() == 7
        assert bridge.sent == [(50.0 * k, k + 1, 50.0 * k, (0.0, 0.0, 0.0)) for k in range(7)]
        assert bridge.asked_ms == [0.0] and set(bridge.slept_s) == {0.05}

    @pytest.mark.parametrize(("age_ms", "refused"), [(0, False), (199, False), (200, True), (399, True)])
    def test_a_status_is_an_answer_from_200_ms_after_the_request(self, age_ms: int, refused: bool) -> None:
        bridge = FakeBridge(lambda ms: stands_up(ms) if ms >= 150 else status(age_ms, "stopped", "deadman"))
        if not refused:
            assert bridge.run() > 0
            return
        with pytest.raises(RefusedError, match="the bridge refused to arm: why not"):
            bridge.run()
        assert bridge.ms == 0.0

    def test_a_stop_after_the_arming_has_begun_needs_no_200_ms(self) -> None:
        bridge = FakeBridge(lambda ms: status(ms, "arming") if ms < 100 else status(ms, "stopped", "deadman"))
        with pytest.raises(RefusedError, match="refused to arm"):
            bridge.run()
        assert bridge.ms == 100.0

    def test_a_bridge_that_says_nothing_is_given_up_as_disarmed(self) -> None:
        bridge = FakeBridge(lambda _ms: None)
        with pytest.raises(RefusedError, match=r"did not arm in 12 s \(its state is disarmed\)"):
            bridge.run()
        assert 12_000 < bridge.ms <= 12_050


class TestWaitingForAnOperator:
    @staticmethod
    def says(ms: float) -> BridgeStatus:
        """An operator arms after 2.5 s; the robot stands 0.3 s later."""
        if ms >= 2800:
            return status(ms, "armed")
        return status(ms, "arming") if ms >= 2500 else status(ms, cause="operator", blocked_by="operator")

    def test_the_request_is_repeated_every_second(self) -> None:
        bridge = FakeBridge(self.says)
        bridge.run(operator=True)
        assert bridge.asked_ms == [0.0, 1000.0 + 0.0, 2000.0]

    def test_nothing_is_sent_from_the_answer_until_the_arming_begins(self) -> None:
        bridge = FakeBridge(self.says)
        bridge.run(operator=True)
        assert not [ms for ms, *_ in bridge.sent if 200 < ms <= 2500]
        assert [ms for ms, *_ in bridge.sent if ms > 2500] == [2550.0, 2600.0, 2650.0, 2700.0, 2750.0, 2800.0]

    def test_each_turn_tells_what_is_waited_for(self) -> None:
        bridge = FakeBridge(self.says)
        bridge.run(operator=True)
        assert bridge.waited == ["waiting to be armed"] * 46 + ["arming"] * 6
        assert bridge.said == ["waiting for `edge-bridge arm`"]

    def test_a_repeated_request_waits_for_its_own_answer(self) -> None:
        def says(ms: float) -> BridgeStatus:
            tipped = 1000 < ms < 1200
            return status(ms, cause="tipped", blocked_by="tipped") if tipped else self.says(ms)

        bridge = FakeBridge(says)
        assert bridge.run(operator=True) > 0


class TestInTheWay:
    def test_an_obstacle_of_six_seconds_is_waited_for_and_a_longer_one_is_not(self) -> None:
        bridge = FakeBridge(lambda ms: stands_up(ms - 6050))
        bridge.obstacle = lambda ms: "dark" if ms <= 6000 else ""
        assert bridge.run() > 0
        bridge = FakeBridge(stands_up)
        bridge.obstacle = lambda ms: "dark" if ms <= 6050 else ""
        with pytest.raises(RefusedError, match="not armed: dark"):
            bridge.run()
        assert bridge.ms == 6050.0

    def test_without_an_operator_nobody_is_told_that_it_waits(self) -> None:
        bridge = FakeBridge(lambda ms: stands_up(ms - 1000))
        bridge.obstacle = lambda ms: "dark" if ms < 1000 else ""
        bridge.run()
        assert bridge.waited == []

    def test_for_an_operator_each_turn_names_the_obstacle(self) -> None:
        bridge = FakeBridge(lambda ms: stands_up(ms - 1000))
        bridge.obstacle = lambda ms: "dark" if ms < 1000 else ""
        bridge.run(operator=True)
        assert bridge.waited == ["waiting to be armed (dark)"] * 20

    def test_each_obstacle_is_reported_once_until_another_one_comes(self) -> None:
        bridge = FakeBridge(lambda ms: stands_up(ms - 3000))
        bridge.obstacle = lambda ms: "" if ms >= 3000 else "late" if 1000 <= ms < 2000 else "dark"
        bridge.run()
        assert bridge.said == [f"not armed yet: {why}" for why in ("dark", "late", "dark")]

    def test_an_obstacle_is_no_reason_to_wait_longer_unless_an_operator_arms(self) -> None:
        bridge = FakeBridge(lambda ms: status(ms, blocked_by="operator"))
        bridge.obstacle = lambda _ms: "dark"
        with pytest.raises(RefusedError, match="not armed: dark"):
            bridge.run()


class TestDisarm:
    @staticmethod
    def still(ms: float, **changes: Any) -> BridgeStatus:
        return status(ms, **{"state": "stopped", "zero_after_stop": True, "motion": "still", **changes})

    @pytest.mark.parametrize("state", ["stopped", "disarmed"])
    def test_it_is_confirmed_by_zeros_and_a_robot_that_reports_standing_still(self, state: str) -> None:
        bridge = FakeBridge(lambda ms: self.still(ms, state=state))
        assert bridge.disarm() and bridge.stopped_ms == [0.0]

    @pytest.mark.parametrize(
        "changes",
        [{"state": "armed"}, {"zero_after_stop": False}, {"motion": "moving"}, {"motion": "unknown"}],
        ids=str,
    )
    def test_anything_less_is_asked_again_every_10_ms_up_to_the_limit(self, changes: dict[str, Any]) -> None:
        bridge = FakeBridge(lambda ms: self.still(ms, **changes))
        assert not bridge.disarm(0.1)
        assert bridge.stopped_ms == [10.0 * k for k in range(10)] and set(bridge.slept_s) == {0.01}

    def test_a_status_from_before_the_request_confirms_nothing(self) -> None:
        bridge = FakeBridge(lambda ms: self.still(-1 if ms < 50 else ms))
        assert bridge.disarm() and bridge.ms == 50.0

    def test_a_status_of_the_very_instant_confirms(self) -> None:
        bridge = FakeBridge(lambda _ms: self.still(0))
        assert bridge.disarm() and bridge.ms == 0.0

    def test_no_status_confirms_nothing(self) -> None:
        assert not FakeBridge(lambda _ms: None).disarm(0.1)

    def test_a_connection_that_has_ended_confirms_nothing(self) -> None:
        def gone(_ms: float) -> BridgeStatus:
            raise BridgeUnavailable("gone")

        bridge = FakeBridge(gone)
        assert not bridge.disarm() and bridge.stopped_ms == [0.0]


# The bridge that was reached


def test_a_bridge_with_the_same_robot_file_is_accepted() -> None:
    robot = load_robot_config(GO2_SIM)
    check_bridge(replace(status(0), robot=robot.digest), robot)
    check_bridge(None, robot)


@given(st.text())
def test_a_robots_digest_fits_the_bridges_json_result(name: str) -> None:
    assert 0 <= replace(load_robot_config(GO2_SIM), name=name).digest < 2**63


@pytest.mark.parametrize(
    "change", [{"name": "other"}, {"dds": DdsConfig(7, "lo", ("127.0.0.1",))}], ids=["name", "address"]
)
def test_a_bridge_of_another_robot_is_refused(change: dict[str, Any]) -> None:
    robot = load_robot_config(GO2_SIM)
    with pytest.raises(RefusedError, match="serves another robot than"):
        check_bridge(replace(status(0), robot=replace(robot, **change).digest), robot)


@pytest.mark.parametrize(("permit", "refused"), [("not needed", True), ("needed", False), ("given", False)])
def test_a_bridge_that_arms_without_the_operator_whom_the_robot_file_requires_is_refused(
    permit: str, refused: bool
) -> None:
    robot = load_robot_config(GO2_SIM)
    robot = replace(robot, safety=replace(robot.safety, operator_arm=True))
    found = replace(status(0), robot=robot.digest, permit=permit)
    with pytest.raises(RefusedError, match="operator_arm") if refused else nullcontext():
        check_bridge(found, robot)
