"""Two ground stations watch a driven rover, MAVSDK and MAVProxy, unmodified; MAVProxy takes it over again and again.

edge-hil is the rover, edge-bridge drives it, a client sends velocities in the runner's place and does not stop sending.
Each takeover is one mode command of MAVProxy; the bridge latches, and an operator's arm gives it the rover back.
Measured on the rover's side: the time from the arrival of the mode command to the first zero setpoint of the bridge
after which no other one follows.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.host_stall import HostStall
from sim_hil.realtime.robots import BRIDGE_SOCKET, ROBOTS, RunAddress, free_port
from sim_hil.realtime.stack import COMMANDS, READY_LINE, socket_dir
from sim_hil.realtime.truth import LineTail
from tools.interop.mavproxy_session import MavProxy
from tools.report.machine import machine_facts

BOUND_MS: Final = 100.0
SPEED_MPS: Final = 0.3
TURN_RADPS: Final = 0.6  # a circle of 0.5 m
MODES: Final = (("MANUAL", "1 1 0"), ("HOLD", "1 4 3"))
GROUND: Final = 255
_BRIDGE: Final = 1
_SET_MODE: Final = "MAV_CMD_DO_SET_MODE"
_ARM: Final = "MAV_CMD_COMPONENT_ARM_DISARM"
_HOLD_S: Final = 0.6
_MOVING_SETPOINTS: Final = 10
_TIMEOUT_S: Final = 30.0
_SESSION: Final = Path(__file__).parent / "mavsdk_session.py"
_print = messages("takeover")

EXAMPLES = """examples:
  tools/interop/install_mavproxy.sh /var/tmp/gcs && tools/interop/install_mavsdk.sh /var/tmp/gcs
  python -m tools.interop.takeover --mavproxy /var/tmp/gcs/venv/bin/mavproxy.py \\
      --mavsdk-python /var/tmp/gcs/venv/bin/python --repeat 20 --out out/takeover.json
exit codes: 0 every takeover latched within 100 ms, 1 one did not, or a station saw nothing, 2 bad arguments"""


class Client:
    """Client in the runner's place: velocities at 20 Hz, whatever the bridge answers; it asks to arm while `asks`."""

    def __init__(self, path: Path) -> None:
        self._client = BridgeClient(path)
        self._ending = threading.Event()
        self.asks = True
        self.status: BridgeStatus | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        asked_s = 0.0
        with suppress(BridgeUnavailable):
            for seq in itertools.count(1):
                if self._ending.wait(0.05):
                    return
                self.status = status = self._client.poll()
                state = "" if status is None else status.state
                if self.asks and state in ("disarmed", "stopped") and time.monotonic() - asked_s >= 0.5:
                    asked_s = time.monotonic()
                    self._client.arm()
                self._client.send_velocity(seq, time.monotonic_ns(), SPEED_MPS, 0.0, TURN_RADPS)

    def close(self) -> None:
        """End it."""
        self._ending.set()
        self._thread.join()
        self._client.close()


@dataclass
class Takeover:
    """One takeover; `latency_ms` is None if the bridge went on."""

    mode: str
    latency_ms: float | None
    stall_ms: float
    cause: str
    wrong: list[str]


class Trace:
    """Requests that reached the rover, from edge-hil's trace."""

    def __init__(self, path: Path) -> None:
        self._tail = LineTail(path)
        self._rows: list[dict[str, Any]] = []

    def since(self, t_ns: int, source: int, name: str = "") -> list[dict[str, Any]]:
        """Return the requests of one station from `t_ns` on."""
        self._rows += [row for row in self._tail.lines() if row["kind"] == "wire"]
        return [r for r in self._rows if r["t_ns"] >= t_ns and r["source"] == source and name in ("", r["name"])]

    def is_driven(self) -> bool:
        """Return whether the bridge's newest setpoints are recent and move the rover."""
        last = self.since(time.monotonic_ns() - 400_000_000, _BRIDGE, "SET_POSITION_TARGET_LOCAL_NED")
        return len(last) >= _MOVING_SETPOINTS and all(any(row["velocity"]) for row in last[-_MOVING_SETPOINTS:])


