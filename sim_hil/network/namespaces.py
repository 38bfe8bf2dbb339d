"""Two commands in separate network namespaces, connected only by one impaired cable.

This is for protocols that cannot be relayed by address, such as DDS, which uses multicast discovery and dynamic ports.
It needs root. The machine's own network is not changed, because the relay also runs in its own namespace.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

from sim_hil.network.config import LinkConfig, NetworkConfig, NetworkError
from sim_hil.network.side import INTERFACE

# Addresses of a Go2 and of a companion computer.
ADDRESSES: Final = ("192.168.123.161/24", "192.168.123.99/24")
_OURS: Final = ("left0", "right0")
_END_S: Final = 10.0


class Sides:
    """The two commands, which wait for their cable until `connect`."""

    def __init__(self, commands: tuple[list[str], list[str]]) -> None:
        """Start the commands (left, right). Raises OSError without the permissions."""
        self._processes: list[subprocess.Popen[bytes]] = []
        try:
            for address, ours, command in zip(ADDRESSES, _OURS, commands, strict=True):
                self._processes.append(self._start(address, command))
                self._lay(ours, self._processes[-1].pid)
        except BaseException:
            self.end()
            raise

    def _start(self, address: str, command: list[str]) -> subprocess.Popen[bytes]:
        side = [sys.executable, "-m", "sim_hil.network.side", address, *command]
        process = subprocess.Popen(["unshare", "--net", "--", *side], stdin=subprocess.PIPE)
        deadline = time.monotonic() + _END_S
        while _namespace(process.pid) == _namespace("self"):  # unshare has not created the namespace yet
            if process.poll() is not None or time.monotonic() > deadline:
                raise OSError("unshare --net: expected a new network namespace; it needs root")
            time.sleep(0.01)
        return process

    def _lay(self, ours: str, pid: int) -> None:
        for arguments in (
            ["link", "add", ours, "type", "veth", "peer", "name", INTERFACE, "netns", str(pid)],
            ["link", "set", ours, "up"],
        ):
            done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
            if done.returncode:
                raise OSError(f"ip {' '.join(arguments)}: {' '.join(done.stderr.split())}")

    def connect(self) -> None:
        """Start both commands; the relay must be running."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write(b"go\n")
            process.stdin.close()

    def right_code(self) -> int | None:
        """Return the exit status of the right command; None while it runs."""
        return self._processes[-1].poll()

    def end(self) -> None:
        """End both commands by SIGTERM, and by SIGKILL after a timeout."""
        for process in self._processes:
            if process.poll() is None:
                process.terminate()
        for process in self._processes:
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def check_rights() -> None:
    """Check that namespaces and cables can be created. Raises OSError with one line."""
    for program, package in (("unshare", "util-linux"), ("ip", "iproute2")):
        if shutil.which(program) is None:
            raise OSError(f"between: expected the program {program} on the PATH; install {package}")
    probe = subprocess.run(["unshare", "--net", "--", "true"], capture_output=True, text=True, check=False)
    if probe.returncode:
        raise OSError(
            f"between: expected permission for network namespaces, run as root: {' '.join(probe.stderr.split())}"
        )


def cable(config: NetworkConfig) -> NetworkConfig:
    """Return the configuration with its only link placed between the two namespaces. Raises NetworkError."""
    if len(config.links) != 1 or config.links[0].kind != "frames":
        raise NetworkError("between: expected exactly one link of kind frames (its left and right are ignored)")
    link: LinkConfig = replace(config.links[0], left=_OURS[0], right=_OURS[1])
    return replace(config, links=(link,))


def _namespace(pid: int | str) -> str:
    try:
        return str(Path(f"/proc/{pid}/ns/net").readlink())
    except OSError:
        return ""
