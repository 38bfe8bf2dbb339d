"""Example policy server for `edge-bench --policy external:ADDR`.

The example drives towards the brighter half of the image. Replace `Walker` with your own policy.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socketserver
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from firmware_bridge.system.terminal import CommandParser
from sim_hil.benchmark.policies.external_protocol import (
    PROTOCOL,
    VERSION,
    Address,
    Channel,
    ExternalError,
    decode_image,
    numbers,
    text,
)

EXAMPLES = """examples:
  python -m sim_hil.benchmark.external_example --listen 127.0.0.1:7001
  edge-bench --suite dynanav --policy external:127.0.0.1:7001 --latency 1 --out out/example

Each connection runs one episode at a time: --jobs N opens N connections. docs/benchmark.md describes the protocol.
exit codes: 0 ended by a signal, 2 bad arguments or input
"""
WIDTH, HEIGHT, ENCODING = 160, 90, "jpeg"


class Walker:
    """Example policy: drive forward at a fixed speed and turn to the brighter side."""

    def __init__(self, instruction: str, max_speed_mps: float) -> None:
        self._instruction = instruction
        self._speed_mps = min(0.4, max_speed_mps)

    def act(self, picture: npt.NDArray[np.uint8], state: Sequence[float]) -> tuple[list[float], str]:
        """Return velocity (vx m/s, vy m/s, wz rad/s) and a text for the log."""
        ahead = picture[picture.shape[0] // 3 :].astype(np.float64).mean(axis=(0, 2))
        left, right = ahead[: len(ahead) // 2].mean(), ahead[len(ahead) // 2 :].mean()
        turn = float(np.clip((left - right) / 40.0, -0.5, 0.5))
        return [self._speed_mps, 0.0, turn], f"{self._instruction}: {'left' if turn > 0 else 'right'} is brighter"


class _Handler(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        channel = Channel(self.request, "edge-bench")
        try:
            _serve(channel)
        except ExternalError as error:
            with contextlib.suppress(ExternalError):
                channel.send({"type": "error", "message": str(error)[:300]})
            sys.stderr.write(f"external_example: {error}\n")


def _serve(channel: Channel) -> None:
    hello = channel.receive("hello").header
    if hello.get("protocol") != PROTOCOL or hello.get("version") != VERSION:
        raise ExternalError(f"expected {PROTOCOL} version {VERSION}, found {hello.get('version')!r}"[:200])
    image = {"width": WIDTH, "height": HEIGHT, "encoding": ENCODING}
    channel.send({"type": "welcome", "protocol": PROTOCOL, "version": VERSION, "name": "walker", "image": image})
    walker: Walker | None = None
    while (message := channel.receive("reset", "observe", "bye")).kind != "bye":
        header = message.header
        if message.kind == "reset":
            walker = Walker(text(header, "instruction", channel.peer), _max_speed(header))
            channel.send({"type": "ready"})
        elif walker is None:
            raise ExternalError("observe arrived before reset")
        else:
            picture = decode_image(message.payload, ENCODING, WIDTH, HEIGHT)
            velocity, explanation = walker.act(picture, numbers(header, "state", 3, channel.peer))
            channel.send({"type": "act", "step": header.get("step"), "velocity": velocity, "text": explanation})


def _max_speed(header: Any) -> float:
    limits = header.get("limits")
    if not isinstance(limits, dict):
        raise ExternalError("reset without limits")
    return numbers({"speed": [limits.get("vx_max_mps")]}, "speed", 1, "edge-bench")[0]


class _TcpServer(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


class _UnixServer(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True


def server(address: Address) -> socketserver.BaseServer:
    """Return a server that listens at `address`; `serve_forever` answers requests. Raises OSError."""
    if address.path:
        return _UnixServer(address.path, _Handler)
    return _TcpServer((address.host, address.port), _Handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        prog="python -m sim_hil.benchmark.external_example",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--listen", required=True, metavar="ADDR", help="HOST:PORT or unix:PATH")
    args = parser.parse_args(argv)
    try:
        address = Address.parse(args.listen)
        listening = server(address)
    except (ExternalError, OSError) as error:
        sys.stderr.write(f"external_example: --listen {args.listen}: {error}\n")
        return EXIT_BAD_INPUT
    sys.stderr.write(f"external_example: ready, {address}\n")
    sys.stderr.flush()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        listening.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        pass
    finally:
        listening.server_close()
        if address.path:
            Path(address.path).unlink(missing_ok=True)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