def take_over(
    proxy: MavProxy, client: Client, trace: Trace, host: HostStall, mode: tuple[str, str], arm: Sequence[str]
) -> Takeover:
    """Let MAVProxy change the mode once, judge, and give the rover back. Raises StepError, RuntimeError.

    `arm`: the operator's command that ends the latch.
    """
    name, numbers = mode
    wait(trace.is_driven, "a driven rover")
    client.asks = False
    time.sleep(random.uniform(0.0, 0.1))
    before_ns = time.monotonic_ns()
    proxy.type(f"long DO_SET_MODE {numbers}", r"DO_SET_MODE: ACCEPTED")
    wait(lambda: bool(trace.since(before_ns, GROUND, _SET_MODE)), "the mode command in the trace")
    effect_ns = int(trace.since(before_ns, GROUND, _SET_MODE)[0]["t_ns"])
    time.sleep(_HOLD_S)
    setpoints = trace.since(effect_ns, _BRIDGE, "SET_POSITION_TARGET_LOCAL_NED")
    moving = [row["t_ns"] for row in setpoints if any(row["velocity"])]
    after = [row["t_ns"] for row in setpoints if not moving or row["t_ns"] > moving[-1]]
    zero_ns = after[0] if after else None
    status, wrong = client.status, []
    if status is None or status.state != "stopped":
        wrong.append(f"the bridge is {'unknown' if status is None else status.state}, not stopped")
    if [row for row in trace.since(effect_ns, _BRIDGE) if row["name"] in (_SET_MODE, _ARM)]:
        wrong.append("the bridge requested a mode after the takeover")
    proxy.type("disarm", r"COMPONENT_ARM_DISARM: ACCEPTED")
    client.asks = True
    wait(lambda: client.status is not None and client.status.permit == "needed", "request for an operator's arm")
    # Refused until the rover has left the mode of the remote for a second.
    wait(lambda: subprocess.run(arm, capture_output=True, timeout=_TIMEOUT_S, check=False).returncode == 0, "arming")
    latency_ms = None if zero_ns is None else (zero_ns - effect_ns) / 1e6
    stall_ms = 0.0 if zero_ns is None else host.between_ns(effect_ns, zero_ns) / 1e6
    return Takeover(name, latency_ms, stall_ms, "" if status is None else status.cause, wrong)


def wait(ready: Callable[[], bool], what: str) -> None:
    """Wait for a condition. Raises StepError."""
    deadline_s = time.monotonic() + _TIMEOUT_S
    while not ready():
        if time.monotonic() > deadline_s:
            raise StepError(f"no {what} within {_TIMEOUT_S:g} s")
        time.sleep(0.02)


