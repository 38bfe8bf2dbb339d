"""Record the CAN bus between the bridge and the simulated Carter while the bridge drives it.

    python -m tools.can_trace.record --interface serial --duration 600 --out out/can-serial

Starts `edge-hil` and `edge-bridge` as processes, arms, drives a circle, and writes trace.log (candump's format), the
results of both processes and their logs. Interfaces: "serial" (a pty whose bytes this process carries) and
"udp_multicast" (a virtual bus of this machine, on which this process listens).
Exit codes: 0 recorded; 1 a process failed or the robot was not driven; 2 bad arguments; 130 interrupted.
"""

from __future__ import annotations

import argparse
import math
import os
import select
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TextIO

import can

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line, open_stream
from firmware_bridge.can.multicast import LoopbackMulticastBus
from firmware_bridge.can.serial_line import SerialFrames
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from sim_hil.protocols.can.pty_line import PtyLine
from sim_hil.realtime.children import Children, StepError, Tick
from sim_hil.realtime.robots import BRIDGE_SOCKET, RunAddress, robot_of
from sim_hil.realtime.stack import BRIDGE_TIMEOUT_S, COMMANDS, GRACE_S, READY_LINE, READY_TIMEOUT_S

GROUP = "239.74.163.{}"
SPEED_MPS, RIPPLE_MPS, RADIUS_M = 0.25, 0.1, -0.5
"""Speed, its change to and fro, and the circle's radius to the right, which fits the corridor."""
_COMMAND_NS = 100_000_000
_CHUNK = 4096
_BUFFER_BYTES = 4 * 1024 * 1024


class Tap(Protocol):
    """Listener on the bus between bridge and robot."""

    def files(self) -> Sequence[int]:
        """Return the descriptors to wait on."""

    def take(self) -> list[can.Message]:
        """Return the frames that have passed."""

    def close(self) -> None:
        """Leave the bus."""


class MulticastTap:
    """Third member of a multicast group."""

    def __init__(self, group: str) -> None:
        self._bus = LoopbackMulticastBus(group)
        # A busy machine stops this process for half a second; the default buffer then loses frames of the trace.
        self._bus._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)

    def files(self) -> Sequence[int]:
        """Return the socket."""
        return (self._bus._socket.fileno(),)

    def take(self) -> list[can.Message]:
        """Return the frames that have arrived."""
        found = []
        while (message := self._bus.recv(0.0)) is not None:
            found.append(message)
        return found

    def close(self) -> None:
        """Leave the group."""
        self._bus.shutdown()


class SerialTap:
    """Carrier of the bytes between the robot's line and the line that the bridge opens."""

    def __init__(self, robot: Path, bridge: Path) -> None:
        self._line = PtyLine(bridge)
        self._ends = [os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK) for path in (robot, Path(self._line.near))]
        self._frames = [SerialFrames(), SerialFrames()]

    def files(self) -> Sequence[int]:
        """Return both lines."""
        return self._ends

    def take(self) -> list[can.Message]:
        """Carry what has arrived in both directions and return its frames."""
        found = []
        for index, (end, frames) in enumerate(zip(self._ends, self._frames, strict=True)):
            try:
                data = os.read(end, _CHUNK)
                os.write(self._ends[1 - index], data)
            except BlockingIOError:
                continue
            frames.put(data)
            while (message := frames.take()) is not None:
                found.append(message)
        return found

    def close(self) -> None:
        """Close both lines."""
        for end in self._ends:
            os.close(end)
        self._line.close()


def _write(trace: TextIO, messages: Sequence[can.Message]) -> None:
    stamp_s = time.monotonic_ns() / 1e9
    trace.writelines(f"({stamp_s:.6f}) can0 {each.arbitration_id:03X}#{each.data.hex().upper()}\n" for each in messages)


