"""A control loop on a clock that only the test moves, with everything around it under the test's hand."""

from __future__ import annotations

import threading

import numpy as np

from edge.core.geometry import SE2
from edge.inference.graph import GraphError
from edge.motion.controller import Controller, ControllerConfig
from edge.run.control_loop import CommandChain, ControlConfig, ControlLoop, ControlOutputs, ControlSources
from edge.safety.faults.findings import FindingQueue
from edge.safety.monitors.semantic import SemanticConfig
from edge.safety.monitors.watch import Sources, Watch, WatchConfig
from edge.safety.supervisor import Supervisor
from edge.state.frame import Frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.reasoning_text import parse_waypoints
from edge.state.ring import TokenRing
from edge.state.semantic import SemanticSlot, SemanticState, SharedState
from edge.state.switches import Switches
from firmware_bridge.core.config import LimitsConfig
from firmware_bridge.core.link import BridgeStatus

PERIOD_NS = 100_000_000
MS = 1_000_000
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=20.0, alpha_radps2=20.0
)
PX = 32


class FakePolicy:
    """Walks straight ahead, never twice exactly alike; remembers what it was given and can be told to misbehave."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.encoded = 0
        self.calls: list[tuple[float, SE2, int]] = []
        self.broken = False
        self.blind = False
        self.step: tuple[float, float, float] = (0.05, 0.0, 0.0)
        self.constant = False

    def encode(self, frame: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
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
        plan = np.cumsum(np.tile(np.float32(self.step), (30, 1)), axis=0)
        if not self.constant:
            plan[:, 2] += np.float32(1e-6 * (len(self.calls) % 7))
        return plan


class FakeSink:
    """Collects commands; says what state the bridge is in."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.silent_ns = 0
        self.commands: list[tuple[int, float, float]] = []
        self.stamps_ns: list[int] = []
        self.state = "armed"
        self.cause = "none"

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        self.commands.append((seq, vx_mps, wz_radps))
        self.stamps_ns.append(stamp_ns)
        return True

    def poll(self) -> BridgeStatus:
        stamp_ns = self.bench.now_ns - self.silent_ns
        return BridgeStatus(stamp_ns, self.state, "deadman", 0, 0, 0, (0.0, 0.0, 0.0), False, self.cause)


class Attitude:
    """Roll and pitch of the robot."""

    received_ns = 0
    roll_rad = 0.0
    pitch_rad = 0.0


class Bench:
    """`tick()` is one tick on time, with a new picture, a new pose and whatever the test has changed."""

    def __init__(
        self, *, semantic: SemanticConfig | None = None, limits: LimitsConfig = LIMITS, switches: Switches | None = None
    ) -> None:
        self.limits = limits
        self.now_ns = 10**12
        self.encode_ns = 0
        self.frame: Frame | None = None
        self.jpeg = b""
        self.walked_m = 0.0
        self.states = 0
        self.malformed = 0
        self.failed = 0
        self.invalid_texts = 0
        self.asleep_ns = 0
        self.attitude = Attitude()
        self.findings = FindingQueue()
        self.policy = FakePolicy(self)
        self.sink = FakeSink(self)
        self.history = PoseHistory()
        self.ring = TokenRing(16)
        self.slot = SemanticSlot()
        self.stop = threading.Event()
        self.on_time: list[bool] = []
        self._random = np.random.default_rng(0)
        self.controller_config = controller = ControllerConfig(
            limits, step_s=0.1, frame_max_age_ms=500, odometry_max_age_ms=200
        )
        sources = Sources(
            findings=self.findings,
            attitude=lambda: self.attitude,
            states=lambda: self.states,
            malformed=lambda: self.malformed,
            failed_generations=lambda: self.failed,
            invalid_texts=lambda: self.invalid_texts,
            asleep_ns=lambda: self.asleep_ns,
        )
        config = WatchConfig.standard(controller, PERIOD_NS, image_px=PX, semantic=semantic)
        self.loop = ControlLoop(
            self.policy,  # type: ignore[arg-type]
            ControlConfig(PERIOD_NS, 0.1, config.semantic.trained_delay_s, switches or Switches()),
            ControlSources(lambda: self.frame, self.history),
            SharedState(self.ring, self.slot),
            CommandChain(Controller(controller), Watch(config, sources), Supervisor()),
            ControlOutputs(self.sink, on_tick=self.on_time.append),
            stop=self.stop,
            clock=lambda: self.now_ns,
        )
        self.loop.last_seq = 7

    def picture(self) -> np.ndarray:
        return self._random.integers(40, 200, (1, PX, PX, 3), dtype=np.uint8)

    def look(self, pixels: np.ndarray | None = None, age_ms: float = 0.0) -> None:
        """A new picture, captured `age_ms` ago."""
        stamp_ns = self.now_ns - round(age_ms * MS)
        self.frame = Frame(stamp_ns, self.picture() if pixels is None else pixels, self.jpeg)

    def feel(self, x_m: float | None = None, age_ms: float = 0.0) -> None:
        """A new pose; without a place, 4 cm ahead of the last one."""
        self.walked_m = self.walked_m + 0.04 if x_m is None else x_m
        self.states += 50
        self.history.put(StampedPose(self.now_ns - round(age_ms * MS), SE2(self.walked_m, 0.0, 0.0), 0.4, 0.0, 0.0))

    def see(self, x_m: float | None = None) -> None:
        self.feel(x_m)
        self.look()

    def think(
        self,
        generation: int = 0,
        x_m: float | None = None,
        *,
        text: str = "",
        complete: bool | None = None,
        age_s: float = 0.0,
        stop: SE2 | None = None,
    ) -> None:
        kv = np.zeros((1, 3, 8), dtype=np.float32)
        here = SE2(self.walked_m if x_m is None else x_m, 0.0, 0.0)
        anchor_ns = self.now_ns - round(age_s * 1e9)
        waypoints = parse_waypoints(text)
        self.slot.state = SemanticState(
            generation,
            anchor_ns,
            here,
            self.now_ns,
            kv,
            {},
            text,
            waypoints,
            bool(text) if complete is None else complete,
            stop,
        )

    def tick(self) -> tuple[float, str]:
        """One tick with what there is; afterwards it is time for the next one."""
        began_ns = self.now_ns
        command = self.loop.tick(began_ns)
        self.now_ns = max(self.now_ns, began_ns + PERIOD_NS)
        return command.vx_mps, command.reason

    def drive(self, ticks: int = 15) -> None:
        """Ticks in which all is well; the robot is driving at 0.5 m/s afterwards."""
        if self.slot.state is None:
            self.see()
            self.think()
        for _ in range(ticks):
            self.see()
            speed, reason = self.tick()
        assert (round(speed, 2), reason) == (0.5, "ok"), self.loop.supervision
