"""No message of a ROS 2 network arms: with the real link and the real rules, only a runner's request does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.backends import robot_table
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.link import Arm
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Inputs, Move, Outputs, Report
from firmware_bridge.dds import bus as bus_module
from firmware_bridge.ros2.messages.common import String_
from firmware_bridge.ros2.robot_link import RobotLink
from tests.firmware_bridge.ros2.test_ros2_robot_link import FORWARD, GOOD, changed, settings_of
from tests.support.processes import wait_for
from tests.support.robot.fake_ros2_base import FakeRos2Base, leave, second_bus

PERIOD_NS = 20_000_000


@pytest.fixture
def link(dds_domain: int) -> Iterator[RobotLink]:
    link = RobotLink(settings_of(dds_domain), lambda _: None)
    yield link
    link.close()


def rules(config: RobotConfig, now_ns: int) -> BridgeCore:
    return BridgeCore(config.bridge, config.limits, config.safety, robot_table(config), now_ns)


@pytest.mark.slow
@pytest.mark.parametrize("client", [False, True], ids=["no runner", "a runner that did not ask"])
def test_any_messages_on_any_topic_leave_the_bridge_disarmed_and_silent(
    link: RobotLink, dds_domain: int, monkeypatch: pytest.MonkeyPatch, client: bool
) -> None:
    waiting: list[bytes] = []
    info = SimpleNamespace(valid_data=True)
    monkeypatch.setattr(bus_module, "take_undecoded", lambda reader: [(waiting.pop(), info)] if waiting else [])
    config = settings_of(dds_domain)
    messages = st.one_of(st.sampled_from(GOOD), st.binary(max_size=300), *map(changed, GOOD))

    @settings(max_examples=100)
    @given(st.lists(st.lists(messages, max_size=8), max_size=12))
    def holds(steps: list[list[bytes]]) -> None:
        now_ns = time.monotonic_ns()
        core = rules(config, now_ns)
        for samples in steps:
            now_ns += PERIOD_NS
            waiting[:] = samples
            outputs = core.step(Inputs(client=client, robot=link.read(now_ns)), now_ns)
            assert outputs.status.state == "disarmed" and outputs.requests == ()

    holds()


def test_a_ready_base_drives_only_after_the_runners_request(link: RobotLink, dds_domain: int) -> None:
    """Odometry, IMU, battery, a foreign Twist and a text that asks for it: none arms. The request does."""
    bus = second_bus(dds_domain)
    base = FakeRos2Base(bus)
    texts = bus.writer("rt/instruction", String_)
    now_ns = time.monotonic_ns()
    core = rules(settings_of(dds_domain), now_ns)
    last: list[Outputs] = []

    def step(*messages: Arm) -> Outputs:
        nonlocal now_ns
        base.report()
        report: Report = link.read(time.monotonic_ns())
        now_ns = max(now_ns + 1, time.monotonic_ns())
        last.append(core.step(Inputs(messages, robot=report), now_ns))
        return last[-1]

    wait_for(lambda: step().status.blocked_by == "none", 5, "a base that could be armed")
    stranger = second_bus(dds_domain)
    rogue = stranger.writer("rt/cmd_vel", type(FORWARD))
    for _ in range(20):
        texts.write(String_("arm"))
        rogue.write(FORWARD)
        step()
    assert {outputs.status.state for outputs in last} == {"disarmed"}
    assert not any(isinstance(request, Move) for outputs in last for request in outputs.requests)
    leave(stranger)
    wait_for(lambda: step().status.blocked_by == "none", 5, "the second commander to be forgotten")
    step(Arm())
    wait_for(lambda: step().status.state == "armed", 5, "the runner's request")
