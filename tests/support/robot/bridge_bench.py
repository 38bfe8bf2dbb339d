"""A bridge core on a clock that only the test moves."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from firmware_bridge.core.config import BridgeConfig, LimitsConfig, SafetyConfig, load_robot_config
from firmware_bridge.core.link import Arm, BridgeStatus, Velocity
from firmware_bridge.core.robot_state import BatteryState, RobotState
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Identify, Inputs, Move, Outputs, Report, Request, Stand, StopMotion
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.table import robot_table
from tests.support.processes import GO2_SIM

MS = 1_000_000
BRIDGE = BridgeConfig(Path("/nowhere/bridge.sock"))
LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=2.0, alpha_radps2=4.0
)
SAFETY = SafetyConfig()
TABLE = robot_table(load_robot_config(GO2_SIM))
ZERO = Move(0.0, 0.0, 0.0)
STILL = RobotState(
    0, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, ids.MODE_BALANCE_STAND, 0, robot_stamp_ns=0, position_z_m=0.3, roll_rad=0.0,
    pitch_rad=0.0, gyro_wz_radps=0.0, foot_forces=(40, 40, 40, 40),
)  # fmt: skip


@dataclass
class Bench:
    """A bridge core with a clock one turns by hand, a robot that reports `mode`, and everything that was written.

    `robot`: what else the robot reports (fields of RobotState); `version`: what it answers when asked what it is;
    `safety`: that of the robot file; `battery`: the charge it reports in every step, None for no report.
    """

    mode: int | None = ids.MODE_BALANCE_STAND
    client: bool = True
    now_ns: int = 1_000_000_000_000
    seq: int = 0
    version: str | None = "1.0.0.1"
    robot: dict[str, object] = field(default_factory=dict)
    battery: int | None = 80
    estop: bool = False
    asleep_ns: int = 0
    safety: SafetyConfig = SAFETY
    latch: str = ""
    written: list[tuple[int, Request]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.core = BridgeCore(BRIDGE, LIMITS, self.safety, TABLE, self.now_ns, latch=self.latch)
        self.asked = False

    def step(
        self, *messages: object, shutdown: bool = False, operator: tuple[object, ...] = (), **reported: object
    ) -> Outputs:
        """One step; `reported`: what else came over the robot's network (fields of Report)."""
        if self.mode is not None:
            state = replace(STILL, received_ns=self.now_ns, mode=self.mode, **self.robot)
            reported = {"state": state, **reported}
        if self.battery is not None:
            reported = {"battery": BatteryState(self.now_ns, self.battery, 29.0, 1.0), **reported}
        if self.asked:
            reported = {"version": self.version, **reported}
        inputs = Inputs(messages, self.client, Report(**reported), operator, self.estop, self.asleep_ns, shutdown)
        outputs = self.core.step(inputs, self.now_ns)
        asked = Identify()
        self.asked = asked in outputs.requests
        self.written += [(self.now_ns, request) for request in outputs.requests if request != asked]
        return outputs

    def wait(self, ms: float) -> None:
        """Let time pass as the shell does: step at every wake-up the core asks for."""
        end_ns = self.now_ns + int(ms * MS)
        wake_ns = self.step().wake_ns
        while wake_ns <= end_ns:
            self.now_ns = max(wake_ns, self.now_ns)
            wake_ns = self.step().wake_ns
        self.now_ns = end_ns

    def command(self, vx: float = 0.5, vy: float = 0.0, wz: float = 0.0) -> Outputs:
        self.seq += 1
        return self.step(Velocity(self.seq, self.now_ns, vx, vy, wz))

    def drive(self, ms: int, vx: float = 0.5) -> None:
        """Command every 100 ms."""
        for _ in range(ms // 100):
            self.command(vx)
            self.wait(100)

    def arm(self) -> Bench:
        self.ask_to_arm()
        assert self.status.state == "armed"
        return self

    def ask_to_arm(self) -> None:
        """Arm, and the step in which the robot's answer about itself arrives."""
        self.step(Arm())
        self.step()

    def permit(self) -> Bench:
        """A runner asks to arm and an operator's `edge-bridge arm` permits it."""
        self.step(Arm())
        self.step(operator=(Arm(),))
        return self

    @property
    def status(self) -> BridgeStatus:
        return self.core.status(self.now_ns)

    def moves(self) -> list[Move]:
        return [request for _, request in self.written if isinstance(request, Move)]

    def calls(self) -> list[int]:
        """API ids of the requests that are not velocities."""
        steps = (request for _, request in self.written if isinstance(request, (Stand, StopMotion)))
        return [request.step if isinstance(request, Stand) else ids.STOP_MOVE for request in steps]
