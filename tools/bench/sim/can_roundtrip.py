"""How fast the simulated base answers on CAN, from a process of its own.

    edge-hil --robot carter --protocol can --scene corridor --link serial:carter-can      # in another terminal
    python -m tools.bench.sim.can_roundtrip --channel carter-can --rounds 300 --json out/bench/can_roundtrip.json

A round: the time from sending EstopControl until EstopState reports it; stop and reset in turn. Then the odometry's
rate and the gaps between its samples over 10 s, and with --camera URL the time for a picture. All samples are kept.
"""

from __future__ import annotations

import argparse
import sys
import time
import urllib.request
from itertools import pairwise
from typing import Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.stats import percentiles
from sim_hil.protocols.can.buses import INTERFACES, BusAddress, BusError, BusLink, open_bus
from sim_hil.protocols.can.client import CanClient

_TIMEOUT_NS: Final = 2_000_000_000
_PAUSE_S: Final = 0.02  # between rounds, and longer than an event counts as the same one
_LISTEN_S: Final = 10.0


def rounds_ms(client: CanClient, count: int) -> list[float]:
    """Times of `count` rounds. Raises RuntimeError when an answer does not come within 2 s."""
    client.spin(0.5)
    samples = []
    for number in range(count):
        latched = number % 2 == 0
        sent_ns = time.monotonic_ns()
        (client.stop if latched else client.reset)()
        while client.latest("EstopState").get("Latched") != float(latched):
            if time.monotonic_ns() - sent_ns > _TIMEOUT_NS:
                raise RuntimeError(f"round {number}: expected EstopState within 2 s, found none; is a base on the bus?")
            client.wait(1_000_000)
            client.poll()
        samples.append((time.monotonic_ns() - sent_ns) / 1e6)
        client.spin(_PAUSE_S)
    return samples


def odometry_gaps_ms(client: CanClient, seconds: float) -> list[float]:
    """Gaps between arrivals of odometry samples."""
    client.odometry.clear()
    arrivals: list[int] = []
    end_ns = time.monotonic_ns() + round(seconds * 1e9)
    while time.monotonic_ns() < end_ns:
        client.wait(5_000_000)
        before = len(client.odometry)
        client.poll()
        arrivals += [time.monotonic_ns()] * (len(client.odometry) - before)
    return [(later - earlier) / 1e6 for earlier, later in pairwise(arrivals)]


def pictures_ms(url: str, count: int) -> list[float]:
    """Times to fetch a new picture."""
    samples = []
    for _ in range(count):
        begin_ns = time.monotonic_ns()
        with urllib.request.urlopen(url, timeout=10) as response:
            response.read()
        samples.append((time.monotonic_ns() - begin_ns) / 1e6)
        time.sleep(0.1)  # slower than the camera's rate: not its period is measured
    return samples


def summary(samples: list[float]) -> dict[str, float | int | None]:
    """Count, median, p99 and maximum."""
    return {"count": len(samples), **percentiles(samples, "p50", "p99", "max")}


@command_line("can_roundtrip")
def main(argv: list[str] | None = None) -> int:
    """Command line; 1 when the base does not answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--interface", choices=INTERFACES, default="serial", help="of python-can (default serial)")
    parser.add_argument("--channel", required=True, help="path of the serial line, or the interface's channel")
    parser.add_argument("--rounds", type=int, default=300, metavar="N", help="default 300")
    parser.add_argument("--camera", metavar="URL", help="of a picture, such as http://127.0.0.1:8090/frame.jpg")
    parser.add_argument("--json", metavar="FILE|-", help="write summary and samples as JSON")
    args = parser.parse_args(argv)
    try:
        check_result_target(args.json)
        client = CanClient(BusLink(open_bus(BusAddress(args.interface, args.channel))))
    except (ValueError, OSError, BusError) as error:
        sys.stderr.write(f"can_roundtrip: {error}\n")
        return EXIT_BAD_INPUT
    try:
        samples = {"estop_round_ms": rounds_ms(client, args.rounds)}
        samples["odometry_gap_ms"] = odometry_gaps_ms(client, _LISTEN_S)
        if args.camera:
            samples["picture_ms"] = pictures_ms(args.camera, 50)
    except (RuntimeError, OSError) as error:
        sys.stderr.write(f"can_roundtrip: {error}\n")
        return EXIT_CHECK_FAILED
    finally:
        client.close()
    result = {name: summary(values) for name, values in samples.items()}
    for name, row in result.items():
        sys.stderr.write(f"{name}: {row}\n")
    write_result(args.json, {**result, "samples": samples})
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
