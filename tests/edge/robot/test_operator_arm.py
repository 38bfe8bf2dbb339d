"""A robot whose file says `operator_arm`: the bridge's rules and the runner that waits, both on a fake clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pytest

from edge.robot.arming import ARMING, WAITING, RefusedError, StoppedEarlyError, arm
from firmware_bridge.core.link import Arm, BridgeStatus, Stop
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, SAFETY, Bench

ASKS_OPERATOR = replace(SAFETY, operator_arm=True)


def bench_of(**changes: object) -> Bench:
    return Bench(safety=ASKS_OPERATOR, **changes)  # type: ignore[arg-type]


def permitted() -> Bench:
    """An operator has permitted the waiting runner to arm; it has not armed yet."""
    return bench_of().permit()


def refused(bench: Bench) -> bool:
    """Whether a runner's arm is refused for want of an operator, without a word to the robot."""
    before = len(bench.written)
    bench.step(Arm())
    said = (bench.status.cause, bench.status.blocked_by) == ("operator", "operator")
    return said and bench.status.state in ("disarmed", "stopped") and bench.written[before:] == []


class TestBridge:
    def test_a_bridge_that_has_started_refuses_to_arm(self) -> None:
        bench = bench_of()
        bench.step()
        assert bench.status.blocked_by == "operator"
        assert refused(bench)
        assert bench.status.reason == "arm refused: waiting for an operator's `edge-bridge arm`"

    def test_asking_again_and_again_changes_nothing_that_would_be_logged(self) -> None:
        bench = bench_of()
        said = set()
        for _ in range(100):
            bench.step(Arm())
            said.add((bench.status.state, bench.status.reason))
            bench.wait(1000)
            said.add((bench.status.state, bench.status.reason))
        assert len(said) == 1 and bench.written == []

    def test_an_operators_arm_lets_the_runner_arm_and_does_nothing_by_itself(self) -> None:
        bench = permitted()
        bench.wait(5000)
        assert bench.status.state == "disarmed" and bench.written == []
        assert bench.status.blocked_by == "none"
        bench.arm()

    @pytest.mark.parametrize("end", ["client stops", "client goes", "deadman", "robot falls silent"])
    def test_it_serves_one_arming_for_every_end(self, end: str) -> None:
        bench = permitted().arm()
        if end == "client stops":
            bench.step(Stop())
        elif end == "client goes":
            bench.client = False
            bench.step()
            bench.client = True
        elif end == "robot falls silent":
            bench.mode = None
            bench.drive(1500)
            bench.mode = ids.MODE_BALANCE_STAND
        bench.wait(1000)
        assert bench.status.state == "stopped"
        bench.step(Arm())
        assert (bench.status.state, bench.status.cause) == ("stopped", "operator")

    def test_an_arm_while_the_robot_drives_does_not_outlive_the_stop(self) -> None:
        bench = permitted().arm()
        bench.step(operator=(Arm(),))
        bench.step(Stop())
        assert bench.status.blocked_by == "operator"

    def test_an_arming_that_is_refused_has_used_it_up(self) -> None:
        bench = permitted()
        bench.battery = 3
        bench.step()
        bench.ask_to_arm()
        assert bench.status.cause == "battery_low"
        bench.battery = 90
        bench.step()
        assert refused(bench)

    def test_an_operators_stop_takes_it_back(self) -> None:
        bench = permitted()
        bench.step(operator=(Stop(),))
        assert bench.status.blocked_by == "estop"
        bench.step(Arm())
        assert (bench.status.state, bench.status.cause) == ("disarmed", "operator")

    def test_an_emergency_stop_that_was_pressed_takes_it_back(self) -> None:
        bench = permitted()
        bench.estop = True
        bench.step()
        assert bench.status.blocked_by == "estop"
        bench.estop = False
        bench.step(Arm())
        assert (bench.status.cause, bench.status.blocked_by) == ("operator", "estop")

    def test_a_robot_found_moving_needs_an_arm_given_after_the_motion(self) -> None:
        bench = bench_of(mode=None)
        bench.step(operator=(Arm(),))
        bench.mode, bench.robot = ids.MODE_BALANCE_STAND, {"vx_mps": 0.5}
        bench.step()
        assert (bench.status.cause, bench.status.blocked_by) == ("robot_moving", "operator")

    def test_a_robot_whose_own_protection_is_weak_is_not_armed(self) -> None:
        bench = Bench()
        weak = "FS_ACTION is 0, expected 2"
        bench.step(Arm(), unsafe=weak)
        for _ in range(100):
            bench.now_ns += 20 * MS
            bench.step(unsafe=weak)
        assert (bench.status.state, bench.status.blocked_by) == ("disarmed", "unsafe_robot")
        assert weak in bench.status.reason and bench.written == []

    def test_other_obstacles_to_arming_are_named_first(self) -> None:
        bench = bench_of()
        bench.battery = 3
        bench.step()
        assert bench.status.blocked_by == "battery_low"