@contextmanager
def mavsdk(python: Path, port: int) -> Iterator[Callable[[], dict[str, Any]]]:
    """Watch with MAVSDK; the function ends it and returns what it has seen."""
    process = subprocess.Popen(
        [str(python), str(_SESSION), str(port), "--watch"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip

    def seen() -> dict[str, Any]:
        output, _ = process.communicate("", timeout=_TIMEOUT_S)
        found: dict[str, Any] = json.loads(output.splitlines()[-1])
        return found

    try:
        yield seen
    finally:
        process.kill()
        process.wait()


def started(children: Children, name: str, command: list[str], ready: str) -> Child:
    """Start a command and wait for its ready line. Raises StepError."""
    child = children.start(name, command)
    children.wait_until(child, lambda: ready in child.log.read_text(), 90.0, "ready line", lambda: None)
    return child


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Run the session; return the JSON result. Raises StepError, RuntimeError."""
    taken: list[Takeover] = []
    with socket_dir() as folder, Children(folder) as children, HostStall() as host:
        address, ports = RunAddress.free(folder), [free_port(socket.SOCK_DGRAM) for _ in range(2)]
        robot = ROBOTS["carter-mavlink"]
        called = "".join(f",to=127.0.0.1:{port}" for port in ports)
        robot = replace(robot, hil=(robot.hil[0] + called,))
        robot_file = robot.write_file(folder / "robot.toml", address)
        options = ["--scene", "corridor", "--people", "0", "--camera", "none", "--trace", str(folder / "trace.jsonl")]
        hil = [*COMMANDS["edge-hil"], *robot.hil_arguments(address), *options]
        started(children, "edge-hil", hil, READY_LINE)
        started(children, "edge-bridge", [*COMMANDS["edge-bridge"], "--robot", str(robot_file)], "ready")
        arm = [*COMMANDS["edge-bridge"], "arm", "--robot", str(robot_file)]
        trace = Trace(folder / "trace.jsonl")
        proxy = MavProxy(str(args.mavproxy), ports[0], str(folder))
        client = Client(folder / BRIDGE_SOCKET)
        try:
            with mavsdk(args.mavsdk_python, ports[1]) as watched:
                proxy.type("", r"(?i)detected vehicle 1:1.*|online system 1.*")
                for number, mode in zip(range(args.repeat), itertools.cycle(MODES), strict=False):
                    taken.append(take_over(proxy, client, trace, host, mode, arm))
                    latency = "never" if taken[-1].latency_ms is None else f"{taken[-1].latency_ms:.0f} ms"
                    _print(f"{number + 1}/{args.repeat} {mode[0]}: {latency} {'; '.join(taken[-1].wrong)}")
                position = proxy.type("status", r"LOCAL_POSITION_NED[^\n]*")
                seen = watched()
        finally:
            client.close()
            proxy.close()
    return result(taken, seen, position)


def result(taken: list[Takeover], seen: dict[str, Any], position: str) -> dict[str, Any]:
    """Return the JSON result; stalls of the machine are subtracted from a latency above the bound, and counted."""
    values = [each.latency_ms for each in taken if each.latency_ms is not None]
    late = [each for each in taken if each.latency_ms is None or each.latency_ms - each.stall_ms > BOUND_MS]
    wrong = sorted({problem for each in taken for problem in each.wrong})
    if late:
        wrong.append(f"{len(late)} of {len(taken)} takeovers later than {BOUND_MS:g} ms")
    if not ({"OFFBOARD", "MANUAL"} <= set(seen["modes"]) and seen["speed_max_mps"] > SPEED_MPS / 2):
        wrong.append("MAVSDK did not see the rover drive and change its mode")
    return {
        "n": len(taken),
        "p50_ms": statistics.median(values) if values else None,
        "max_ms": max(values, default=None),
        "bound_ms": BOUND_MS,
        "causes": sorted({each.cause for each in taken}),
        "granted": sum(each.latency_ms is None or each.latency_ms > BOUND_MS for each in taken) - len(late),
        "samples": [vars(each) for each in taken],
        "mavsdk": seen,
        "mavproxy": position,
        "problems": wrong,
        "pass": bool(taken) and not wrong,
        "tagged": "measured",
        "machine": machine_facts(),
    }


@command_line("takeover")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = argparse.ArgumentParser(
        "python -m tools.interop.takeover",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--mavproxy", type=Path, required=True, metavar="FILE", help="mavproxy.py of its own environment")
    p.add_argument(
        "--mavsdk-python", type=Path, required=True, metavar="FILE", help="interpreter of MAVSDK's environment"
    )
    p.add_argument("--repeat", type=int, default=20, metavar="N", help="takeovers (default: 20)")
    p.add_argument("--out", metavar="FILE|-", help="also write the result to this file; - is stdout")
    args = p.parse_args(argv)
    try:
        check_result_target(args.out, "--out")
        for path in (args.mavproxy, args.mavsdk_python):
            if not path.is_file():
                raise ValueError(f"{path}: expected a file; install it with tools/interop/install_*.sh")
        if args.repeat < 1:
            raise ValueError(f"--repeat {args.repeat}: expected at least 1")
    except (ValueError, OSError) as error:
        _print(str(error))
        return EXIT_BAD_INPUT
    try:
        summary = run(args)
    except (StepError, RuntimeError, OSError, subprocess.SubprocessError) as error:
        _print(str(error))
        return EXIT_CHECK_FAILED
    write_result(args.out, summary)
    figures = [f"{value:.0f}" if value is not None else "none" for value in (summary["p50_ms"], summary["max_ms"])]
    _print(f"{summary['n']} takeovers: p50 {figures[0]} ms, max {figures[1]} ms; {'; '.join(summary['problems'])}")
    return EXIT_DONE if summary["pass"] else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
