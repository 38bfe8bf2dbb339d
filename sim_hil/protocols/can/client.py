"""Controller's side of the Carter's CAN protocol; used by tests and `sim_hil.protocols.can.drive`, and an example."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from firmware_bridge.can.protection import Verdict
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.frames import COUNTER_PERIOD, Decoder, Encoder, Received

COMMAND_S: Final = 0.02
HEARTBEAT_S: Final = 0.1
_EVENT_FRAMES: Final = 3
_ODOMETRY_S: Final = 0.02


@dataclass(frozen=True)
class Odometry:
    """One odometry sample; `stamp_s` is the base's clock, from its heartbeat and advanced by the cycle time."""

    stamp_s: float
    x_m: float
    y_m: float
    heading_rad: float
    vx_mps: float
    wz_radps: float


class CanClient:
    """Client of one base: `poll` reads the received frames; the other methods send at once and never wait."""

    def __init__(self, link: BusLink) -> None:
        """Take ownership of `link`, which `close` closes."""
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
        """Read the received frames. Raises BusError if the bus was lost."""
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
        """Combine the two frames of an odometry sample and set its time stamp."""
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
        """Return the signals of the newest valid frame of that name; empty before the first."""
        return self._latest.get(name, {})

    @property
    def state(self) -> int | None:
        """State in the base's last heartbeat (STATE_IDLE, STATE_ARMED, STATE_ESTOP); None before the first."""
        state = self.latest("BaseHeartbeat").get("State")
        return None if state is None else round(state)

    def wait(self, left_ns: int) -> None:
        """Wait until a frame arrives, at most `left_ns`."""
        self._link.wait(left_ns)

    def heartbeat(self) -> None:
        """Send a heartbeat; required every 100 ms."""
        self._link.send(self._encoder.encode("ControllerHeartbeat"))

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        """Command a velocity; required every 20 ms."""
        self._link.send(self._encoder.encode("VelocityCommand", Vx=vx_mps, Wz=wz_radps))

    def arm(self) -> None:
        """Request arming."""
        self._event("ModeCommand", frames.MODE_ARM)

    def disarm(self) -> None:
        """Request disarming."""
        self._event("ModeCommand", frames.MODE_DISARM)

    def stop(self) -> None:
        """Request an emergency stop, which lasts until `reset`."""
        self._event("EstopControl", frames.ESTOP_STOP)

    def reset(self) -> None:
        """Reset the emergency stop; the base is idle afterwards."""
        self._event("EstopControl", frames.ESTOP_RESET)

    def _event(self, name: str, request: int) -> None:
        # Three times: the first frame may only begin a stream, and one of the others may be lost.
        for _ in range(_EVENT_FRAMES):
            self._link.send(self._encoder.encode(name, Request=request))

    def spin(self, seconds: float, vx_mps: float | None = None, wz_radps: float = 0.0) -> None:
        """Send heartbeats for that time, and velocity commands if `vx_mps` is given."""
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
