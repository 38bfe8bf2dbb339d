"""Scripted session with a Carter on CAN: arm, drive, stop, print the odometry."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from typing import Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_target,
    command_line,
    write_result,
)
from firmware_bridge.can.buses import BusAddress, BusError, open_bus
from firmware_bridge.core.config_can import INTERFACES
from firmware_bridge.system.terminal import CommandParser
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.client import CanClient, Odometry

_ANSWER_S: Final = 3.0
_REPORT_S: Final = 0.5

EPILOG: Final = """examples, beside `edge-hil --robot carter --protocol can --scene corridor --link serial:carter-can`:
  python -m sim_hil.protocols.can.drive --channel carter-can --vx 0.5 --duration 5
  python -m sim_hil.protocols.can.drive --interface socketcan --channel can0 --vx 0 --wz 0.5 --duration 3 --json -
exit codes: 0 driven and stopped; 1 the base did not answer, arm or stop; 2 bad arguments or no such bus; 130
interrupted, zero velocity and a disarm request were sent"""


class DriveError(RuntimeError):
    """Unexpected behaviour of the base; one line."""


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m sim_hil.protocols.can.drive",
        description="Arm a Carter over CAN, drive it for a while, stop it.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--interface", choices=INTERFACES, default="serial", help="interface of python-can (default serial)"
    )
    parser.add_argument("--channel", required=True, help="path of the serial line, or the interface's channel")
    parser.add_argument("--vx", type=float, default=0.3, metavar="MPS", help="forward speed (default 0.3)")
    parser.add_argument("--wz", type=float, default=0.0, metavar="RADPS", help="turning speed (default 0)")
    parser.add_argument("--duration", type=float, default=3.0, metavar="S", help="driving time (default 3)")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return parser


def _wait_for_state(client: CanClient, state: int, name: str, hint: str) -> None:
    for _ in range(round(_ANSWER_S / 0.1)):
        if client.state == state:
            return
        client.spin(0.1)
    found = "no answer" if client.state is None else f"state {client.state}"
    raise DriveError(f"expected the base to be {name} within {_ANSWER_S:g} s, found {found}; {hint}")


def _print_odometry(client: CanClient) -> None:
    if client.odometry:
        last = client.odometry[-1]
        sys.stderr.write(
            f"{last.stamp_s:8.2f} s  x {last.x_m:+.3f} m  y {last.y_m:+.3f} m  "
            f"heading {math.degrees(last.heading_rad):+.1f} deg  {last.vx_mps:+.2f} m/s\n"
        )


def drive(client: CanClient, vx_mps: float, wz_radps: float, duration_s: float) -> dict[str, object]:
    """Run the session and return the result for --json. Raises DriveError or BusError."""
    client.spin(0.5)
    if client.state == frames.STATE_ESTOP:
        raise DriveError("expected no emergency stop, found it latched; release the button and send a reset")
    client.arm()
    _wait_for_state(client, frames.STATE_ARMED, "armed", "check the bus and that the battery is above 10 %")
    before = len(client.odometry)
    left_s = duration_s
    while left_s > 0:
        client.spin(min(_REPORT_S, left_s), vx_mps, wz_radps)
        left_s -= _REPORT_S
        _print_odometry(client)
    driven = client.odometry[before:]
    client.spin(1.5, 0.0)
    client.disarm()
    _wait_for_state(client, frames.STATE_IDLE, "disarmed", "it may still be moving")
    _print_odometry(client)
    return _result(client, driven)


def _result(client: CanClient, driven: list[Odometry]) -> dict[str, object]:
    if len(driven) < 2 or not client.odometry:
        raise DriveError("expected odometry every 20 ms, found none; check for another controller on the bus")
    first, last, end = driven[0], driven[-1], client.odometry[-1]
    battery, faults = client.latest("Battery"), client.latest("Faults")
    return {
        "duration_s": round(last.stamp_s - first.stamp_s, 3),
        "moved_m": round(math.hypot(end.x_m - first.x_m, end.y_m - first.y_m), 3),
        "turned_rad": round(math.remainder(end.heading_rad - first.heading_rad, math.tau), 4),
        "end_speed_mps": round(end.vx_mps, 3),
        "odometry_hz": round((len(driven) - 1) / (last.stamp_s - first.stamp_s), 2),
        "battery_percent": battery.get("Charge"),
        "base_counted": {key: faults.get(key) for key in ("CrcErrors", "CounterErrors", "LostFrames", "BusOffs")},
        "lost": client.lost,
    }


@command_line("drive")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code (see EPILOG)."""
    args = _parser().parse_args(argv)
    try:
        if not all(map(math.isfinite, (args.vx, args.wz, args.duration))) or args.duration <= 0:
            raise ValueError("--vx, --wz, --duration: expected finite numbers and a duration above 0 s")
        check_result_target(args.json)
        client = CanClient(BusLink(open_bus(BusAddress(args.interface, args.channel))))
    except (ValueError, OSError, BusError) as error:
        sys.stderr.write(f"drive: {error}\n")
        return EXIT_BAD_INPUT
    try:
        result = drive(client, args.vx, args.wz, args.duration)
        write_result(args.json, result)
    except KeyboardInterrupt:
        sys.stderr.write("drive: interrupted; sending zero velocity and a disarm request\n")
        with contextlib.suppress(BusError, OSError):
            client.drive(0.0, 0.0)
            client.disarm()
        return EXIT_INTERRUPTED
    except (DriveError, BusError, OSError) as error:
        sys.stderr.write(f"drive: {error}\n")
        return EXIT_CHECK_FAILED
    finally:
        client.close()
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
