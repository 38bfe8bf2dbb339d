"""Write the demo's report: one self-contained HTML page and demo.json, from the files of one run.

    python -m tools.report.demo_report out/demo

reads settings.json, flight.mcap, hil_trace.jsonl, run.json, bridge.json and hil.json in that folder and manifest.json
of the artifacts that settings.json names, and writes report.html and demo.json beside them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.core.cli import OutputError, command_line, write_result, write_whole
from reporting import page
from tools.report import figures
from tools.report.checks import Check, acceptance
from tools.report.numbers import Number, delay_at_call, headline, numbers
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


@dataclass(frozen=True)
class RunFiles:
    """Where the files of one demo run lie."""

    out: Path
    artifacts: Path

    @property
    def settings(self) -> Path:
        """What the demo was asked for, written before it starts."""
        return self.out / "settings.json"

    @property
    def flight_log(self) -> Path:
        """Recorded by edge-run."""
        return self.out / "flight.mcap"

    @property
    def trace(self) -> Path:
        """Written by edge-hil."""
        return self.out / "hil_trace.jsonl"

    @property
    def report(self) -> Path:
        """The page."""
        return self.out / "report.html"

    @property
    def summary(self) -> Path:
        """The acceptance numbers."""
        return self.out / "demo.json"

    def result(self, command: str) -> Path:
        """JSON result of one command (`edge-run` → run.json)."""
        return self.out / f"{command.removeprefix('edge-')}.json"

    def of_a_run(self) -> list[Path]:
        """Everything one run writes: removed before the next, so that a failed run never shows an old result."""
        results = [self.result(command) for command in ("edge-run", "edge-hil", "edge-bridge")]
        return [self.settings, self.flight_log, self.trace, self.report, self.summary, *results]


def load_run(files: RunFiles) -> RunData:
    """Read all files of a run; ReportError names the one that is missing or damaged."""
    results = {command: load_json(files.result(command)) for command in ("edge-run", "edge-hil", "edge-bridge")}
    manifest = load_json(files.artifacts / "manifest.json")
    log, trace, settings = load_flight_log(files.flight_log), load_trace(files.trace), load_json(files.settings)
    seconds(files.settings, settings, "duration_s")
    return RunData(settings, log, trace, results, manifest)


def write_report(files: RunFiles, *, wall_s: float) -> Record:
    """Write report.html and demo.json; returns what demo.json holds. Raises ReportError."""
    data = load_run(files)
    try:
        checks = acceptance(data)
        summary = _summary(data, checks, wall_s)
        html = page.document("TIC-VLA edge: demo run", _body(data, checks, wall_s))
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
        **{key: run[key] for key in ("control", "reasoning", "delay_s", "delay_error_ms")},
        "bridge": data.results["edge-bridge"],
        "wire": data.trace.end.get("wire", data.results["edge-hil"].get("wire", {})),
        "checks": {check.name: check.as_json() for check in checks},
        "duration_s": data.duration_s,
        "wall_s": round(wall_s, 1),
    }


def _body(data: RunData, checks: Sequence[Check], wall_s: float) -> str:
    failed = [check for check in checks if not check.passed]
    verdict = f"{len(failed)} of {len(checks)} checks failed" if failed else f"all {len(checks)} checks passed"
    scene = data.trace.scene
    run = data.log.run
    parts = [
        "<h1>TIC-VLA edge: the whole loop on a simulated Go2</h1>",
        f'<p><span class="verdict {"bad" if failed else "good"}">{verdict}</span></p>',
        f"<p>Instruction: <b>{page.text_html(str(run.get('instruction', 'not recorded')))}</b></p>",
        f'<p class="quiet">Scene “{page.text_html(str(scene["name"]))}”, {data.results["edge-hil"]["people"]} people, '
        f"seed {data.results['edge-hil']['seed']}, {data.duration_s:.1f} s of real time. The runner knows only the "
        "robot's protocol; the paths and speeds called true come from the simulator.</p>",
        _untrained_notice(data),
        page.tiles(headline(data)),
        "<h2>Where the robot walked</h2>",
        page.figure(
            figures.top_down(data),
            "Top-down picture of the path among walls, objects and people",
            "Ground truth from the simulator in the world frame. The dashed line is what the runner believed from "
            "the robot's odometry.",
            wide=True,
        ),
        _close_up(data),
        "<h2>What the camera saw and what the VLM said</h2>",
        '<p class="quiet">Each picture is the newest frame the generation was given (its anchor); below it the '
        "VLM's output, as it came.</p>",
        _contact_sheet(data),
        "<h2>Time</h2>",
        page.figure(
            figures.time_line(data),
            "Time line of delay, forward speed and turn rate",
            "Δt rises between generations and falls when a newer one is released. Shaded: ticks that did not drive "
            "(no semantic state yet, stale input or stopping).",
            wide=True,
        ),
        '<div class="pair">',
        page.figure(
            figures.tick_histogram(data.log.tick_ms),
            "Histogram of control tick durations",
            "Every control tick, from its deadline to its command sent; the loop runs at 10 Hz.",
        ),
        page.figure(
            figures.delay_histogram(
                np.array([t["delay_s"] for t in data.log.ticks if t["delay_s"] is not None], float)
            ),
            "Histogram of the delay",
            "How old the semantic state was when the action expert used it.",
        ),
        "</div>",
        "<h2>Checks</h2>",
        _check_table(checks, beside={"delay_error_ms": delay_at_call(data)}),
        "<h2>Numbers</h2>",
        _number_table(numbers(data, wall_s)),
        "<h2>Machine</h2>",
        _machine_table(data.settings.get("machine")),
    ]
    return "\n".join(part for part in parts if part)


def _machine_table(facts: object) -> str:
    """The machine of the run, as the demo noted it: the report may be written on another one."""
    if not isinstance(facts, dict):
        return "<p>settings.json does not say on which machine this was measured.</p>"
    return page.table(("what", "value"), [(page.text_html(k), page.text_html(str(v))) for k, v in facts.items()])


def _untrained_notice(data: RunData) -> str:
    model = data.manifest.get("model", {})
    if not isinstance(model, dict) or model.get("trained") is not False:
        return ""
    return (
        '<p class="notice"><b>The weights are untrained</b> (initialised from a seed). The robot walks where random '
        "numbers send it and does not find the vending machine yet; the text under the pictures is noise. What this "
        "run shows is that the loop works: timing, delays, protocol and stop.</p>"
    )


def _close_up(data: RunData) -> str:
    picture = figures.close_up(data)
    return (
        ""
        if picture is None
        else page.figure(picture, "Close-up of the path", "The same, close to the path.", wide=True)
    )


def _contact_sheet(data: RunData) -> str:
    chosen = spread(data.log.semantics, SHEET_FRAMES)
    if not chosen:
        return "<p>No generation was released in this run.</p>"
    frames = load_frames(data.log.path, {s["frames_ns"][-1] for s in chosen if s["frames_ns"]})
    return f'<div class="sheet">{"".join(_card(data, s, frames) for s in chosen)}</div>'


def spread(items: Sequence[Record], count: int) -> list[Record]:
    """Up to `count` items, evenly over the sequence, always with the first and the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def _card(data: RunData, semantic: Record, frames: dict[int, bytes]) -> str:
    anchor_ns, generation = semantic["anchor_ns"], semantic["generation"]
    jpeg = frames.get(semantic["frames_ns"][-1] if semantic["frames_ns"] else -1)
    if jpeg is None:
        picture = "<p>(the frame is not in the flight log)</p>"
    else:
        uri = page.image_uri(_shrink(jpeg), "jpeg")
        picture = f'<img src="{uri}" alt="Camera frame of generation {generation:d}">'
    released_s = (semantic["ready_ns"] - anchor_ns) / 1e9
    waypoints = semantic["waypoints"]
    points = "no waypoints in the text" if not waypoints else f"{len(waypoints)} waypoints"
    return (
        f'<figure>{picture}<div class="meta">generation {generation:d} · seen at '
        f"{round((anchor_ns - data.log.start_ns) / 1e9, 1) + 0.0:.1f} s · Δt {released_s:.2f} s at release · "
        f"{semantic['new_tokens']:d} tokens · {points}</div>"
        f'<pre class="vlm">{page.text_html(semantic["text"]) or "(empty)"}</pre></figure>'
    )