@dataclass
class Runner:
    """The runner's arming against a bridge core, with things that happen at a time (ms after the start)."""

    bench: Bench = field(default_factory=bench_of)
    at_ms: dict[int, Callable[[], object]] = field(default_factory=dict)
    deaf: bool = False
    obstacle: str = ""
    asked_ms: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    waited: list[str] = field(default_factory=list)
    stop: bool = False

    def __post_init__(self) -> None:
        self.start_ns = self.bench.now_ns
        self.bench.step()

    @property
    def now_ms(self) -> int:
        return (self.bench.now_ns - self.start_ns) // MS

    def arm(self) -> bool:
        self.asked_ms.append(self.now_ms)
        if not self.deaf:
            self.bench.step(Arm())
        return True

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        assert (vx_mps, vy_mps, wz_radps) == (0.0, 0.0, 0.0)
        self.bench.command(0.0)
        assert self.bench.seq == seq
        return True

    def poll(self) -> BridgeStatus | None:
        return None if self.deaf else self.bench.status

    def sleep(self, seconds: float) -> None:
        self.bench.wait(seconds * 1e3)
        for due_ms in [due_ms for due_ms in self.at_ms if due_ms <= self.now_ms]:
            self.at_ms.pop(due_ms)()

    def run(self) -> int:
        return arm(
            self,
            limit_s=12.0,
            stop_requested=lambda: self.stop,
            say=self.said.append,
            on_wait=self.waited.append,
            obstacle=lambda: self.obstacle,
            operator=self.bench.safety.operator_arm,
            clock=lambda: self.bench.now_ns,
            sleep=self.sleep,
        )

    def permit(self) -> None:
        self.bench.step(operator=(Arm(),))

    def clear(self) -> None:
        self.obstacle = ""


class TestRunner:
    @pytest.mark.slow
    def test_it_waits_ten_minutes_for_an_operator_requests_once_a_second_and_reports_once(self) -> None:
        runner = Runner()
        runner.at_ms[600_000] = runner.permit
        runner.run()
        assert runner.bench.status.state == "armed"
        assert 600_000 <= runner.now_ms <= 601_500
        assert {round((b - a) / 100) for a, b in zip(runner.asked_ms, runner.asked_ms[1:], strict=False)} <= {
            10,
            11,
            12,
        }
        assert runner.said == ["waiting for `edge-bridge arm`"]

    def test_it_reports_its_state_in_every_turn_from_the_first_wait_until_the_robot_stands(self) -> None:
        runner = Runner(bench_of(mode=ids.MODE_LIE_DOWN))
        runner.at_ms = {5_000: runner.permit, 8_000: lambda: setattr(runner.bench, "mode", ids.MODE_BALANCE_STAND)}
        runner.run()
        assert set(runner.waited) == {WAITING, ARMING}
        assert runner.waited == sorted(runner.waited, key=(WAITING, ARMING).index)
        assert len(runner.waited) >= 0.9 * runner.now_ms / 50

    def test_no_obstacle_ends_the_waiting(self) -> None:
        runner = Runner()
        carried = {"pitch_rad": 1.0}
        runner.at_ms = {
            2_000: lambda: runner.bench.step(operator=(Stop(),)),
            4_000: lambda: setattr(runner.bench, "robot", carried),
            9_000: lambda: setattr(runner.bench, "robot", {}),
            10_000: runner.permit,
        }
        runner.run()
        assert runner.bench.status.state == "armed"

    def test_a_danger_during_the_operators_arm_voids_it_and_the_runner_waits_on(self) -> None:
        runner = Runner(bench_of(robot={"pitch_rad": 1.0}))
        runner.at_ms = {5_000: runner.permit, 9_000: lambda: setattr(runner.bench, "robot", {}), 20_000: runner.permit}
        runner.run()
        assert runner.now_ms >= 20_000

    @pytest.mark.slow
    def test_a_robot_that_does_not_stand_up_in_time_is_a_refusal_after_any_wait(self) -> None:
        runner = Runner(bench_of(mode=ids.MODE_LIE_DOWN))
        runner.at_ms[60_000] = runner.permit
        with pytest.raises(RefusedError, match="not ready after 10 s"):
            runner.run()

    @pytest.mark.parametrize(
        ("obstacle", "when"), [("", "waiting to be armed"), ("dark", "before the robot was armed")]
    )
    def test_a_signal_ends_the_waiting(self, obstacle: str, when: str) -> None:
        runner = Runner(obstacle=obstacle)
        runner.at_ms[5_000] = lambda: setattr(runner, "stop", True)
        with pytest.raises(StoppedEarlyError, match=when):
            runner.run()
        assert runner.now_ms < 5_200

    def test_a_stop_before_the_first_request_sends_none(self) -> None:
        runner = Runner(Bench(), stop=True)
        with pytest.raises(StoppedEarlyError, match="before the robot was armed"):
            runner.run()
        assert runner.asked_ms == [] and runner.bench.status.state == "disarmed"

    def test_a_stop_at_the_moment_at_which_nothing_is_in_the_way_any_more_sends_none(self) -> None:
        runner = Runner(Bench(), obstacle="dark")

        def clear_and_stop() -> None:
            runner.obstacle, runner.stop = "", True

        runner.at_ms[1_000] = clear_and_stop
        with pytest.raises(StoppedEarlyError, match="before the robot was armed"):
            runner.run()
        assert runner.asked_ms == []

    def test_without_operator_arm_nothing_is_waited_for(self) -> None:
        runner = Runner(Bench())
        runner.run()
        assert (runner.said, runner.waited, len(runner.asked_ms)) == ([], [], 1)

    def test_every_other_refusal_is_reported_within_half_a_second(self) -> None:
        """Also one that comes between two looks at the status."""
        runner = Runner(Bench())
        runner.bench.battery = 3
        runner.bench.step()
        with pytest.raises(RefusedError, match="the battery has 3 %"):
            runner.run()
        assert runner.now_ms <= 500

    def test_a_bridge_that_does_not_answer_is_given_up(self) -> None:
        runner = Runner(deaf=True)
        with pytest.raises(RefusedError, match="did not arm in 12 s"):
            runner.run()


