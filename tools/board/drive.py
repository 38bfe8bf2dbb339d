"""A scripted client drives the simulated Go2 through a bridge in the arm64 root; the robot's own trace is the judge."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED
from firmware_bridge.client import BridgeClient
from tools.board.journey import BIN, CURRENT, ROBOT_FILE
from tools.board.root import ENVIRONMENT

SPEED_MPS: Final = 0.4
DRIVE_S: Final = 6.0
START_S: Final = 90.0  # an emulated bridge imports for 10 s; the robot stands up in 4 s
RUN_S: Final = 400.0  # an emulated runner warms up for 100 s
DEADMAN_S: Final = 1.5
REST_MPS: Final = 0.05
SOCKET: Final = "run/tic-vla-edge-proof/bridge.sock"


class DriveError(RuntimeError):
    """The drive did not come about; one line."""


def drive(root: Path, out: Path, domain: int) -> dict[str, Any]:
    """Arm, drive, go silent; returns what the robot did. Raises DriveError."""
    with _robot_and_bridge(root, out, domain, "--camera", "none") as (gate, trace):
        silent_ns = _command(root / SOCKET)
        rss_mb = _peak_rss_mb(gate.pid)
        time.sleep(DEADMAN_S)
    found = {**judge(trace.read_text(), silent_ns), "bridge_peak_rss_mb": rss_mb, "bridge_exit_code": gate.returncode}
    if not (found["at_rest"] and found["last_command_is_zero"] and gate.returncode == 0):
        raise DriveError(f"the drive did not end at rest with a zero and exit code 0: {found}")
    return found


def attempt_run(root: Path, out: Path, domain: int) -> dict[str, Any]:
    """Let `edge-run` start on an emulated processor that is too slow for it; returns how far it came, and its memory.

    It opens every graph and warms up. Then it refuses, or the bridge stops its late commands. Raises DriveError.
    """
    runner = ["chroot", str(root), f"{BIN}/edge-run", "--artifacts", f"{CURRENT}/artifacts", "--robot", ROBOT_FILE]
    runner += ["--domain", str(domain), "--socket", f"/{SOCKET}", "--instruction", "walk down the corridor"]
    runner += ["--duration", str(DRIVE_S)]
    with _robot_and_bridge(root, out, domain) as (gate, trace), (out / "run.log").open("w") as log:
        _wait_for(root / SOCKET)
        process = subprocess.Popen(runner, env=ENVIRONMENT, stdout=log, stderr=log)
        rss_mb = 0.0
        deadline_s = time.monotonic() + RUN_S
        while process.poll() is None and time.monotonic() < deadline_s:
            rss_mb = max(rss_mb, _peak_rss_mb(process.pid))
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        process.wait(30)
        bridge_mb = _peak_rss_mb(gate.pid)
    lines = [line for line in (out / "run.log").read_text().splitlines() if line.startswith("edge-run: ")]
    end = _end([json.loads(line) for line in trace.read_text().splitlines()])
    found = {
        "runner_exit_code": process.returncode,
        "runner_peak_rss_mb": rss_mb,
        "bridge_peak_rss_mb": bridge_mb,
        "last_command_is_zero": end["wire"]["last_command_zero"],
        "path_m": end["path_m"],
        "output": lines,
    }
    if process.returncode not in (EXIT_DONE, EXIT_CHECK_FAILED, EXIT_REFUSED) or not found["last_command_is_zero"]:
        raise DriveError(f"the run did not end by itself with a zero: {found}")
    return found


@contextlib.contextmanager
def _robot_and_bridge(
    root: Path, out: Path, domain: int, *robot_options: str
) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """Start the robot here and the bridge in the root; yields the bridge and the robot's trace, whole after the end."""
    trace, socket = out / "robot.jsonl", root / SOCKET
    socket.parent.mkdir(parents=True, exist_ok=True)
    socket.parent.chmod(0o700)
    hil = [sys.executable, "-m", "sim_hil.hil.command", "--robot", "go2", "--scene", "corridor"]
    hil += ["--protocol", "unitree", "--domain", str(domain), "--trace", str(trace), "--pose-hz", "50"]
    bridge = ["chroot", str(root), f"{BIN}/edge-bridge", "--robot", ROBOT_FILE]
    bridge += ["--domain", str(domain), "--socket", f"/{SOCKET}", "--latch", f"/{SOCKET}.latch"]
    with (out / "robot.log").open("w") as robot_log, (out / "bridge.log").open("w") as bridge_log:
        robot = subprocess.Popen([*hil, *robot_options], stdout=robot_log, stderr=robot_log)
        gate = subprocess.Popen(bridge, env=ENVIRONMENT, stdout=bridge_log, stderr=bridge_log)
        try:
            yield gate, trace
        finally:
            for process in (gate, robot):
                process.send_signal(signal.SIGINT)
                process.wait(30)


def judge(trace: str, silent_ns: int) -> dict[str, Any]:
    """Return what the simulated robot's trace says: metres walked, time from the last command to rest, last command."""
    records = [json.loads(line) for line in trace.splitlines()]
    end = _end(records)
    poses = [record for record in records if record["kind"] == "pose" and record["t_ns"] > silent_ns]
    if end["path_m"] < 0.5 or not poses:
        raise DriveError("the robot has not walked: see bridge.log and robot.log")
    speeds = [(pose["t_ns"], math.hypot(pose["vx"], pose["vy"])) for pose in poses]
    moving_ns = max((t_ns for t_ns, speed in speeds if speed >= REST_MPS), default=silent_ns)
    return {
        "path_m": end["path_m"],
        "commands": end["wire"]["commands"],
        "malformed": end["wire"]["malformed"],
        "silence_to_rest_ms": round((moving_ns - silent_ns) / 1e6, 1),
        "at_rest": moving_ns < speeds[-1][0],
        "last_command_is_zero": end["wire"]["last_command_zero"],
    }


def _end(records: list[dict[str, Any]]) -> dict[str, Any]:
    end = next((record for record in records if record["kind"] == "end"), None)
    if end is None:
        raise DriveError("the robot has not walked to its end: see robot.log")
    return end


def _command(socket: Path) -> int:
    """Arm and drive; returns the time of the last command, ns."""
    _wait_for(socket)
    client = BridgeClient(socket)
    seq, armed_s, asked_s, start_s = 0, None, -1.0, time.monotonic()
    while armed_s is None or time.monotonic() - armed_s < DRIVE_S:
        status = client.poll()
        if armed_s is None and status is not None and status.state == "armed":
            armed_s = time.monotonic()
        if armed_s is None and time.monotonic() - start_s > START_S:
            raise DriveError(f"the bridge did not arm within {START_S:g} s: {status}")
        if armed_s is None and time.monotonic() - asked_s >= 1.0:
            client.arm()
            asked_s = time.monotonic()
        seq += 1
        client.send_velocity(seq, time.monotonic_ns(), SPEED_MPS if armed_s is not None else 0.0, 0.0, 0.0)
        time.sleep(0.05)
    return time.monotonic_ns()


def _wait_for(socket: Path) -> None:
    deadline_s = time.monotonic() + START_S
    while not socket.exists():
        if time.monotonic() > deadline_s:
            raise DriveError(f"the bridge has not opened {socket} within {START_S:g} s")
        time.sleep(0.2)


def _peak_rss_mb(pid: int) -> float:
    """Largest memory of a process so far, the emulator's own included, MB; 0 once it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024, 1)
    return 0.0
