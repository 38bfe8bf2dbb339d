"""Memory of the live view over hours: a flight log is streamed in real time, again and again, to five viewers.

    python -m tools.memory.stream out/demo/flight.mcap --hours 8 --out out/stream

Of the viewers two are pages, one is Foxglove with every channel, one reads nothing and one reads 1 kB/s. No robot and
no model runs. A reading is written to readings.jsonl every 10 s, so that an end by force loses nothing; SIGINT and
SIGTERM end the stream and print what there is. The second half counts: growth of the private memory of the view, and
of the process that feeds it, of at most 1 MB/h. It shows nothing if a page or Foxglove has received nothing, or if the
view lacks more than 1 % of the messages. --speed streams faster than real time: hours and growth per hour are then
those of the log. Viewers come and go no faster: growth with time or with connections shows less.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_directory, command_line, write_result
from edge.flightlog.part import Payload
from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages
from edge.flightlog.schemas import SCHEMAS
from edge.live.feed import LiveFeed
from edge.live.options import LiveError, LiveOptions
from firmware_bridge.system.terminal import CommandParser
from sim_hil.processes.child_process import last_lines
from sim_hil.realtime.children import Children, StepError
from tools.bench import bad_input
from tools.memory.gauge import LIMIT_MIB_PER_H, later_half, read_sizes

PERIOD_S: Final = 10.0
"""Time between two readings, s."""
PICTURES: Final = "/camera"
MOST_DROPPED: Final = 0.01
"""Share of the messages that the view may lack: without the pictures, a tenth or more, its memory shows nothing."""
_FIVE: Final = "five viewers"
_VIEW: Final = "edge.live.server"
_SIZES: Final = ("private_dirty", "rss")
JUDGED: Final = ("view", "feed")


@dataclass(frozen=True)
class Recording:
    """Messages of a flight log by their time since its first one, s; `seconds` later it begins again."""

    messages: tuple[tuple[float, str, Payload], ...]
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Messages a second."""
        return len(self.messages) / self.seconds


def read_recording(log: Path) -> Recording:
    """Read what a run sent to its view. Raises RecordingError, OSError, or ValueError for a log without pictures."""
    found: list[tuple[int, str, Payload]] = []
    for topic, stamp_ns, record in read_messages(log):
        if topic == PICTURES:
            found.append((stamp_ns, topic, jpeg_bytes(record)))
        elif topic in SCHEMAS:  # the rest are messages for viewers, which the view makes itself
            found.append((stamp_ns, topic, record))
    if not any(topic == PICTURES for _, topic, _ in found):
        raise ValueError(f"{log}: no picture in it; record a run with a camera")
    found.sort(key=lambda message: message[0])
    first_ns, last_ns = found[0][0], found[-1][0]
    messages = tuple(((at_ns - first_ns) / 1e9, topic, payload) for at_ns, topic, payload in found)
    return Recording(messages, (last_ns - first_ns) / 1e9 + 0.1)


class Stream:
    """Feeds a recording to a view and takes readings; `folder` receives them and the viewers' log.

    `speed`: seconds of the recording streamed in a second.
    """

    def __init__(self, recording: Recording, folder: Path, speed: float = 1.0) -> None:
        self._recording, self._folder, self._speed = recording, folder, speed
        self._end = threading.Event()
        self._sent = 0
        self.file = folder / "readings.jsonl"

    def stop(self, *_: object) -> None:
        """End the stream soon; safe in a signal handler."""
        self._end.set()

    def run(self, hours: float) -> None:
        """Stream so many hours of the recording or until `stop`. Raises LiveError or StepError."""
        feed = LiveFeed(LiveOptions(port=0), None, lambda: False, print)
        try:
            with Children(self._folder) as children, self.file.open("w", encoding="ascii") as file:
                command = [sys.executable, "-m", "tools.bench.live_viewers", feed.url, _FIVE]
                viewers = children.start("viewers", command)
                view = next((one for one in psutil.Process().children() if _VIEW in one.cmdline()), None)
                if view is None:
                    raise LiveError("the live view has ended")
                sending = threading.Thread(target=self._send, args=(feed,), name="stream", daemon=True)
                sending.start()
                end_s = time.monotonic() + 3600 * hours / self._speed
                while time.monotonic() < end_s and not self._end.wait(PERIOD_S):
                    if not viewers.running:
                        raise viewers.failure("the viewers have ended")
                    sizes = {"feed": read_sizes(), "view": read_sizes(view.pid)}
                    one = {"t_ns": time.monotonic_ns(), **sizes, "sent": self._sent, "dropped": feed.dropped}
                    one |= {"view_cpu_s": sum(view.cpu_times()[:2]), **newest_report(viewers.log)}
                    # Not kept: the feed's memory is judged too.
                    file.write(json.dumps(one) + "\n")
                    file.flush()
                self._end.set()
                sending.join()
        finally:
            feed.close()

    def _send(self, feed: LiveFeed) -> None:
        begin_s = time.monotonic()
        while not self._end.is_set():
            for into_s, topic, payload in self._recording.messages:
                if self._end.wait(max(0.0, begin_s + into_s / self._speed - time.monotonic())):
                    return
                feed.put(topic, time.monotonic_ns(), payload)
                self._sent += 1
            begin_s += self._recording.seconds / self._speed


