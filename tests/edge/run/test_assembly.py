"""What the robot file says of a body reaches the parts of a run that use it, whatever the protocol."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import firmware_bridge
from edge.inference.release import ReleaseDelay
from edge.inference.scheduling import Role
from edge.motion.controller import Controller, ControllerConfig
from edge.reasoning.generation_cycle import Mode
from edge.robot import inputs
from edge.robot.inputs import RobotInputs
from edge.run import assembly
from edge.run.assembly import StopEvents
from edge.safety.monitors.watch import WatchConfig
from edge.state.switches import Decoding, RecoverySwitch, Switches
from firmware_bridge.core.config import RobotConfig, load_robot_config

ROBOTS = Path(firmware_bridge.__file__).parent / "robots"
FILES = ("go2_sim", "carter_can_sim", "carter_mavlink_sim", "carter_ros2_sim")


@pytest.fixture(params=FILES)
def robot(request: pytest.FixtureRequest) -> RobotConfig:
    return load_robot_config(ROBOTS / f"{request.param}.toml")


def assemble(robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, stop: StopEvents) -> None:
    """Assemble a run whose model, power monitor and reasoning loop are fakes."""
    monkeypatch.setattr(assembly, "make_power_monitor", lambda *_args, **_named: SimpleNamespace(budget=None))
    monkeypatch.setattr(assembly, "read_power_plan", lambda _: SimpleNamespace(max_delay_s=5.0))
    runtime = SimpleNamespace(
        tick_period_ms=100, image_px=32, step_s=0.1, frame_offsets_s=(1.0, 0.0), max_new_tokens=8,
        switches=Switches(Decoding.CONSTRAINED, RecoverySwitch.ON, False),
    )  # fmt: skip
    artifacts = SimpleNamespace(runtime=runtime, trained=True, guided_by_waypoints=False, directory=Path("a"))
    policy = SimpleNamespace(tokens_shape=(1, 4, 8), artifacts=artifacts)
    engines: Any = SimpleNamespace(
        artifacts=artifacts, policy=policy, language=None, activity=None,
        schedule=SimpleNamespace(shared=False, reasoning=None, control=Role("control")),
    )  # fmt: skip
    reader = SimpleNamespace(state=None, malformed=0)
    inputs: Any = SimpleNamespace(
        battery=None, findings=SimpleNamespace(put=None), reader=reader, states=0, offset_covariance=None,
        history=SimpleNamespace(newest=None), camera=SimpleNamespace(newest=None),
    )  # fmt: skip
    options = assembly.RunOptions("go", Mode.ASYNC, None, ReleaseDelay(0.0, 0.0, 0), None)
    sink: Any = None
    assembly.assemble(engines, robot, options, inputs, sink, None, stop=stop, say=print, on_tick=lambda _: None)


def test_its_limits_reach_the_controller_and_the_monitor_of_the_policys_output(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    controllers: list[ControllerConfig] = []
    watches: list[WatchConfig] = []
    monkeypatch.setattr(assembly, "Controller", lambda config: controllers.append(config) or Controller(config))
    monkeypatch.setattr(assembly, "Watch", lambda config, _sources: watches.append(config))
    monkeypatch.setattr(assembly, "ReasoningLoop", lambda *_args, **_named: SimpleNamespace(cycle=None))
    assemble(robot, monkeypatch, StopEvents())
    assert [config.limits for config in controllers] == [robot.limits]
    assert [config.output.limits for config in watches] == [robot.limits] * 2


def test_a_stop_reaches_each_loop_by_an_event_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that waits for an event takes its lock: control would wait for reasoning that is set aside with it."""
    events: dict[str, threading.Event] = {}

    def loop(name: str) -> Callable[..., Any]:
        def build(*_args: object, stop: threading.Event, **_named: object) -> Any:
            events[name] = stop
            return SimpleNamespace(cycle=None)

        return build

    monkeypatch.setattr(assembly, "ControlLoop", loop("control"))
    monkeypatch.setattr(assembly, "ReasoningLoop", loop("reasoning"))
    stop = StopEvents()
    assemble(load_robot_config(ROBOTS / "go2_sim.toml"), monkeypatch, stop)
    stop.set()
    assert events["control"] is not events["reasoning"]
    assert events["control"].is_set() and events["reasoning"].is_set()


def test_its_camera_height_and_angle_reach_visual_odometry(robot: RobotConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    reader = SimpleNamespace(set_state_listener=lambda _: None, close=lambda: None)
    source = SimpleNamespace(request_frame=None, captured_ns=None, close=lambda: None)
    monkeypatch.setattr(inputs, "open_reader", lambda *_: (reader, source))
    monkeypatch.setattr(inputs, "CameraPoller", lambda *_args, **_named: None)
    monkeypatch.setattr(inputs, "VisualOdometry", lambda geometry: seen.append(geometry))
    RobotInputs(robot, image_px=32, period_ns=10**8, commanded=lambda: None, say=print, on_death=print)
    assert robot.mount is not None
    assert [(one.height_m, one.forward_m) for one in seen] == [(robot.mount.height_m, robot.mount.forward_m)]
