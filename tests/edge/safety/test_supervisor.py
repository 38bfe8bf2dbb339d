"""The supervisor: findings in; full speed, less, none, or none for ever out."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.safety.faults.findings import Finding
from edge.safety.faults.table import FAULTS, Action
from edge.safety.supervisor import State, Supervisor, SupervisorInputs, SupervisorOutputs

MS = 1_000_000
names = st.sampled_from(sorted(FAULTS))


class Desk:
    """A supervisor with a clock."""

    def __init__(self, *, armed: bool = True) -> None:
        self.supervisor = Supervisor()
        self.armed = armed
        self.now_ns = 10**9

    def step(self, *found: str, wait_ms: int = 0, scale: float | None = None) -> SupervisorOutputs:
        self.now_ns += wait_ms * MS
        findings = tuple(Finding(name, "why", scale) for name in found)
        return self.supervisor.step(SupervisorInputs(findings, self.armed), self.now_ns)


def test_without_findings_an_armed_robot_runs_at_full_speed() -> None:
    out = Desk().step()
    assert (out.state, out.speed_scale, out.stop, out.message) == (State.RUNNING, 1.0, False, "")


def test_before_arming_it_starts_until_nothing_is_missing_and_then_is_ready() -> None:
    desk = Desk(armed=False)
    assert desk.step("camera-stopped").state is State.STARTING
    assert desk.step(wait_ms=1000).state is State.READY
    desk.armed = True
    assert desk.step().state is State.RUNNING


def test_a_limit_lowers_the_speed_at_once_and_of_several_the_lowest_counts() -> None:
    desk = Desk()
    out = desk.step("camera-slow")
    assert (out.state, out.speed_scale) == (State.DEGRADED, 0.5)
    assert desk.step("semantic-old", scale=0.3).speed_scale == 0.3
    assert desk.step("semantic-old", scale=0.2).speed_scale == 0.2


def test_a_zero_beats_every_limit() -> None:
    out = Desk().step("camera-slow", "odometry-jump")
    assert (out.state, out.speed_scale, out.stop) == (State.DEGRADED, 0.0, False)
    assert out.active == ("odometry-jump", "camera-slow")


def test_a_zero_ends_when_it_was_not_found_for_its_clear_time_and_not_before() -> None:
    desk = Desk()
    desk.step("camera-stopped")
    assert desk.step(wait_ms=999).speed_scale == 0.0
    out = desk.step(wait_ms=1)
    assert (out.state, out.speed_scale) == (State.RUNNING, 1.0)


def test_a_fault_that_is_found_again_starts_its_clear_time_anew() -> None:
    desk = Desk()
    desk.step("camera-stopped")
    desk.step("camera-stopped", wait_ms=900)
    assert desk.step(wait_ms=900).speed_scale == 0.0


@pytest.mark.parametrize("name", sorted(name for name, fault in FAULTS.items() if fault.latch))
def test_a_stop_is_for_ever(name: str) -> None:
    desk = Desk()
    desk.step(name)
    out = desk.step(wait_ms=3_600_000)
    assert (out.state, out.speed_scale, out.stop, out.active) == (State.STOPPED, 0.0, True, (name,))


def test_faults_without_an_action_change_nothing() -> None:
    for name in (name for name, fault in FAULTS.items() if fault.action is Action.NOTHING):
        assert Desk().step(name) == Desk().step()


@pytest.mark.parametrize("name", sorted(name for name, fault in FAULTS.items() if fault.escalation))
def test_often_enough_within_its_time_a_fault_becomes_another(name: str) -> None:
    rule = FAULTS[name].escalation
    assert rule is not None
    gap_ms = rule.window_ms // (rule.count - 1)
    desk = Desk()
    for _ in range(rule.count - 1):
        assert rule.to not in desk.step(name, wait_ms=gap_ms).active
    assert rule.to in desk.step(name, wait_ms=gap_ms).active
    slow = Desk()
    for _ in range(3 * rule.count):
        out = slow.step(name, wait_ms=gap_ms + 1)
    assert rule.to not in out.active


def test_two_findings_of_one_step_count_twice() -> None:
    assert "odometry-jumps" in Desk().step("odometry-jump", "odometry-jump").active


def test_a_fault_is_an_event_when_it_begins_and_when_it_ends_and_not_in_between() -> None:
    desk = Desk()
    outputs = [desk.step("camera-slow"), desk.step("camera-slow", wait_ms=100), desk.step(wait_ms=1000)]
    assert [[(e.fault.name, e.raised) for e in out.events] for out in outputs] == [
        [("camera-slow", True)], [], [("camera-slow", False)],
    ]  # fmt: skip
    assert outputs[2].events[0].stamp_ns == desk.now_ns


def test_the_message_has_the_worst_fault_its_numbers_and_advice() -> None:
    fault = FAULTS["tipped-over"]
    message = Desk().step("camera-slow", "tipped-over").message
    assert message == f"{fault.message.removesuffix('.')} (why). {fault.advice}"


def test_the_message_of_a_fault_that_lasts_does_not_change() -> None:
    supervisor = Supervisor()
    messages = {
        supervisor.step(SupervisorInputs((Finding("semantic-old", f"{age} s old", 0.5),), True), age * 100 * MS).message
        for age in range(10, 20)
    }
    assert len(messages) == 1


def test_the_cause_of_the_stop_stays_the_explanation() -> None:
    desk = Desk()
    first = desk.step("battery-empty").message
    assert desk.step("tipped-over", wait_ms=100).message == first


@given(st.lists(st.tuples(st.lists(names, max_size=3), st.integers(0, 3000)), max_size=30))
def test_no_order_of_findings_gives_speed_while_a_zero_is_there_or_after_a_stop(
    steps: list[tuple[list[str], int]],
) -> None:
    desk, stopped = Desk(), False
    for found, wait_ms in steps:
        out = desk.step(*found, wait_ms=wait_ms)
        stopped = stopped or out.stop
        actions = {FAULTS[name].action for name in (*found, *out.active)}
        assert 0 <= out.speed_scale <= 1
        assert out.stop == stopped
        if stopped or Action.ZERO in actions or Action.STOP in actions:
            assert out.speed_scale == 0.0
        assert len(out.active) <= len(FAULTS)


def test_the_states_have_the_names_that_the_log_and_the_service_report() -> None:
    names = ["STARTING", "READY", "RUNNING", "DEGRADED", "STOPPED"]
    assert [state.value for state in State] == [state.name for state in State] == names
