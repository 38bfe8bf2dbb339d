"""Write the demo's report: one self-contained HTML page and demo.json, from the files of one run.

    python -m tools.report.demo_report out/demo

reads settings.json, flight.mcap, hil_trace.jsonl, run.json, bridge.json and hil.json in that folder and manifest.json
of the artifacts that settings.json names, and writes report.html and demo.json beside them.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from edge.core.cli import OutputError, command_line, write_result, write_whole
from firmware_bridge.system.terminal import CommandParser, one_line
from reporting.page import Cell, Figure, Table, mark, render
from reporting.plot_style import delay_histogram
from tools.report import figures
from tools.report.checks import Check, acceptance
from tools.report.explain_page import explained_run
from tools.report.numbers import Number, command_latency_ms, delay_at_call, headline, numbers
from tools.report.run_data import (
    MISSHAPEN,
    Record,
    ReportError,
    RunData,
    load_flight_log,
    load_frames,
    load_json,
    load_trace,
    seconds,
)

SHEET_FRAMES = 12
_FRAME_WIDTH_PX = 480


class RunFiles:
    """Paths of the files of one demo run."""

    def __init__(self, out: Path, artifacts: Path) -> None:
        self.out, self.artifacts = out, artifacts
        self.settings = out / "settings.json"
        self.robot = out / "robot.toml"
        self.flight_log = out / "flight.mcap"
        self.trace = out / "hil_trace.jsonl"
        self.report = out / "report.html"
        self.summary = out / "demo.json"

    def result(self, command: str) -> Path:
        """Return the path of a command's JSON result (`edge-run` → run.json)."""
        return self.out / f"{command.removeprefix('edge-')}.json"

    def of_a_run(self) -> list[Path]:
        """All files that a run writes; removed before the next run, so that no old result remains after a failure."""
        results = [self.result(command) for command in ("edge-run", "edge-hil", "edge-bridge")]
        return [self.settings, self.robot, self.flight_log, self.trace, self.report, self.summary, *results]


def load_run(files: RunFiles) -> RunData:
    """Read all files of a run. Raises ReportError that names a missing or damaged file."""
    results = {command: load_json(files.result(command)) for command in ("edge-run", "edge-hil", "edge-bridge")}
    manifest = load_json(files.artifacts / "manifest.json")
    log, trace, settings = load_flight_log(files.flight_log), load_trace(files.trace), load_json(files.settings)
    seconds(files.settings, settings, "duration_s")
    return RunData(settings, log, trace, results, manifest)


def write_report(files: RunFiles, *, wall_s: float) -> Record:
    """Write report.html and demo.json; returns the content of demo.json. Raises ReportError."""
    data = load_run(files)
    try:
        checks = acceptance(data)
        summary = _summary(data, checks, wall_s)
        html = _page(data, checks, wall_s)
    except ReportError:
        raise
    except MISSHAPEN as error:
        raise ReportError(f"{files.out}: a record of the run lacks or misshapes a field: {error!r}") from error
    except OSError as error:
        raise ReportError(f"{files.out}: a file of the run cannot be read: {error}") from error
    try:
        write_whole(files.report, html)
        write_result(str(files.summary), summary)
    except (OSError, OutputError) as error:
        raise ReportError(f"{files.report} and {files.summary.name} cannot be written: {error}") from error
    return summary


def _summary(data: RunData, checks: Sequence[Check], wall_s: float) -> Record:
    run = data.results["edge-run"]
    return {
        **{key: data.settings.get(key) for key in ("robot", "protocol")},
        **{key: run[key] for key in ("control", "reasoning", "delay_s", "delay_error_ms")},
        "bridge": data.results["edge-bridge"],
        "command_latency_ms": command_latency_ms(data),
        "wire": data.trace.end.get("wire", data.results["edge-hil"].get("wire", {})),
        "checks": {check.name: check.as_json() for check in checks},
        "duration_s": data.duration_s,
        "wall_s": round(wall_s, 1),
    }


def _page(data: RunData, checks: Sequence[Check], wall_s: float) -> str:
    failed = sum(not check.passed for check in checks)
    model, hil = data.manifest.get("model", {}), data.results["edge-hil"]
    machine = data.settings.get("machine")
    close_up = figures.close_up(data)
    delays_s = np.array([t["delay_s"] for t in data.log.ticks if t["delay_s"] is not None], float)
    maps = [
        Figure(
            figures.top_down(data),
            "Top-down picture of the path among walls, objects and people",
            "Ground truth from the simulator in the world frame. The dashed line is what the runner believed from "
            "the robot's odometry.",
            wide=True,
        )
    ]
    if close_up is not None:
        maps.append(Figure(close_up, "Close-up of the path", "The same, close to the path.", wide=True))
    return render(
        "demo",
        title="TIC-VLA edge: demo run",
        passed=not failed,
        verdict=f"{failed} of {len(checks)} checks failed" if failed else f"all {len(checks)} checks passed",
        instruction=str(data.log.run.get("instruction", "not recorded")),
        robot=_robot(data),
        scene=str(data.trace.scene["name"]),
        people=hil["people"],
        seed=hil["seed"],
        duration_s=data.duration_s,
        untrained=isinstance(model, dict) and model.get("trained") is False,
        tiles=headline(data),
        maps=maps,
        cards=_cards(data),
        events=explained_run(data),
        time_line=Figure(
            figures.time_line(data),
            "Time line of delay, forward speed and turn rate",
            "Δt rises between generations and falls when a newer one is released. Shaded: ticks that did not drive "
            "(no semantic state yet, stale input or stopping).",
            wide=True,
        ),
        histograms=[
            Figure(
                figures.tick_histogram(data.log.tick_ms),
                "Histogram of control tick durations",
                "Every control tick, from its deadline to its command sent; the loop runs at 10 Hz.",
            ),
            Figure(
                delay_histogram(delays_s),
                "Histogram of the delay",
                "Age of the semantic state when the action expert used it.",
            ),
        ],
        checks=_check_table(checks, beside={"delay_error_ms": delay_at_call(data)}),
        numbers=Table(
            ("number", "value", "kind", "source"),
            [(n.title, n.value, n.kind, n.source) for n in numbers(data, wall_s)],
            numeric=frozenset({1}),
        ),
        # The machine recorded by the demo: the report may be written on another one.
        machine=Table(("what", "value"), [(key, str(value)) for key, value in machine.items()])
        if isinstance(machine, dict)
        else None,
    )


