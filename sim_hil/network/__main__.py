"""`python -m sim_hil.network`: command line of the network shim."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_target,
    command_line,
    stop_signals,
    write_result,
)
from sim_hil.network.config import KINDS, NetworkConfig, NetworkError, load_network
from sim_hil.network.namespaces import Sides, cable, check_rights
from sim_hil.network.relay import Relay

_INSIDE: Final = "SIM_HIL_NETWORK_INSIDE"

EPILOG: Final = """links.toml:
  seed = 1
  [[links]]
  name = "telemetry"
  kind = "udp"                   # {kinds}
  left = "127.0.0.1:14550"
  right = "127.0.0.1:14540"
  impairment = {{ loss_percent = 5, delay_ms = 40, jitter_ms = 10 }}   # both directions
  back = {{ partitions = [[10, 12.5]] }}                               # right to left only, in addition
  keys: loss_percent loss_burst delay_ms jitter_ms duplicate_percent reorder_percent reorder_ms rate_kbps queue_bytes
  partitions
examples:
  python -m sim_hil.network run links.toml --duration 60 --json -
  python -m sim_hil.network run links.toml --control net.sock
  python -m sim_hil.network between cable.toml --left "edge-hil --robot go2 --scene corridor --protocol unitree
    --interface eth0" --right "edge-run --robot robot.toml ..."
with --control, a datagram with one JSON object changes a link: {{"link": "telemetry", "cut": true}}, or {{"link": "*",
"there": {{"loss_percent": 30}}}}; the answer contains the time at which it took effect
between: left is 192.168.123.161, right is .99, both on eth0 in separate network namespaces (needs root); it ends when
the right command ends, and then ends the left one
exit codes: 0 done (also after SIGTERM), of `between` the right command's own (128 + N if signal N ended it); 1 the
relay failed or the result could not be written; 2 bad input, or no permission for addresses, interfaces or namespaces;
130 interrupted (SIGINT), the result is still written"""


def _parser() -> argparse.ArgumentParser:
    kinds = "\n                                 # ".join(f"{kind}: {says}" for kind, says in KINDS.items())
    parser = argparse.ArgumentParser(
        prog="python -m sim_hil.network",
        description="Relay the packets of other programs over links with the impairments of a file.",
        epilog=EPILOG.format(kinds=kinds),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="relay packets until a signal or --duration")
    between = commands.add_parser("between", help="run two commands with one impaired cable between them")
    for sub in (run, between):
        sub.add_argument("config", type=Path, metavar="LINKS.toml")
        sub.add_argument("--duration", type=float, metavar="S", help="end after S seconds")
        sub.add_argument("--control", type=Path, metavar="PATH", help="accept changes at this local datagram socket")
        sub.add_argument("--json", metavar="FILE|-", help="write the packet counts as JSON")
    for side in ("left", "right"):
        between.add_argument(
            f"--{side}", required=True, metavar="COMMAND", help="command as one text, split as in a shell"
        )
    return parser


@command_line("network")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code (see EPILOG)."""
    args = _parser().parse_args(argv)
    try:
        config = load_network(args.config)
        check_result_target(args.json)
        if args.duration is not None and not 0 < args.duration < float("inf"):
            raise NetworkError(f"--duration: expected seconds above 0, found {args.duration}")
        if args.command == "between":
            return _between(args, cable(config), argv)
        with stop_signals() as stop:
            relay = Relay(config, control=args.control)
            sys.stderr.write(f"network: ready, {', '.join(link.name for link in config.links)}\n")
            sys.stderr.flush()
            with contextlib.closing(relay):
                return _write_summary(args, relay, _relay_until(relay, stop, lambda: None, args.duration))
    except KeyboardInterrupt:  # before the signal handlers are installed
        return EXIT_INTERRUPTED
    except (ValueError, OSError, subprocess.SubprocessError) as error:  # ValueError: invalid host names
        return _report_error(error, EXIT_BAD_INPUT)


def _between(args: argparse.Namespace, config: NetworkConfig, argv: list[str] | None) -> int:
    commands = (_command("--left", args.left), _command("--right", args.right))
    if os.environ.get(_INSIDE) is None:
        check_rights()
        # Start again in a new namespace: the cable's ends must not appear on the machine's network.
        command = [sys.executable, "-m", "sim_hil.network", *(sys.argv[1:] if argv is None else argv)]
        with stop_signals() as stop:
            inside = subprocess.Popen(["unshare", "--net", "--", *command], env={**os.environ, _INSIDE: "1"})
            while inside.poll() is None:
                time.sleep(0.05)
                if stop:
                    inside.send_signal(stop.pop())
        return _code(inside.returncode)
    environment = os.environ.pop(_INSIDE)
    assert environment
    with stop_signals() as stop:
        sides = Sides(commands)
        with contextlib.ExitStack() as ends:
            ends.callback(sides.end)
            relay = ends.enter_context(contextlib.closing(Relay(config, control=args.control)))
            sides.connect()
            code = _relay_until(relay, stop, sides.right_code, args.duration)
    return _write_summary(args, relay, code)


def _command(option: str, text: str) -> list[str]:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise NetworkError(f"{option}: expected a valid shell command, {error}: {text!r}") from error
    if not words:
        raise NetworkError(f"{option}: expected a command, found an empty text")
    return words


def _relay_until(relay: Relay, stop: list[int], ended: Callable[[], int | None], duration_s: float | None) -> int:
    """Relay packets until a signal, `duration_s`, or until `ended` returns an exit status; return the exit code."""
    try:
        relay.run(lambda: bool(stop) or ended() is not None, duration_s)
    except OSError as error:
        return _report_error(f"the relay failed: {error}", EXIT_CHECK_FAILED)
    if signal.SIGINT in stop:
        return EXIT_INTERRUPTED
    code = ended()
    return EXIT_DONE if code is None else _code(code)


def _code(status: int) -> int:
    """Convert the exit status of a process to a shell's exit code."""
    return 128 - status if status < 0 else status


def _write_summary(args: argparse.Namespace, relay: Relay, code: int) -> int:
    write_result(args.json, relay.summary())
    return code


def _report_error(message: object, code: int) -> int:
    sys.stderr.write(f"network: {message}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
