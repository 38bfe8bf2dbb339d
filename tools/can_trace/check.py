"""Judge a CAN trace with cantools: every CRC and every counter, and every cyclic message present.

    python -m tools.can_trace.check out/can/trace.log --duration 600

It imports nothing of this project: the CRC is computed bit by bit as the comment of the DBC file describes it, and
counters come from cantools. A trace is a text file of candump's format, "(STAMP) CHANNEL ID#DATA".
Exit codes: 0 no error; 1 errors, too short, or a message is missing; 2 bad arguments or unreadable files.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import cantools
from cantools.database.can import Database, Message

LINE = re.compile(r"\((\d+\.\d+)\) \S+ ([0-9A-Fa-f]{3})#((?:[0-9A-Fa-f]{2}){0,8})(?: [RT])?")
COUNTER_PERIOD = 16
DEFAULT_DBC = Path(__file__).resolve().parents[2] / "firmware_bridge" / "robots" / "carter.dbc"
MIN_SHARE = 0.5
"""Share of its nominal frames that a cyclic message must have: a busy computer is late, commands begin on arming."""


def crc8_j1850(data: Iterable[int]) -> int:
    """Compute CRC-8 SAE J1850 bit by bit: polynomial 0x1D, start 0xFF, final XOR 0xFF."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1 & 0xFF
    return crc ^ 0xFF


def messages_of(dbc: Path) -> dict[int, Message]:
    """Return the messages of a DBC file by identifier. Raises ValueError or OSError."""
    database = cantools.database.load_file(dbc)
    if not isinstance(database, Database):
        raise ValueError(f"{dbc}: expected a DBC file of a CAN bus")
    return {message.frame_id: message for message in database.messages}


def values_of(message: Message, data: bytes) -> dict[str, float]:
    """Decode a frame of the right length into physical values by signal."""
    decoded = message.decode(data, decode_choices=False)
    assert isinstance(decoded, dict)
    return {name: float(value) for name, value in decoded.items() if isinstance(value, (int, float))}


def is_in_range(message: Message, values: dict[str, float]) -> bool:
    """Return whether every value is in its signal's range."""
    return all(
        (signal.minimum is None or signal.minimum <= values[signal.name])
        and (signal.maximum is None or values[signal.name] <= signal.maximum)
        for signal in message.signals
    )


def judge(lines: Iterable[str], dbc: Path) -> dict[str, object]:
    """Return the counts of one trace. Raises ValueError for a line that is no frame, OSError for the DBC file."""
    messages = messages_of(dbc)
    counters: dict[int, int] = {}
    frames: Counter[str] = Counter()
    wrong: Counter[str] = Counter({"crc": 0, "counter": 0, "length": 0, "unknown": 0, "out_of_range": 0})
    first = last = None
    moving = 0
    for number, line in enumerate(lines, start=1):
        found = LINE.fullmatch(line.strip())
        if found is None:
            raise ValueError(f"line {number}: expected (STAMP) CHANNEL ID#DATA, found {line.strip()[:60]!r}")
        stamp, identifier, data = float(found[1]), int(found[2], 16), bytes.fromhex(found[3])
        first, last = stamp if first is None else first, stamp
        message = messages.get(identifier)
        if message is None:
            wrong["unknown"] += 1
            continue
        frames[message.name] += 1
        if len(data) != message.length:
            wrong["length"] += 1
            continue
        wrong["crc"] += data[0] != crc8_j1850((identifier & 0xFF, identifier >> 8, *data[1:]))
        values = values_of(message, data)
        counter, before = int(values["Counter"]), counters.get(identifier)
        wrong["counter"] += before is not None and counter != (before + 1) % COUNTER_PERIOD
        counters[identifier] = counter
        wrong["out_of_range"] += not is_in_range(message, values)
        moving += message.name == "VelocityCommand" and (values["Vx"] != 0 or values["Wz"] != 0)
    duration_s = 0.0 if first is None or last is None else last - first
    cycles = {message.name: message.cycle_time for message in messages.values() if message.cycle_time}
    rare = [name for name, cycle_ms in cycles.items() if frames[name] < MIN_SHARE * duration_s * 1000 / cycle_ms - 1]
    return {
        "duration_s": round(duration_s, 1),
        "frames": sum(frames.values()),
        "moving_commands": moving,
        "wrong": dict(wrong),
        "rare": rare,
        "by_message": dict(sorted(frames.items())),
    }


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.can_trace.check",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("trace", type=Path, metavar="TRACE.log")
    parser.add_argument("--dbc", type=Path, default=DEFAULT_DBC, metavar="FILE.dbc", help="default: carter.dbc")
    parser.add_argument("--duration", type=float, default=0.0, metavar="S", help="least duration of the trace, s")
    args = parser.parse_args(argv)
    try:
        with args.trace.open(encoding="ascii") as lines:
            result = judge(lines, args.dbc)
    except (OSError, ValueError, cantools.Error) as error:
        sys.stderr.write(f"check: {args.trace}: {error}\n")
        return 2
    sys.stdout.write(json.dumps(result, indent=2) + "\n")
    whole = result["moving_commands"] and not result["rare"] and float(str(result["duration_s"])) >= args.duration
    wrong = result["wrong"]
    return 0 if whole and isinstance(wrong, dict) and not any(wrong.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
