"""The parent's handle on the camera process (`videohub.py`)."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.core.config import DdsConfig
from sim_hil.protocols.snapshot import SnapshotWriter

_START_TIMEOUT_S: Final = 60.0
_END_TIMEOUT_S: Final = 3.0
_POLL_S: Final = 0.02


class CameraProcessError(RuntimeError):
    """The camera process did not start, died, or sent an invalid event."""


class CameraProcess:
    """Starts the camera process, hands it the pose, reads its events. It ends when this object or process does."""

    def __init__(
        self,
        scene: str,
        *,
        people: int,
        seed: int,
        size: tuple[int, int],
        dds: DdsConfig,
        state_length: int,
        faults: bool = False,
    ) -> None:
        """`size`: (width, height) in pixels; `state_length`: numbers in a render state; `faults`: take `tell`."""
        self._pose = SnapshotWriter(state_length)
        command = [sys.executable, "-m", "sim_hil.protocols.unitree.videohub", "--scene", scene]
        command += ["--people", str(people), "--seed", str(seed), "--width", str(size[0]), "--height", str(size[1])]
        command += ["--domain", str(dds.domain), "--interface", dds.interface, "--pose-fd", str(self._pose.fd)]
        for peer in dds.peers:
            command += ["--peer", peer]
        if faults:
            command += ["--faults"]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(self._pose.fd,)
            )
        except OSError:
            self._pose.close()
            raise
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._partial = b""

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Make this the state that the next frame is rendered from; takes microseconds."""
        self._pose.write(render_state)

    def tell(self, line: bytes) -> None:
        """Send a fault command to a camera started with `faults`; `events` detects a dead process."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()

    def wait_ready(self, stop: Sequence[int]) -> bool:
        """Wait until the service answers; False when something appears in `stop` first. Raises CameraProcessError."""
        deadline_ns = time.monotonic_ns() + int(_START_TIMEOUT_S * 1e9)
        while not any(event["event"] == "ready" for event in self.events()):
            if stop:
                return False
            if time.monotonic_ns() > deadline_ns:
                raise CameraProcessError(f"the camera process was not ready within {_START_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)
        return True

    def events(self) -> list[dict[str, object]]:
        """What the camera process has reported since the last look. Raises CameraProcessError."""
        assert self._process.stdout is not None
        data = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                chunk = os.read(self._process.stdout.fileno(), 65536)
                if not chunk:
                    with contextlib.suppress(subprocess.TimeoutExpired):  # it hung up and lives on: close() kills it
                        self._process.wait(_END_TIMEOUT_S)
                    raise CameraProcessError(f"the camera process {self._fate()}; see its output above")
                data += chunk
        *lines, self._partial = (self._partial + data).split(b"\n")
        return [_event(line) for line in lines]

    def _fate(self) -> str:
        code = self._process.returncode
        return "closed its output but still runs" if code is None else f"died (exit status {code})"

    def close(self) -> None:
        """End the process; killed if it does not end by itself."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._pose.close()


def _event(line: bytes) -> dict[str, object]:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        event = None
    if not isinstance(event, dict) or not isinstance(event.get("event"), str):
        raise CameraProcessError(f"the camera process: expected an event as a line of JSON, found {line[:60]!r}")
    return event
