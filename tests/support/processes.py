"""Start this project's commands as real processes, wait until they say "ready", end exactly those again.

And know how long the machine itself stood still, for tests of a real-time promise on a shared one.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.flightlog.recorder import space_refusal
from sim_hil.realtime.host_stall import HostStall
from sim_hil.realtime.robots import free_domain

REPOSITORY = Path(__file__).resolve().parents[2]
GO2_SIM = REPOSITORY / "firmware_bridge" / "robots" / "go2_sim.toml"
_READY_TIMEOUT_S = 40.0


class Running:
    """A started command: its process, and what it has said on stderr so far."""

    def __init__(self, process: subprocess.Popen[bytes], stderr: Path) -> None:
        self.process = process
        self._stderr = stderr

    @property
    def pid(self) -> int:
        return self.process.pid

    def stderr(self) -> str:
        return self._stderr.read_text()

    def end(self, timeout_s: float = 10.0) -> int:
        """SIGTERM, then the exit status."""
        self.process.terminate()
        return self.process.wait(timeout_s)


@contextlib.contextmanager
def running(
    module: str, *arguments: object, folder: Path, ready: str = "ready", python: str = sys.executable
) -> Iterator[Running]:
    """`python -m module arguments...`, from the moment its stderr contains `ready` to the end of the block."""
    stderr = folder / f"{module}.stderr"
    with stderr.open("wb") as file:
        command = [python, "-m", module, *map(str, arguments)]
        # As a terminal starts it: under nohup it would inherit that SIGHUP is ignored, and keep it so.
        hangup = signal.signal(signal.SIGHUP, signal.SIG_DFL)
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=file, cwd=REPOSITORY)
        signal.signal(signal.SIGHUP, hangup)
    started = Running(process, stderr)
    try:
        try:
            wait_for(lambda: ready in started.stderr() or process.poll() is not None, _READY_TIMEOUT_S, module)
        except AssertionError as error:
            raise AssertionError(f"{error}; it has said: {started.stderr()}") from error
        assert process.poll() is None, f"{module} ended with {process.returncode}: {started.stderr()}"
        yield started
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextlib.contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[bool]:
    """Hold the lock file `path` until the end of the block or of this process; gives False if another has it."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError:  # another user's file
        yield False
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def claimed_dds_domain() -> Iterator[int]:
    """DDS domain that no other worker and no other test run on this machine uses; its ports stay below 32768."""
    first = free_domain()
    for domain in (1 + (first - 1 + i) % 90 for i in range(90)):
        lock = Path(tempfile.gettempdir()) / f"tic-vla-edge-tests-dds-{domain}.lock"
        with locked(lock, wait=False) as held:
            if held:
                yield domain
                return
    raise RuntimeError("other test runs use all DDS domains from 1 to 90: end one of them")


def need_room_to_record(folder: Path) -> None:
    """Skip where so little of the disk is free that a robot which records would rightly not be armed."""
    refusal = space_refusal(folder / "flight.mcap")
    if refusal is not None:
        pytest.skip(refusal)


def check_stop_latency(latency_ns: int, bound_ns: int, since_ns: int, host: HostStall) -> None:
    """Assert the bound, plus only what this machine itself stood still since `since_ns` until the stop."""
    stall_ns = host.between_ns(since_ns, since_ns + latency_ns)
    assert latency_ns <= bound_ns + stall_ns, (
        f"zero velocity after {latency_ns / 1e6:.1f} ms; allowed: {bound_ns / 1e6:.0f} ms and the {stall_ns / 1e6:.1f}"
        " ms for which a sleeping thread of the test itself was woken too late in the same window"
    )


def wait_for(condition, timeout_s: float, what: str) -> None:
    """Poll until `condition()`; fails the test after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"timed out waiting for: {what}"
        time.sleep(0.01)


def hil_arguments(domain: int, *more: object) -> tuple[object, ...]:
    """Arguments of an `edge-hil` in the corridor without people."""
    return ("--robot", "go2", "--scene", "corridor", "--protocol", "unitree", "--domain", domain, *more)


def read_trace(path: Path) -> list[dict]:
    """Whole lines of an edge-hil trace, ended or not."""
    lines = path.read_text().split("\n")[:-1]
    return [json.loads(line) for line in lines]