def _drive(client: BridgeClient, tap: Tap, trace: TextIO, duration_s: float, healthy: Callable[[], None]) -> int:
    """Drive a circle and write the trace; return the number of stops. Raises StepError or BridgeUnavailable."""
    poller = select.poll()
    for file in tap.files():
        poller.register(file, select.POLLIN)
    seq = stops = 0
    begin_ns = next_ns = time.monotonic_ns()
    was_armed = False
    while (now_ns := time.monotonic_ns()) - begin_ns < duration_s * 1e9:
        if now_ns >= next_ns:
            next_ns = max(next_ns + _COMMAND_NS, now_ns)
            healthy()
            status = client.poll()
            armed = status is not None and status.state == "armed"
            stops, was_armed = stops + (was_armed and not armed), armed
            if status is not None and status.state in ("disarmed", "stopped") and seq % 10 == 0:
                client.arm()
            seq += 1
            speed = SPEED_MPS + RIPPLE_MPS * math.sin((now_ns - begin_ns) / 1e9)
            client.send_velocity(seq, now_ns, speed, 0.0, speed / RADIUS_M)
        poller.poll(max(0, (next_ns - time.monotonic_ns()) // 1_000_000))
        _write(trace, tap.take())
    client.stop()
    return stops


def _discard(tap: Tap) -> None:
    """Let frames pass that belong to no trace: those before the bridge is there."""
    while tap.take():
        pass


def _start(children: Children, name: str, arguments: Sequence[str], ready: str, tick: Tick) -> None:
    child = children.start(name, [*COMMANDS[name], *arguments])
    timeout_s = READY_TIMEOUT_S if name == "edge-hil" else BRIDGE_TIMEOUT_S
    is_ready = lambda: ready in child.log.read_text(encoding="utf-8")  # noqa: E731 - one line, used once
    children.wait_until(child, is_ready, timeout_s, f"line {ready!r}", tick)


def record(interface: str, duration_s: float, out: Path) -> int:
    """Record one trace and return the number of stops. Raises StepError, BridgeUnavailable or OSError."""
    robot = robot_of("carter-can")
    with tempfile.TemporaryDirectory(prefix="tic-") as name, Children(out, grace_s=GRACE_S) as children:
        folder = Path(name)
        group = GROUP.format(os.getpid() % 250 + 1)
        robot_line, bridge_line = (folder / "can", folder / "tap") if interface == "serial" else (group, group)
        text = robot.write_file(out / "robot.toml", RunAddress.free(folder, 1)).read_text(encoding="utf-8")
        text = text.replace('interface = "serial"', f'interface = "{interface}"')
        text = text.replace(f'channel = "{folder}/can"', f'channel = "{bridge_line}"')
        (out / "robot.toml").write_text(text, encoding="utf-8")
        hil = ["--robot", "carter", "--protocol", "can", "--scene", "corridor", "--camera", "none"]
        hil += ["--link", f"{interface}:{robot_line}", "--json", str(out / "edge-hil.json")]
        listener = MulticastTap(group) if interface == "udp_multicast" else None
        _start(children, "edge-hil", hil, READY_LINE, lambda: None)
        tap: Tap = listener or SerialTap(folder / "can", folder / "tap")
        client = None
        try:
            path = folder / BRIDGE_SOCKET
            bridge = ["--robot", str(out / "robot.toml"), "--json", str(out / "edge-bridge.json")]
            _start(children, "edge-bridge", bridge, "ready, robot", lambda: _discard(tap))
            client = BridgeClient(path)
            with open_stream(out / "trace.log") as trace:
                _discard(tap)
                return _drive(client, tap, trace, duration_s, lambda: children.check_others(None))
        finally:
            if client is not None:
                client.close()
            tap.close()


@command_line("record")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.can_trace.record",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--interface", choices=("serial", "udp_multicast"), required=True)
    parser.add_argument("--duration", type=float, default=600.0, metavar="S", help="default 600")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for trace, results and logs")
    args = parser.parse_args(argv)
    if not 1 <= args.duration <= 86_400:
        sys.stderr.write(f"record: --duration: expected 1 to 86400 s, found {args.duration}\n")
        return EXIT_BAD_INPUT
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        stops = record(args.interface, args.duration, args.out)
    except (StepError, BridgeUnavailable, OSError) as error:
        sys.stderr.write(f"record: {error}\n")
        return EXIT_CHECK_FAILED
    sys.stderr.write(f"record: {args.out / 'trace.log'}, {args.duration:g} s, {stops} stops\n")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