def newest_report(log: Path) -> dict[str, Any]:
    """Return the newest line of `tools.bench.live_viewers` in its log: `received` and `failure`; {} without one."""
    for line in reversed(last_lines(log)):
        with contextlib.suppress(ValueError):
            found = json.loads(line)
            if isinstance(found, dict) and "received" in found:
                return found
    return {}


def judge(readings: Sequence[dict[str, Any]], hours: float, speed: float = 1.0, rate_hz: float = 0.0) -> dict[str, Any]:
    """Return the growth of each process over the second half, and whether all of it is known and within the limit.

    Hours and `rate_hz`, its messages a second, are those of the recording. A stream that ended before `hours`, that
    fell behind, that a viewer did not receive or that lacks much shows nothing.
    """
    growth: dict[str, Any] = {}
    for name in JUDGED:
        series = [{"t_ns": one["t_ns"] * speed, **one[name]} for one in readings]
        found = {column: later_half(series, column) if series else None for column in _SIZES}
        growth[name] = {column: None if one is None else one._asdict() for column, one in found.items()}
    private = [growth[name]["private_dirty"] for name in JUDGED]
    took_h = speed * (readings[-1]["t_ns"] - readings[0]["t_ns"]) / 3.6e12 if readings else 0.0
    whole = took_h * 3600 >= hours * 3600 - 3 * PERIOD_S * speed
    last: dict[str, Any] = readings[-1] if readings else {"sent": 0, "dropped": 0}
    received = last.get("received", {})
    seen = bool(received) and all(count > 0 for count in received.values())
    in_time = last["sent"] >= (1 - MOST_DROPPED) * rate_hz * 3600 * took_h
    complete = in_time and last["dropped"] <= MOST_DROPPED * last["sent"]
    return {
        "hours": round(took_h, 3),
        "speed": speed,
        "mib_per_h": growth,
        "limit_mib_per_h": LIMIT_MIB_PER_H,
        "sent": last["sent"],
        "dropped": last["dropped"],
        "received": received,
        "viewers_failure": last.get("failure"),
        "ok": whole
        and seen
        and complete
        and all(one is not None and one["per_h"] <= LIMIT_MIB_PER_H for one in private),
        "tagged": "measured",
    }


@command_line("stream")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = CommandParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("log", type=Path, help="flight log of a run, such as the demo's")
    p.add_argument("--hours", type=float, default=8.0, metavar="H", help="default: 8")
    p.add_argument("--speed", type=float, default=1.0, metavar="N", help="times as fast as real time (default: 1)")
    p.add_argument("--out", type=Path, default=Path("out/stream"), metavar="DIR", help="default: out/stream")
    args = p.parse_args(argv)
    try:
        if not 0 < args.hours <= 24 * 7:
            raise ValueError(f"--hours {args.hours}: expected a number above 0, at most a week")
        if not 0.1 <= args.speed <= 100:
            raise ValueError(f"--speed {args.speed}: expected a number from 0.1 to 100")
        check_result_directory(args.out)
        recording = read_recording(args.log)
        args.out.mkdir(parents=True, exist_ok=True)
    except (RecordingError, OSError, ValueError) as error:
        return bad_input("stream", error)
    stream = Stream(recording, args.out, args.speed)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stream.stop)
    failure = None
    try:
        stream.run(args.hours)
    except (LiveError, StepError, psutil.Error, OSError) as error:
        failure = str(error)
        sys.stderr.write(f"stream: {failure}\n")
    lines = stream.file.read_text("ascii").splitlines() if stream.file.exists() else []
    result = judge([json.loads(line) for line in lines], args.hours, args.speed, recording.rate_hz)
    result |= {"failure": failure, "ok": result["ok"] and failure is None}
    write_result(str(args.out / "stream.json"), result)
    for name, found in result["mib_per_h"].items():
        for column, one in found.items():
            if one is None:
                print(f"{name} {column}: too few readings")
            else:
                print(f"{name} {column}: {one['per_h']:+.2f} ({one['low']:+.2f} to {one['high']:+.2f}) MiB/h")
    verdict = "within the limit" if result["ok"] else "NOT SHOWN"
    received = ", ".join(f"{name} {count}" for name, count in result["received"].items()) or "nothing"
    print(f"received by the viewers: {received}; their newest failure: {result['viewers_failure'] or 'none'}")
    print(f"{result['hours']} of {args.hours} h, {result['dropped']} of {result['sent']} dropped: {verdict}")
    return EXIT_DONE if result["ok"] else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
