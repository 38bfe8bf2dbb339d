"""Runs `edge-hil --protocol mavlink` with another project's client and collects the results of both."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.processes import REPOSITORY, read_trace

SESSIONS = REPOSITORY / "tools" / "interop"


@dataclass(frozen=True)
class Session:
    """The client's JSON, the simulator's result and its trace."""

    seen: dict[str, Any]
    hil: dict[str, Any]
    trace: list[dict[str, Any]]


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def run_session(folder: Path, client: list[str], *more: str, after_s: float = 0.0) -> Session:
    """`client` is run with the UDP port that the rover calls and `more`; the simulator goes on `after_s` longer."""
    called = free_udp_port()
    hil_file, trace_file = folder / "hil.json", folder / "hil.jsonl"
    options = ["--robot", "carter", "--protocol", "mavlink", "--scene", "corridor", "--camera", "none"]
    command = [sys.executable, "-m", "sim_hil.hil.command", *options]
    command += ["--link", f"udp:127.0.0.1:0,to=127.0.0.1:{called}", "--json", str(hil_file), "--trace", str(trace_file)]
    hil = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY)
    try:
        assert hil.stderr is not None
        assert any("ready, MAVLink udp:127.0.0.1:" in line for line in hil.stderr)
        done = subprocess.run(
            [*client, str(called), *more],
            capture_output=True,
            text=True,
            timeout=120,
            cwd=folder,
            env={key: value for key, value in os.environ.items() if not key.startswith("MAV")},
            check=False,
        )
        assert done.returncode == 0, done.stderr + done.stdout
        time.sleep(after_s)
    finally:
        hil.send_signal(signal.SIGINT)
        hil.wait(30)
    sys.stdout.write(done.stdout)  # for `pytest -s`
    seen = json.loads(done.stdout.splitlines()[-1])
    return Session(seen, json.loads(hil_file.read_text(encoding="utf-8")), list(read_trace(trace_file)))
