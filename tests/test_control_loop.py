"""The control loop: one tick from frame to command, with the semantic state's own anchor, waiting for nobody."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from edge.camera import Frame
from edge.control_loop import ControlLoop
from edge.controller import Controller, ControllerConfig
from edge.geometry import SE2
from edge.graph import GraphError
from edge.pose_history import PoseHistory, StampedPose
from edge.reasoning_loop import SemanticSlot
from edge.ring import TokenRing
from edge.semantic import SemanticState
from firmware_bridge.config import LimitsConfig
from firmware_bridge.link import BridgeStatus

PERIOD_NS = 100_000_000
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=20.0, alpha_radps2=20.0
)


class FakePolicy:
    """Walks straight ahead; remembers what it was given and can be told to fail."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.encoded = 0
        self.calls: list[tuple[float, SE2, int]] = []
        self.broken = False
        self.blind = False

    def encode(self, frame: np.ndarray) -> np.ndarray:
        if self.blind:
            raise GraphError("vision_encoder: broken")
        self.bench.now_ns += self.bench.encode_ns
        self.encoded += 1
        return np.zeros((1, 4, 8), dtype=np.float32)

    def act(
        self, tokens: np.ndarray, state: tuple[float, ...], delay_s: float, offset: SE2, semantic: SemanticState
    ) -> np.ndarray:
        if self.broken:
            raise GraphError("action_expert: broken")
        self.calls.append((delay_s, offset, semantic.generation))
        return np.cumsum(np.tile(np.float32([0.05, 0, 0]), (30, 1)), axis=0)


class FakeSink:
    """Collects commands; says what state the bridge is in."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.silent_ns = 0
        self.commands: list[tuple[int, float, float]] = []
        self.state = "armed"

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        self.commands.append((seq, vx_mps, wz_radps))
        return True

    def poll(self) -> BridgeStatus:
        return BridgeStatus(self.bench.now_ns - self.silent_ns, self.state, "deadman", 0, 0, 0, (0.0, 0.0, 0.0), False)


class Bench:
    """A control loop on a clock that only the test moves."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        self.encode_ns = 0
        self.frame: Frame | None = None
        self.policy = FakePolicy(self)
        self.sink = FakeSink(self)
        self.history = PoseHistory()
        self.ring = TokenRing(16)
        self.slot = SemanticSlot()
        self.stop = threading.Event()
        config = ControllerConfig(LIMITS, step_s=0.1, frame_max_age_ms=500, odometry_max_age_ms=200)
        self.loop = ControlLoop(
            policy=self.policy,  # type: ignore[arg-type]
            controller=Controller(config),
            newest_frame=lambda: self.frame,
            history=self.history,
            ring=self.ring,
            slot=self.slot,
            sink=self.sink,
            recorder=None,
            period_ns=PERIOD_NS,
            step_s=0.1,
            stop=self.stop,
            clock=lambda: self.now_ns,
        )
        self.loop.last_seq = 7

    def see(self, x_m: float = 0.0) -> None:
        self.history.put(StampedPose(self.now_ns, SE2(x_m, 0.0, 0.0), 0.4, 0.0, 0.0))
        self.frame = Frame(self.now_ns, np.zeros((1, 8, 8, 3), dtype=np.uint8), b"")

    def think(self, generation: int, x_m: float = 0.0) -> None:
        kv = np.zeros((1, 3, 8), dtype=np.float32)
        self.slot.state = SemanticState(generation, self.now_ns, SE2(x_m, 0, 0), self.now_ns, kv, {}, "", None)

    def tick(self) -> tuple[float, str]:
        command = self.loop.tick(self.now_ns)
        self.now_ns += PERIOD_NS
        return command.vx_mps, command.reason


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_without_a_semantic_state_zero_is_sent_and_the_action_expert_is_not_run(bench: Bench) -> None:
    bench.see()
    assert bench.tick() == (0.0, "no-semantic-state")
    assert bench.policy.calls == []
    assert bench.sink.commands == [(8, 0.0, 0.0)]