class TestInTheWay:
    """What the runner itself finds before arming; the bridge does not know of it."""

    def test_a_lasting_obstacle_is_a_refusal_before_the_bridge_is_asked(self) -> None:
        runner = Runner(Bench(), obstacle="There is no new picture.")
        with pytest.raises(RefusedError, match="not armed: There is no new picture"):
            runner.run()
        assert runner.asked_ms == []
        assert 6_000 <= runner.now_ms <= 6_500

    def test_it_is_a_refusal_too_while_the_bridge_has_a_reason_of_its_own(self) -> None:
        bench = Bench(battery=3)
        bench.step()
        runner = Runner(bench, obstacle="dark")
        with pytest.raises(RefusedError, match="not armed: dark"):
            runner.run()

    def test_it_is_a_refusal_once_an_operator_has_permitted(self) -> None:
        runner = Runner()

        def permit_in_the_dark() -> None:
            runner.obstacle = "dark"
            runner.permit()

        runner.at_ms[2_100] = permit_in_the_dark
        with pytest.raises(RefusedError, match="not armed: dark"):
            runner.run()
        assert 8_000 <= runner.now_ms <= 9_000 and runner.said[-1] == "not armed yet: dark"

    def test_a_transient_obstacle_is_waited_for(self) -> None:
        runner = Runner(Bench(), obstacle="dark")
        runner.at_ms[4_000] = runner.clear
        runner.run()
        assert runner.bench.status.state == "armed" and runner.asked_ms[0] >= 4_000

    @pytest.mark.slow
    def test_before_an_operators_arm_it_may_last_as_long_as_it_does(self) -> None:
        runner = Runner(obstacle="dark")
        runner.at_ms = {600_000: runner.clear, 610_000: runner.permit}
        runner.run()
        assert runner.bench.status.state == "armed"
        assert runner.waited[0] == f"{WAITING} (dark)"

    @pytest.mark.slow
    def test_an_operators_arm_is_not_kept_until_it_goes(self) -> None:
        runner = Runner()
        runner.at_ms = {
            60_000: lambda: setattr(runner, "obstacle", "dark"),
            90_000: runner.permit,
            95_000: runner.clear,
            120_000: runner.permit,
        }
        runner.run()
        assert runner.now_ms >= 120_000

    def test_after_an_emergency_stop_the_runner_waits_for_an_operator_with_any_robot_file(self) -> None:
        bench = Bench()
        bench.step(operator=(Stop(),))
        runner = Runner(bench)
        runner.at_ms[60_000] = runner.permit
        runner.run()
        assert runner.now_ms >= 60_000 and runner.said == ["waiting for `edge-bridge arm`"]
