"""The controller's side of the Carter's CAN frames: for tests, for `sim_hil.protocols.can.drive`, and to read as an
example."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from sim_hil.protocols.can import frames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.e2e import COUNTER_PERIOD, Verdict
from sim_hil.protocols.can.frames import Decoder, Encoder, Received

COMMAND_S: Final = 0.02
HEARTBEAT_S: Final = 0.1
_EVENT_FRAMES: Final = 3
_ODOMETRY_S: Final = 0.02


@dataclass(frozen=True)
class Odometry:
    """One sample; `stamp_s` is the base's own clock, which its heartbeat carries and its cycle time continues."""

    stamp_s: float
    x_m: float
    y_m: float
    heading_rad: float
    vx_mps: float
    wz_radps: float


class CanClient:
    """Speaks to one base. `poll` takes in what has arrived; everything else sends at once and never waits."""

    def __init__(self, link: BusLink) -> None:
        """Takes over `link`: `close` closes it."""
        self._link = link
        self._encoder = Encoder()
        self._decoder = Decoder("Base")
        self._latest: dict[str, dict[str, float]] = {}
        self._position: Received | None = None
        self._stamp_s: float | None = None
        self._counter = 0
        self.odometry: list[Odometry] = []
        self.wrong = dict.fromkeys(Verdict, 0)
        self.lost = 0

    def poll(self) -> None:
        """Take in the frames that have arrived. Raises BusError when the bus has gone."""
        for _, frame in self._link.receive():
            received = self._decoder.decode(frame)
            if received is None:
                continue
            self.wrong[received.verdict] += not received.good
            self.lost += received.newly_lost
            if received.good:
                self._latest[received.name] = dict(received.signals)
                self._pair(received)

    def _pair(self, received: Received) -> None:
        """Put the two frames of one odometry sample together, and date them."""
        if received.name == "BaseHeartbeat":
            self._stamp_s = received.signals["Uptime"]
        elif received.name == "OdometryPosition":
            self._position = received
        elif received.name == "OdometryMotion":
            counter, position = round(received.signals["Counter"]), self._position
            if self._stamp_s is not None:
                self._stamp_s += _ODOMETRY_S * ((counter - self._counter) % COUNTER_PERIOD)
            self._counter = counter
            if position is None or self._stamp_s is None or round(position.signals["Counter"]) != counter:
                return
            x, y, own = position.signals["X"], position.signals["Y"], received.signals
            if not self.odometry or self._stamp_s > self.odometry[-1].stamp_s:
                self.odometry.append(Odometry(self._stamp_s, x, y, own["Heading"], own["Vx"], own["Wz"]))

    def latest(self, name: str) -> dict[str, float]:
        """Signals of the newest good frame of that name; empty before the first."""
        return self._latest.get(name, {})

    @property
    def state(self) -> int | None:
        """STATE_IDLE, STATE_ARMED or STATE_ESTOP as the base's heartbeat says; None before the first."""
        state = self.latest("BaseHeartbeat").get("State")
        return None if state is None else round(state)

    def wait(self, left_ns: int) -> None:
        """Until a frame arrives, at most `left_ns`."""
        self._link.wait(left_ns)

    def heartbeat(self) -> None:
        """Say that the controller lives; every 100 ms."""
        self._link.send(self._encoder.encode("ControllerHeartbeat"))

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        """Command a velocity; every 20 ms."""
        self._link.send(self._encoder.encode("VelocityCommand", Vx=vx_mps, Wz=wz_radps))

    def arm(self) -> None:
        """Ask to be armed."""
        self._event("ModeCommand", frames.MODE_ARM)

    def disarm(self) -> None:
        """Ask to be disarmed."""
        self._event("ModeCommand", frames.MODE_DISARM)

    def stop(self) -> None:
        """Emergency stop, until `reset`."""
        self._event("EstopControl", frames.ESTOP_STOP)

    def reset(self) -> None:
        """Take the emergency stop back; the base is idle then."""
        self._event("EstopControl", frames.ESTOP_RESET)

    def _event(self, name: str, request: int) -> None:
        # Three times: the first may only begin a stream, and one of the others may get lost.
        for _ in range(_EVENT_FRAMES):
            self._link.send(self._encoder.encode(name, Request=request))

    def spin(self, seconds: float, vx_mps: float | None = None, wz_radps: float = 0.0) -> None:
        """Keep the base alive for that long in real time, and drive it when `vx_mps` is given."""
        begin_ns = next_command_ns = next_heartbeat_ns = time.monotonic_ns()
        end_ns = begin_ns + round(seconds * 1e9)
        while (now_ns := time.monotonic_ns()) < end_ns:
            if now_ns >= next_heartbeat_ns:
                next_heartbeat_ns += round(HEARTBEAT_S * 1e9)
                self.heartbeat()
            if vx_mps is not None and now_ns >= next_command_ns:
                next_command_ns += round(COMMAND_S * 1e9)
                self.drive(vx_mps, wz_radps)
            until_ns = min(end_ns, next_heartbeat_ns, next_command_ns if vx_mps is not None else end_ns)
            self.wait(max(until_ns - time.monotonic_ns(), 0))
            self.poll()

    def close(self) -> None:
        """Leave the bus."""
        self._link.close()