def _shrink(jpeg: bytes) -> bytes:
    """A frame at most 480 px wide, so that the page stays small; a frame that does not decode is left as it is."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if image is None or image.shape[1] <= _FRAME_WIDTH_PX:
        return jpeg
    height = round(image.shape[0] * _FRAME_WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (_FRAME_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _check_table(checks: Sequence[Check], beside: Mapping[str, Number]) -> str:
    """All checks; `beside` names numbers that belong under a check without being one."""
    rows = []
    for check in checks:
        mark = '<span class="pass">pass</span>' if check.passed else '<span class="fail">FAIL</span>'
        limit = f"{check.rule} {_words(check.limit)} {check.unit}".strip()
        value = f"{_words(check.value)} {check.unit}".strip()
        rows.append((mark, page.text_html(check.title), value, limit, "measured", page.text_html(check.note)))
        if (number := beside.get(check.name)) is not None:
            title, source = page.text_html(number.title), page.text_html(number.source)
            rows.append(("–", title, page.text_html(number.value), "no check", number.kind, source))
    head = ("", "check", "value", "required", "kind", "note")
    return page.table(head, rows, numeric=frozenset({2, 3}))


def _number_table(items: Sequence[Number]) -> str:
    rows = [(page.text_html(n.title), page.text_html(n.value), n.kind, page.text_html(n.source)) for n in items]
    return page.table(("number", "value", "kind", "source"), rows, numeric=frozenset({1}))


def _words(value: float | int | bool | None) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def recorded_artifacts(out: Path) -> Path:
    """The artifact directory that a run's settings.json names, relative to `out` where it lies inside."""
    settings = out / "settings.json"
    named = load_json(settings).get("artifacts")
    if not isinstance(named, str) or not named:
        raise ReportError(f"{settings}: expected the artifact directory's path under 'artifacts', found {named!r}")
    return out / named


@command_line("demo_report")
def main(argv: Sequence[str] | None = None) -> int:
    """Command line; exit codes 0 all checks passed, 1 a check failed, 2 bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.report.demo_report",
        description="Write the report of a demo run again from its files.",
        epilog="example: python -m tools.report.demo_report out/demo",
    )
    parser.add_argument("out", type=Path, help="folder of the run, as written by python -m tools.demo")
    parser.add_argument("--artifacts", type=Path, help="artifact directory (default: the one settings.json names)")
    parser.add_argument("--json", metavar="FILE", help="also write demo.json's content here; - is stdout")
    args = parser.parse_args(argv)
    try:
        files = RunFiles(args.out, args.artifacts or recorded_artifacts(args.out))
        # Only the demo knows how long all of it took, and has left it in the demo.json of the first report.
        wall_s = seconds(files.summary, load_json(files.summary), "wall_s") if files.summary.exists() else 0.0
        summary = write_report(files, wall_s=wall_s)
        write_result(args.json, summary)
    except (ReportError, OSError) as error:
        print(f"demo_report: {error}", file=sys.stderr)
        return 2
    if args.json != "-":
        print(files.report)
    return 0 if all(check["pass"] for check in summary["checks"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
