"""A scripted client drives the simulated Go2 through a bridge in the arm64 root; the robot's own trace is the judge."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

from firmware_bridge.client import BridgeClient
from tools.board.journey import BIN, ROBOT_FILE

SPEED_MPS: Final = 0.4
DRIVE_S: Final = 6.0
START_S: Final = 90.0  # an emulated bridge imports for 10 s; the robot stands up in 4 s
DEADMAN_S: Final = 1.5
REST_MPS: Final = 0.05
SOCKET: Final = "run/tic-vla-edge-proof/bridge.sock"


class DriveError(RuntimeError):
    """The drive did not come about; one line."""


def drive(root: Path, out: Path, domain: int) -> dict[str, Any]:
    """Arm, drive, go silent; returns what the robot did. Raises DriveError."""
    trace, socket = out / "robot.jsonl", root / SOCKET
    socket.parent.mkdir(parents=True, exist_ok=True)
    socket.parent.chmod(0o700)
    hil = [
        sys.executable,
        "-m",
        "sim_hil.hil.command",
        "--robot",
        "go2",
        "--scene",
        "corridor",
        "--protocol",
        "unitree",
    ]
    hil += ["--domain", str(domain), "--camera", "none", "--trace", str(trace), "--pose-hz", "50"]
    bridge = ["chroot", str(root), f"{BIN}/edge-bridge", "--robot", ROBOT_FILE]
    bridge += ["--domain", str(domain), "--socket", f"/{SOCKET}", "--latch", f"/{SOCKET}.latch"]
    with (out / "robot.log").open("w") as robot_log, (out / "bridge.log").open("w") as bridge_log:
        robot = subprocess.Popen(hil, stdout=robot_log, stderr=robot_log)
        gate = subprocess.Popen(bridge, stdout=bridge_log, stderr=bridge_log)
        try:
            silent_ns = _command(socket)
            rss_mb = _rss_mb(gate.pid)
            time.sleep(DEADMAN_S)
        finally:
            for process in (gate, robot):
                process.send_signal(signal.SIGINT)
                process.wait(30)
    found = {**judge(trace.read_text(), silent_ns), "bridge_rss_mb": rss_mb, "bridge_exit_code": gate.returncode}
    if not (found["at_rest"] and found["last_command_is_zero"] and gate.returncode == 0):
        raise DriveError(f"the drive did not end at rest with a zero and exit code 0: {found}")
    return found


def judge(trace: str, silent_ns: int) -> dict[str, Any]:
    """Return what the simulated robot's trace says: metres walked, time from the last command to rest, last command."""
    records = [json.loads(line) for line in trace.splitlines()]
    end = next((record for record in records if record["kind"] == "end"), None)
    poses = [record for record in records if record["kind"] == "pose" and record["t_ns"] > silent_ns]
    if end is None or end["path_m"] < 0.5 or not poses:
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


def _command(socket: Path) -> int:
    """Arm and drive; returns the time of the last command, ns."""
    client = _connect(socket)
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


def _connect(socket: Path) -> BridgeClient:
    deadline_s = time.monotonic() + START_S
    while not socket.exists():
        if time.monotonic() > deadline_s:
            raise DriveError(f"the bridge has not opened {socket} within {START_S:g} s")
        time.sleep(0.2)
    return BridgeClient(socket)


def _rss_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return round(int(line.split()[1]) / 1024, 1)
    return 0.0
