"""`edge-replay video`: a flight log as a video: picture with plan and waypoints, text, Δt, command, faults."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    OutputError,
    check_result_target,
    command_line,
    messages,
    named_file,
)
from edge.flightlog.explain.chain import generation_of
from edge.flightlog.explain.flight import Flight, read_flight
from edge.flightlog.explain.overlay import PLAN_COLOUR, WAYPOINT_COLOUR, Overlay, Picture, label
from edge.flightlog.reader import RecordingError
from edge.flightlog.replay.records import RecordedFrame, read_events
from firmware_bridge.system.terminal import CommandParser

EXAMPLES = """examples:
  edge-replay video flight.mcap --out flight.mp4
  edge-replay video flight.mcap --from 30 --to 45 --out turn.mp4

The plan is blue, the text's waypoints are orange, on a level floor: a trotting robot shifts them by some pixels.
A log without the camera's mount shows the pictures without drawing.
exit codes: 0 done, 1 the video could not be written, 2 bad arguments or input, 130 interrupted
"""

PANEL_PX: Final = 160
CODEC: Final = "mp4v"
_MAX_TEXT_LINES: Final = 6
_TEXT_CHARS: Final = 88
_FAULT_CHARS: Final = 54
"""Characters that fit right of the time and the delay, also in the wider letters of OpenCV 4."""
_SINGLE_HZ: Final = 10.0
"""Rate of a video of one picture, Hz."""
_MOST_HZ: Final = 240.0
"""Rate above which the stamps cannot be a camera's, Hz."""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-replay video`."""
    p = CommandParser(
        "edge-replay video", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("file", type=Path, metavar="FILE.mcap", help="flight log of edge-run --record or of edge-bench")
    p.add_argument("--out", type=Path, required=True, metavar="FILE.mp4", help="video to write")
    p.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S", help="s after the first tick")
    p.add_argument("--to", dest="to_s", type=float, default=math.inf, metavar="S", help="s after the first tick")
    return p


def pages(path: Path, flight: Flight, from_s: float, to_s: float) -> Iterator[tuple[int, Picture]]:
    """Yield stamp, ns, and page, BGR [height, width, 3], of every recorded picture of a span of time."""
    overlay = Overlay(flight.mount)
    for event in read_events(path):
        if not isinstance(event, RecordedFrame) or not from_s <= flight.seconds(event.stamp_ns) <= to_s:
            continue
        page = draw_page(overlay, flight, event)
        if page is not None:
            yield event.stamp_ns, page


def draw_page(overlay: Overlay, flight: Flight, frame: RecordedFrame) -> Picture | None:
    """Return the page of one picture, with the first tick that drove by it; None for a picture that does not decode."""
    ticks = flight.ticks_between(frame.stamp_ns, frame.stamp_ns + 1_000_000_000)
    tick = next((each for each in ticks if each.frame_ns == frame.stamp_ns), ticks[0] if ticks else None)
    generation = None if tick is None else generation_of(flight, tick)
    picture = overlay.draw(frame.jpeg, tick, generation)
    if picture is None:
        return None
    panel = np.full((PANEL_PX, picture.shape[1], 3), 28, np.uint8)
    label(panel, f"{flight.seconds(frame.stamp_ns):6.1f} s", (8, 18), (255, 255, 255), 0.5)
    if tick is not None:
        delay = "delay --" if generation is None else f"delay {tick.delay_s:.1f} s"
        label(panel, delay, (90, 18), WAYPOINT_COLOUR, 0.5)
        vx, vy, wz = tick.command
        label(panel, f"command {vx:+.2f} {vy:+.2f} m/s {wz:+.2f} rad/s", (8, 38), PLAN_COLOUR, 0.45)
        vx, vy, wz = tick.state
        label(panel, f"measured {vx:+.2f} m/s {wz:+.2f} rad/s", (330, 38), (200, 200, 200), 0.45)
        held = [] if tick.reason == "ok" else [tick.reason]
        names = dict.fromkeys([*held, *flight.faults_at(tick.now_ns)])  # a fault that holds the robot is its own reason
        label(panel, ", ".join(names)[:_FAULT_CHARS], (190, 18), (80, 80, 255), 0.45)
    text = "" if generation is None else generation.text
    lines = [part for line in text.splitlines() for part in textwrap.wrap(line, _TEXT_CHARS)]
    for number, line in enumerate(lines[:_MAX_TEXT_LINES]):
        label(panel, line, (8, 58 + 18 * number), (235, 235, 235), 0.42)
    return np.vstack((picture, panel))


def write_video(path: Path, flight: Flight, out: Path, from_s: float, to_s: float) -> tuple[int, int]:
    """Write the video, whole or not at all; return the numbers of its pictures and of those that cannot be decoded.

    Raises RecordingError, OutputError.
    """
    stamps = [at_ns for at_ns in flight.frames_ns if from_s <= flight.seconds(at_ns) <= to_s]
    if not stamps:
        raise RecordingError(f"{path}: no picture between --from and --to; expected some in {len(flight.frames_ns)}")
    rate_hz = _rate_hz(path, stamps)
    # OpenCV takes the format from the suffix, follows links and reports no full disk: a folder of its own.
    with named_file(out) as partial, tempfile.TemporaryDirectory(prefix=".video-", dir=partial.parent) as folder:
        draft = Path(folder) / f"video{out.suffix}"
        count = _write_draft(draft, pages(path, flight, from_s, to_s), rate_hz)
        if count == 0:
            raise RecordingError(f"{path}: none of the {len(stamps)} pictures between --from and --to can be decoded")
        found = max(0, int(cv2.VideoCapture(str(draft)).get(cv2.CAP_PROP_FRAME_COUNT)))  # -1: no video at all
        if found != count:
            raise OutputError(f"{out}: {found} of {count} pictures could be written; is the disk full?")
        draft.replace(partial)
    return count, len(stamps) - count


def _write_draft(draft: Path, drawn: Iterator[tuple[int, Picture]], rate_hz: float) -> int:
    """Write the pages of a video and return their number. Raises OutputError."""
    writer: cv2.VideoWriter | None = None
    count = 0
    try:
        for _, page in drawn:
            if writer is None:
                height, width = page.shape[:2]
                writer = cv2.VideoWriter(str(draft), cv2.VideoWriter.fourcc(*CODEC), rate_hz, (width, height))
                if not writer.isOpened():
                    raise OutputError(f"OpenCV cannot write a video as {draft.suffix!r}; expected --out FILE.mp4")
            writer.write(page)
            count += 1
    finally:
        if writer is not None:
            writer.release()  # writes the end of the file
    return count


def _rate_hz(path: Path, stamps_ns: Sequence[int]) -> float:
    """Return the pictures' mean rate, Hz. Raises RecordingError for pictures that are not one after the other."""
    if len(stamps_ns) == 1:
        return _SINGLE_HZ
    span_ns = stamps_ns[-1] - stamps_ns[0]
    rate_hz = 1e9 * (len(stamps_ns) - 1) / max(1, span_ns)
    if rate_hz > _MOST_HZ:
        raise RecordingError(
            f"{path}: {len(stamps_ns)} pictures within {span_ns} ns; expected at most {_MOST_HZ:g} a second"
        )
    return rate_hz


_print = messages("edge-replay video")


@command_line("edge-replay video", {RecordingError: EXIT_BAD_INPUT, OSError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(sys.argv[2:] if argv is None else argv)
    cv2.setNumThreads(1)
    if not 0 <= args.from_s < args.to_s:
        raise RecordingError(f"--from {args.from_s:g} --to {args.to_s:g}: expected 0 or more, and --to after --from")
    check_result_target(str(args.out), "--out")
    flight = read_flight(args.file)
    if flight.notice is not None:
        _print(flight.notice)
    if flight.mount is None:
        _print(
            f"{args.file}: names no camera mount, so plan and waypoints are not drawn; add [mount] to the robot file"
        )
    count, left_out = write_video(args.file, flight, args.out, args.from_s, args.to_s)
    _print(f"{args.out}: {count} pictures" + (f", without {left_out} that cannot be decoded" if left_out else ""))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