def test_with_a_semantic_state_the_robot_is_driven(bench: Bench) -> None:
    for _ in range(3):
        bench.see()
        bench.think(0)
        speed, reason = bench.tick()
    assert reason == "ok"
    assert speed == pytest.approx(0.5)


def test_the_delay_is_now_minus_the_anchor_and_the_offset_is_the_motion_since(bench: Bench) -> None:
    bench.see(x_m=1.0)
    bench.think(0, x_m=1.0)
    bench.tick()
    bench.now_ns += 2_000_000_000 - PERIOD_NS
    bench.see(x_m=1.8)
    bench.tick()
    delay_s, offset, _ = bench.policy.calls[-1]
    assert delay_s == pytest.approx(2.0)
    assert offset.x_m == pytest.approx(0.8)
    assert bench.loop.statistics.delay_error_ms[-1] < 1.0


def test_the_delay_is_taken_when_the_action_expert_is_called_not_when_the_tick_began(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    bench.encode_ns = 40_000_000
    bench.tick()
    assert bench.policy.calls[-1][0] == pytest.approx(0.040)


def test_a_frame_is_encoded_once_however_often_it_is_used(bench: Bench) -> None:
    bench.see()
    bench.tick()
    bench.tick()
    assert bench.policy.encoded == 1
    bench.see()
    bench.tick()
    assert bench.policy.encoded == 2


def test_every_encoded_frame_is_left_for_the_reasoning_thread_with_its_pose(bench: Bench) -> None:
    bench.see(x_m=3.0)
    bench.tick()
    (newest,) = bench.ring.select((0.0,))
    assert bench.frame is not None
    assert newest.stamp_ns == bench.frame.stamp_ns
    assert newest.T_odom_base == SE2(3.0, 0.0, 0.0)


def test_when_the_camera_stops_the_command_becomes_zero(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    reasons = []
    for _ in range(8):
        bench.history.put(StampedPose(bench.now_ns, SE2(0, 0, 0), 0.0, 0.0, 0.0))
        reasons.append(bench.tick()[1])
    assert reasons[:6] == ["ok"] * 6
    assert reasons[6:] == ["stale-frame"] * 2


def test_when_the_encoder_fails_fresh_camera_frames_do_not_keep_the_robot_going(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    bench.tick()
    bench.policy.blind = True
    reasons = []
    for _ in range(7):
        bench.see()
        reasons.append(bench.tick()[1])
    assert reasons[-1] == "stale-frame"


def test_a_bridge_that_has_gone_silent_ends_the_loop(bench: Bench) -> None:
    bench.see()
    bench.sink.silent_ns = 700_000_000
    assert bench.loop.run(bench.now_ns, None) == "no word from it for 0.7 s"


def test_a_broken_action_expert_stops_the_robot_and_not_the_loop(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    bench.tick()
    bench.policy.broken = True
    bench.see()
    assert bench.tick() == (0.0, "bad-output")


def test_sequence_numbers_continue_from_the_arming(bench: Bench) -> None:
    for _ in range(3):
        bench.see()
        bench.tick()
    assert [seq for seq, _, _ in bench.sink.commands] == [8, 9, 10]


def test_the_loop_ends_when_the_bridge_has_stopped_the_robot(bench: Bench) -> None:
    bench.see()
    bench.sink.state = "stopped"
    assert bench.loop.run(bench.now_ns, None) == "deadman"
    assert bench.loop.statistics.ticks == 1


def test_a_late_tick_is_counted_and_the_deadlines_it_slept_over_are_skipped(bench: Bench) -> None:
    bench.see()
    send = bench.sink.send_velocity

    def slow_send(*args: float) -> bool:
        bench.now_ns += 250_000_000
        bench.stop.set()
        return send(*args)  # type: ignore[arg-type]

    bench.sink.send_velocity = slow_send  # type: ignore[method-assign]
    bench.loop.run(bench.now_ns, None)
    assert bench.loop.statistics.missed == 2
    assert bench.loop.statistics.tick_ms == [250.0]
