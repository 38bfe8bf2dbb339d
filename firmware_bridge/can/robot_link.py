"""The bridge's end of the robot's CAN bus: one `Report` of the received frames per step, and sent requests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from firmware_bridge.can.buses import BusAddress, BusError, FrameBus, open_bus
from firmware_bridge.can.database import load_database
from firmware_bridge.can.frame import Frame
from firmware_bridge.can.reader import BaseReader
from firmware_bridge.can.sender import FrameSender
from firmware_bridge.can.table import STEP_ARM, STEP_RESET, missing_link
from firmware_bridge.core.config import ConfigError, RobotConfig
from firmware_bridge.core.robot_state import within
from firmware_bridge.core.step_types import Identify, Move, Report, Request, Stand

_MOST_FRAMES: Final = 256
"""Frames read in one step: more than a full bus of 1 Mbit/s carries in 20 ms (180), so a backlog shrinks."""
_FAILING_WRITES: Final = 3  # in a row: 60 ms at 50 Hz, inside the 100 ms of fault matrix row 46
_FAILING_NS: Final = 1_000_000_000
"""Time after which a refused frame proves nothing: a bridge that sends nothing would otherwise never arm again."""
_REOPEN_NS: Final = 500_000_000
_STOPS_IGNORED: Final = 20
"""Requests to stop, every 100 ms, after which a base that still moves gets its own emergency stop."""
_OBEYED_NS: Final = 1_000_000_000
"""Time without a request to stop after which the base has obeyed the earlier ones."""
_MOST_SPEED: Final = 1e3  # far above every limit: keeps a value that is no number off the bus


class RobotLink:
    """One CAN base; no method waits. Raises ConfigError for a wrong DBC file, BusError for a bus that does not open."""

    def __init__(self, config: RobotConfig, report: Callable[[str], None]) -> None:
        """`report` takes one line when the bus or its load changes."""
        if config.can is None:
            raise ConfigError("missing table [can]")
        self._config, self._can, self._report = config, config.can, report
        self._database = load_database(config)
        self._address = BusAddress(self._can.interface, self._can.channel)
        self._now_ns = time.monotonic_ns()
        accepted = config.safety.accepted_error_codes
        self._reader = BaseReader(self._can, self._database, self._now_ns, accepted)
        self._sender = FrameSender(self._database)
        self._bus: FrameBus | None = self._opened()
        self._reopen_ns = self._refused_ns = self._stop_ns = 0
        self._failing = self._failed = self._line_errors = self._stops = 0
        self._health = self._reader.health.state
        self._mode = 0 if self._can.mode is None else self._can.mode.disarm
        self._due_ns = self._cyclic_messages()

    def _opened(self) -> FrameBus:
        return FrameBus(open_bus(self._address), echoes=self._address.interface == "udp_multicast")

    def _cyclic_messages(self) -> dict[str, int]:
        """Return the messages that `read` sends at their cycle time, each with the time of its next frame."""
        names = [self._can.heartbeat] if self._can.heartbeat else []
        if (request := self._database.signals.get("can.mode.request")) is not None:
            names += [request.message] if self._database.sent[request.message].cycle_ns else []
        return dict.fromkeys(names, 0)

    def dropped(self) -> tuple[int, int, int]:
        """Return counts so far: invalid frames, frames out of order, frames that the bus did not take."""
        counts, lines = self._reader.counts, 0 if self._bus is None else self._bus.line_errors
        return counts.wrong + counts.out_of_range + self._line_errors + lines, self._reader.reordered, self._failed

    def read(self, now_ns: int) -> Report:
        """Return the report of all frames since the last call; send heartbeat and cyclic mode request when due."""
        self._now_ns = now_ns
        if self._bus is None and now_ns >= self._reopen_ns:
            self._open_again()
        if self._bus is not None:
            try:
                for frame in self._bus.receive(_MOST_FRAMES):
                    self._reader.put(frame, now_ns)
            except BusError as error:
                self._lose_bus(str(error))
        self._send_cyclic()
        report = self._reader.take(now_ns)
        self._report_changes()
        if now_ns - self._refused_ns > _FAILING_NS:
            self._failing = 0
        fails = self._bus is None or self._failing >= _FAILING_WRITES or self._reader.health.state != "active"
        return replace(report, writes_fail=fails)

    def write(self, request: Request) -> None:
        """Send one request without waiting. A frame that the bus does not take is counted."""
        if isinstance(request, Move):
            self._drive(request.vx_mps, request.wz_radps)
        elif isinstance(request, Identify):
            self._reader.ask_version()
        elif isinstance(request, Stand):
            self._stand(request.step)
        else:
            self._stop()

    def close(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _drive(self, vx_mps: float, wz_radps: float) -> None:
        if not within(_MOST_SPEED, vx_mps, wz_radps):
            self._failed += 1
            return
        self._stops = 0 if (vx_mps, wz_radps) != (0.0, 0.0) else self._stops
        self._reader.expect(vx_mps, wz_radps, self._now_ns)
        command = self._database.signals["can.command.vx"].message
        self._send(command, {"can.command.vx": vx_mps, "can.command.wz": wz_radps})

    def _stop(self) -> None:
        """Disarm the base, or command zero where it has no modes; at last use its own emergency stop."""
        obeyed = self._now_ns - self._stop_ns > _OBEYED_NS
        self._stops, self._stop_ns = 1 if obeyed else self._stops + 1, self._now_ns
        if self._can.mode is None:
            self._drive(0.0, 0.0)
        else:
            self._request_mode(self._can.mode.disarm)
        if self._stops >= _STOPS_IGNORED and self._can.estop is not None:
            self._request_estop(self._can.estop.stop)

    def _stand(self, step: int) -> None:
        if step == STEP_ARM and self._can.mode is not None:
            self._stops = 0
            self._request_mode(self._can.mode.arm)
        elif step == STEP_RESET and self._can.estop is not None:
            self._request_estop(self._can.estop.reset)

    def _request_mode(self, value: int) -> None:
        if self._can.mode is None:
            return
        self._mode = value
        message = self._database.signals["can.mode.request"].message
        if message in self._due_ns:
            self._due_ns[message] = self._now_ns + self._database.sent[message].cycle_ns
            self._send(message, {"can.mode.request": value})
            return
        for _ in range(self._can.mode.frames):
            self._send(message, {"can.mode.request": value})

    def _request_estop(self, value: int) -> None:
        signal = self._database.signals.get("can.estop.request")
        if signal is None or self._can.estop is None:
            return
        for _ in range(self._can.estop.frames):
            self._send(signal.message, {"can.estop.request": value})

    def _send_cyclic(self) -> None:
        for name, due_ns in self._due_ns.items():
            if self._now_ns >= due_ns:
                # Relative to the last due time, to keep the rate; after a pause relative to now, to avoid a burst.
                cycle_ns = self._database.sent[name].cycle_ns
                self._due_ns[name] = due_ns + cycle_ns if self._now_ns < due_ns + cycle_ns else self._now_ns + cycle_ns
                self._send(name, {} if name == self._can.heartbeat else {"can.mode.request": self._mode})

    def _send(self, name: str, values: dict[str, float]) -> None:
        frame: Frame = self._sender.make(name, values)
        if self._bus is not None and self._bus.send(frame):
            self._failing = 0
            self._reader.traffic.note(frame.identifier, len(frame.data), known=True)
        else:
            self._failing += 1
            self._failed += 1
            self._refused_ns = self._now_ns

    def _lose_bus(self, reason: str) -> None:
        self._report(f"{reason}; opening it again when it is back")
        if self._bus is not None:
            self._line_errors += self._bus.line_errors
            self._bus.close()
        self._bus, self._reopen_ns = None, self._now_ns + _REOPEN_NS

    def _open_again(self) -> None:
        self._reopen_ns = self._now_ns + _REOPEN_NS
        if missing_link(self._config) is not None:
            return
        try:
            self._bus = self._opened()
        except BusError:
            return  # not yet; the operator knows that it was lost
        self._reader.forget_all()
        self._failing = 0
        self._report(f"CAN bus {self._address} is open again")

    def _report_changes(self) -> None:
        if (line := self._reader.traffic.step(self._now_ns)) is not None:
            self._report(line)
        state = self._reader.health.state
        if state != self._health:
            self._health = state
            advice = "" if state == "active" else ": check wiring, termination and bit rate"
            self._report(f"CAN controller is {state}{advice}")