def _robot(data: RunData) -> str:
    """Return the robot's name and protocol; those of edge-hil's result alone for a run without them."""
    name, protocol = data.settings.get("robot", data.results["edge-hil"]["robot"]), data.settings.get("protocol")
    return str(name) if protocol is None else f"{name}, protocol {protocol}"


def _cards(data: RunData) -> list[Record]:
    """Return the generations of the contact sheet: their anchor frame (JPEG or None), facts and text."""
    chosen = spread(data.log.semantics, SHEET_FRAMES)
    frames = load_frames(data.log.path, {s["frames_ns"][-1] for s in chosen if s["frames_ns"]})
    cards = []
    for semantic in chosen:
        anchor_ns, generation, waypoints = semantic["anchor_ns"], semantic["generation"], semantic["waypoints"]
        jpeg = frames.get(semantic["frames_ns"][-1] if semantic["frames_ns"] else -1)
        points = "no waypoints in the text" if not waypoints else f"{len(waypoints)} waypoints"
        meta = (
            f"generation {generation:d} · seen at {round((anchor_ns - data.log.start_ns) / 1e9, 1) + 0.0:.1f} s · "
            f"Δt {(semantic['ready_ns'] - anchor_ns) / 1e9:.2f} s at release · {semantic['new_tokens']:d} tokens · "
            f"{points}"
        )
        shown = None if jpeg is None else _shrink(jpeg)
        cards.append({"jpeg": shown, "generation": generation, "meta": meta, "text": semantic["text"]})
    return cards


def spread(items: Sequence[Record], count: int) -> list[Record]:
    """Select up to `count` items, evenly spaced, including the first and the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def _shrink(jpeg: bytes) -> bytes:
    """Shrink a frame to at most 480 px width, so that the page stays small; keeps a frame that does not decode."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if image is None or image.shape[1] <= _FRAME_WIDTH_PX:
        return jpeg
    height = round(image.shape[0] * _FRAME_WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (_FRAME_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _check_table(checks: Sequence[Check], beside: Mapping[str, Number]) -> Table:
    """Return the table of checks; `beside` are numbers listed under a check."""
    rows: list[Sequence[str | Cell]] = []
    for check in checks:
        limit = f"{check.rule} {_value(check.limit)} {check.unit}".strip()
        value = f"{_value(check.value)} {check.unit}".strip()
        verdict = mark(check.passed, "pass" if check.passed else "FAIL")
        rows.append((verdict, check.title, value, limit, "measured", check.note))
        if (number := beside.get(check.name)) is not None:
            rows.append(("–", number.title, number.value, "no check", number.kind, number.source))
    head = ("", "check", "value", "required", "kind", "note")
    return Table(head, rows, numeric=frozenset({2, 3}))


def _value(value: float | int | bool | None) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def recorded_artifacts(out: Path) -> Path:
    """Return the artifact directory named in a run's settings.json, relative to `out` if inside."""
    settings = out / "settings.json"
    named = load_json(settings).get("artifacts")
    if not isinstance(named, str) or not named:
        raise ReportError(f"{settings}: expected the artifact directory's path under 'artifacts', found {named!r}")
    return out / named


@command_line("demo_report")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; exit codes 0 all checks passed, 1 a check failed, 2 bad input."""
    parser = CommandParser(
        prog="python -m tools.report.demo_report",
        description="Write the report of a demo run again from its files.",
        epilog="example: python -m tools.report.demo_report out/demo",
    )
    parser.add_argument("out", type=Path, help="folder of the run, as written by python -m tools.demo")
    parser.add_argument("--artifacts", type=Path, help="artifact directory (default: the one settings.json names)")
    parser.add_argument("--json", metavar="FILE", help="also write demo.json's content to this file; - is stdout")
    args = parser.parse_args(argv)
    try:
        files = RunFiles(args.out, args.artifacts or recorded_artifacts(args.out))
        # Only the demo knows its total duration, which is in the first report's demo.json.
        wall_s = seconds(files.summary, load_json(files.summary), "wall_s") if files.summary.exists() else 0.0
        summary = write_report(files, wall_s=wall_s)
        write_result(args.json, summary)
    except (ReportError, OSError) as error:
        print(f"demo_report: {one_line(error)}", file=sys.stderr)
        return 2
    if args.json != "-":
        print(files.report)
    return 0 if all(check["pass"] for check in summary["checks"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
